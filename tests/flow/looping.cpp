// Nodes whose loop is no callback, and the sensor in front of them:
//
// looping NOTES sensor PERIOD_MS
// looping NOTES thread|spin_some|silent PERIOD_MS
#include "looping.hpp"

#include <cstdlib>
#include <memory>
#include <thread>

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
