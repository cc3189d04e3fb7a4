// Nodes whose loop is no callback, and the sensor in front of them:
//
// looping NOTES sensor PERIOD_MS
// looping NOTES thread|spin_some|silent PERIOD_MS
//
// Each turn of a loop notes what it really used: the origin of the message, and the instants before
// it published and behind that (ns of the steady clock; a silent loop only has an end).
#include <atomic>
#include <chrono>
#include <csignal>
#include <cstdint>
#include <cstdlib>
#include <fstream>
#include <geometry_msgs/msg/point_stamped.hpp>
#include <memory>
#include <mutex>
#include <rclcpp/rclcpp.hpp>
#include <string>
#include <thread>

using Clock = std::chrono::steady_clock;
using geometry_msgs::msg::PointStamped;

static int64_t now() { return Clock::now().time_since_epoch().count(); }

static PointStamped stamped(int64_t origin) {
  PointStamped message;
  message.header.stamp.sec = static_cast<int32_t>(origin / 1'000'000'000);
  message.header.stamp.nanosec = static_cast<uint32_t>(origin % 1'000'000'000);
  return message;
}

static int64_t origin_of(const PointStamped & message) {
  return message.header.stamp.sec * INT64_C(1'000'000'000) + message.header.stamp.nanosec;
}

static void compute(std::chrono::microseconds duration) {
  for (const auto until = Clock::now() + duration; Clock::now() < until;) continue;
}

class Loop {
public:
  Loop(const rclcpp::Node::SharedPtr & node, const std::string & notes, bool publishes)
      : notes_(notes), publishes_(publishes) {
    subscription_ =
        node->create_subscription<PointStamped>("/scan", 1, [this](const PointStamped & message) {
          const std::lock_guard<std::mutex> lock(mutex_);
          stored_ = origin_of(message);
        });
    if (publishes) output_ = node->create_publisher<PointStamped>("/command", 1);
  }

  void turn() {
    int64_t used = 0;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      used = stored_;
    }
    compute(std::chrono::milliseconds(1));
    const int64_t before = now();
    if (publishes_) output_->publish(stamped(used));
    notes_ << used << ' ' << before << ' ' << now() << std::endl;
  }

private:
  std::ofstream notes_;
  bool publishes_;
  std::mutex mutex_;
  int64_t stored_ = 0;
  rclcpp::Subscription<PointStamped>::SharedPtr subscription_;
  rclcpp::Publisher<PointStamped>::SharedPtr output_;
};

int main(int count, char ** words) {
  rclcpp::init(count, words);
  const std::string notes = words[1], role = words[2];
  const std::chrono::milliseconds period(std::atoi(words[3]));
  const auto node = std::make_shared<rclcpp::Node>(role == "sensor" ? "sensor" : "actor");
  if (role == "sensor") {
    const auto output = node->create_publisher<PointStamped>("/scan", 1);
    const auto timer = node->create_wall_timer(period, [&] { output->publish(stamped(now())); });
    rclcpp::spin(node);
    return 0;
  }
  Loop loop(node, notes, role != "silent");
  if (role == "spin_some") {
    rclcpp::WallRate rate(period);
    while (rclcpp::ok()) {
      rclcpp::spin_some(node);
      loop.turn();
      rate.sleep();
    }
    return 0;
  }
  std::thread thread([&] {
    for (auto next = Clock::now(); rclcpp::ok();) {
      std::this_thread::sleep_until(next += period);
      loop.turn();
    }
  });
  rclcpp::spin(node);
  thread.join();
  return 0;
}
