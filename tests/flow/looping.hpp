// A loop that is no callback: it uses what a subscription has stored, and notes what that was.
//
// Each turn notes the origin of the message, and the instants before it published and behind that
// (ns of the steady clock; a loop that publishes nothing only has an end).
#pragma once

#include <chrono>
#include <cstdint>
#include <fstream>
#include <geometry_msgs/msg/point_stamped.hpp>
#include <mutex>
#include <rclcpp/rclcpp.hpp>
#include <string>

using Clock = std::chrono::steady_clock;
using geometry_msgs::msg::PointStamped;

inline int64_t now() { return Clock::now().time_since_epoch().count(); }

inline PointStamped stamped(int64_t origin) {
  PointStamped message;
  message.header.stamp.sec = static_cast<int32_t>(origin / 1'000'000'000);
  message.header.stamp.nanosec = static_cast<uint32_t>(origin % 1'000'000'000);
  return message;
}

inline int64_t origin_of(const PointStamped & message) {
  return message.header.stamp.sec * INT64_C(1'000'000'000) + message.header.stamp.nanosec;
}

inline void compute(std::chrono::microseconds duration) {
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
