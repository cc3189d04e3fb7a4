// One node with two callback groups, each on an executor of its own in a thread of its own.
//
// The group of the chain computes for 5 ms every 100 ms and publishes; the other one ticks every
// 10 ms. A line per callback says which it was, in which thread, and when (ns of CLOCK_MONOTONIC).
#include <chrono>
#include <cstdio>
#include <thread>

#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/header.hpp>
#include <unistd.h>

using namespace std::chrono_literals;
using std::chrono::steady_clock;

static void ran(const char * what, steady_clock::time_point began)
{
  std::printf("%s %d %lld %lld\n", what, gettid(),
    static_cast<long long>(began.time_since_epoch().count()),
    static_cast<long long>(steady_clock::now().time_since_epoch().count()));
  std::fflush(stdout);
}

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  auto node = std::make_shared<rclcpp::Node>("groups");
  const auto kind = rclcpp::CallbackGroupType::MutuallyExclusive;
  auto beside = node->create_callback_group(kind, false);
  auto chain = node->create_callback_group(kind, false);
  auto out = node->create_publisher<std_msgs::msg::Header>("/out", 10);
  auto ticks = node->create_publisher<std_msgs::msg::Header>("/ticks", 10);
  auto tick = node->create_wall_timer(10ms, [&] {
      const auto began = steady_clock::now();
      ticks->publish(std_msgs::msg::Header());
      ran("tick", began);
    }, beside);
  auto work = node->create_wall_timer(100ms, [&] {
      const auto began = steady_clock::now();
      while (steady_clock::now() - began < 5ms) {}
      out->publish(std_msgs::msg::Header());
      ran("work", began);
    }, chain);
  rclcpp::executors::SingleThreadedExecutor first, second;
  first.add_callback_group(beside, node->get_node_base_interface());
  second.add_callback_group(chain, node->get_node_base_interface());
  std::thread one([&] {first.spin();});
  std::this_thread::sleep_for(50ms);
  std::thread two([&] {second.spin();});
  one.join();
  two.join();
  rclcpp::shutdown();
}
