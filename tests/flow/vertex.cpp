// A node with one callback that computes for a random time and publishes what it was started by:
//
//   vertex OUTPUT|- LEAST_MS MOST_MS every PERIOD_MS
//   vertex OUTPUT|- LEAST_MS MOST_MS on INPUT [INPUT]      (two inputs: synchronised)
//   vertex OUTPUT|- LEAST_MS MOST_MS after INPUT           (it sleeps where others compute)
//   vertex TOPIC modes PERIOD_S MODE [MODE]                (names the modes in turn, as strings)
//
// With the parameter `twice_in` it takes twice as long while that is the mode on /driving_mode.
#include <chrono>
#include <ctime>
#include <memory>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include "geometry_msgs/msg/point_stamped.hpp"
#include "message_filters/subscriber.h"
#include "message_filters/time_synchronizer.h"
#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/string.hpp"

using Message = geometry_msgs::msg::PointStamped;
using String = std_msgs::msg::String;
using Filter = message_filters::Subscriber<Message>;

class Vertex : public rclcpp::Node {
 public:
  explicit Vertex(const std::vector<std::string>& words)
      : Node("vertex"),
        time_ms_(std::stod(words[2]), std::stod(words[3])),
        sleeps_(words[4] == "after") {
    const auto slow = declare_parameter("twice_in", "");
    if (!slow.empty()) {
      mode_ = create_subscription<String>("/driving_mode", 1, [this, slow](const String& mode) { factor_ = mode.data == slow ? 2 : 1; });
    }
    if (words[1] != "-") output_ = create_publisher<Message>(words[1], 10);
    const auto take = [this](const Message::ConstSharedPtr& message) { finish(*message); };
    if (words[4] == "every") {
      timer_ = create_wall_timer(std::chrono::milliseconds(std::stoi(words[5])), [this] {
        Message begun;
        begun.header.stamp = now();
        finish(begun);
      });
    } else if (words.size() == 6) {
      input_ = create_subscription<Message>(words[5], 10, take);
    } else {
      filters_ = {std::make_shared<Filter>(this, words[5]), std::make_shared<Filter>(this, words[6])};
      both_ = std::make_shared<message_filters::TimeSynchronizer<Message, Message>>(*filters_[0], *filters_[1], 10);
      both_->registerCallback(std::bind(take, std::placeholders::_1));
    }
  }

 private:
  void finish(const Message& message) {
    const double lasts_ms = factor_ * time_ms_(random_), end_ms = ran_ms() + lasts_ms;
    if (sleeps_) std::this_thread::sleep_for(std::chrono::duration<double, std::milli>(lasts_ms));
    while (!sleeps_ && ran_ms() < end_ms) {
    }
    if (output_) output_->publish(message);
  }

  static double ran_ms() {
    timespec ran;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &ran);
    return ran.tv_sec * 1e3 + ran.tv_nsec / 1e6;
  }

  std::uniform_real_distribution<double> time_ms_;
  const bool sleeps_;
  double factor_ = 1;
  std::mt19937 random_{std::random_device{}()};
  rclcpp::Publisher<Message>::SharedPtr output_;
  rclcpp::TimerBase::SharedPtr timer_;
  rclcpp::Subscription<Message>::SharedPtr input_;
  rclcpp::Subscription<String>::SharedPtr mode_;
  std::vector<std::shared_ptr<Filter>> filters_;
  std::shared_ptr<message_filters::TimeSynchronizer<Message, Message>> both_;
};

void name_modes(const std::vector<std::string>& words) {
  const auto node = std::make_shared<rclcpp::Node>("modes");
  const auto output = node->create_publisher<String>(words[1], rclcpp::QoS(1).transient_local());
  std::size_t turn = 0;
  const auto timer = node->create_wall_timer(std::chrono::seconds(std::stoi(words[3])), [&] {
    String mode;
    mode.data = words[4 + turn++ % (words.size() - 4)];
    output->publish(mode);
  });
  rclcpp::spin(node);
}

int main(int argc, char** argv) {
  const auto words = rclcpp::init_and_remove_ros_arguments(argc, argv);
  if (words[2] == "modes") {
    name_modes(words);
  } else {
    rclcpp::spin(std::make_shared<Vertex>(words));
  }
  rclcpp::shutdown();
}
