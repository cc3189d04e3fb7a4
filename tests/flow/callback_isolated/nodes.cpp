// A chain of three nodes in one process, whose callback groups have a thread each, and its receiver.
//
//   nodes chain   /source, a timer of 100 ms -> /points -> /filter -> /filtered -> /control
//                 -> /command. Each has a timer of 50 ms in a callback group of its own beside it.
//   nodes sink    /sink, which receives /command.
//
// Executions last 5 to 15 ms of processor time, drawn anew each time.
#include <time.h>

#include <chrono>
#include <cstring>
#include <functional>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "callback_isolated_executor/callback_isolated_executor.hpp"
#include "geometry_msgs/msg/point_stamped.hpp"
#include "rclcpp/rclcpp.hpp"

namespace {

using Message = geometry_msgs::msg::PointStamped;

int64_t processor_time() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return now.tv_sec * 1'000'000'000LL + now.tv_nsec;
}

void compute(double least_ms, double most_ms) {
  thread_local std::mt19937 draw{std::random_device{}()};
  const double ms = std::uniform_real_distribution<>(least_ms, most_ms)(draw);
  const int64_t until = processor_time() + static_cast<int64_t>(ms * 1e6);
  while (processor_time() < until) {
  }
}

class Stage : public rclcpp::Node {
 public:
  Stage(const std::string& name, const std::string& reads, const std::string& writes) : Node(name) {
    group_ = create_callback_group(rclcpp::CallbackGroupType::MutuallyExclusive);
    beside_ = create_callback_group(rclcpp::CallbackGroupType::MutuallyExclusive);
    if (!writes.empty()) {
      publisher_ = create_publisher<Message>(writes, 10);
      timer_beside_ = create_wall_timer(
          std::chrono::milliseconds(50), [] { compute(0.5, 1.0); }, beside_);
    }
    if (reads.empty()) {
      timer_ = create_wall_timer(
          std::chrono::milliseconds(100),
          [this] {
            Message message;
            message.header.stamp = now();
            work(message);
          },
          group_);
      return;
    }
    rclcpp::SubscriptionOptions options;
    options.callback_group = group_;
    subscription_ = create_subscription<Message>(
        reads, 10, [this](Message::ConstSharedPtr message) { work(*message); }, options);
  }

 private:
  void work(const Message& message) {
    if (publisher_ == nullptr) {
      return;
    }
    compute(5.0, 15.0);
    publisher_->publish(message);
  }

  rclcpp::CallbackGroup::SharedPtr group_, beside_;
  rclcpp::Publisher<Message>::SharedPtr publisher_;
  rclcpp::Subscription<Message>::SharedPtr subscription_;
  rclcpp::TimerBase::SharedPtr timer_, timer_beside_;
};

}  // namespace

int main(int argc, char** argv) {
  rclcpp::init(argc, argv);
  std::vector<std::shared_ptr<Stage>> nodes;
  if (argc > 1 && std::strcmp(argv[1], "sink") == 0) {
    nodes.push_back(std::make_shared<Stage>("sink", "/command", ""));
  } else {
    nodes.push_back(std::make_shared<Stage>("source", "", "/points"));
    nodes.push_back(std::make_shared<Stage>("filter", "/points", "/filtered"));
    nodes.push_back(std::make_shared<Stage>("control", "/filtered", "/command"));
  }
  auto executor = std::make_shared<CallbackIsolatedExecutor>();
  for (auto& node : nodes) {
    executor->add_node(node);
  }
  executor->spin();
  rclcpp::shutdown();
}
