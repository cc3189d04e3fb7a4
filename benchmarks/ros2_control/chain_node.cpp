// A node of the chain: a timer, or a subscription, computes for a random time and publishes.
//
//     chain_node OUTPUT LEAST_US MOST_US every PERIOD_US
//     chain_node OUTPUT LEAST_US MOST_US on INPUT
//
// A message is the instant (CLOCK_MONOTONIC, ns) at which its chain began: the start of the timer's
// callback. Times to compute are CPU times of the thread.

#include <cstdint>
#include <cstdlib>
#include <ctime>
#include <random>
#include <string>

#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/float64_multi_array.hpp"

namespace {

using Message = std_msgs::msg::Float64MultiArray;

std::int64_t read_clock(clockid_t clock) {
  timespec now{};
  clock_gettime(clock, &now);
  return now.tv_sec * std::int64_t{1'000'000'000} + now.tv_nsec;
}

void compute(std::int64_t duration_ns) {
  const std::int64_t until = read_clock(CLOCK_THREAD_CPUTIME_ID) + duration_ns;
  while (read_clock(CLOCK_THREAD_CPUTIME_ID) < until) {
  }
}

}  // namespace

int main(int argc, char ** argv) {
  const auto words = rclcpp::init_and_remove_ros_arguments(argc, argv);
  if (words.size() != 6) return EXIT_FAILURE;
  const auto node = std::make_shared<rclcpp::Node>("chain_node");
  const auto output = node->create_publisher<Message>(words[1], 1);
  std::uniform_int_distribution<std::int64_t> times(1000 * std::stoll(words[2]),
                                                    1000 * std::stoll(words[3]));
  std::mt19937_64 random(std::hash<std::string>()(words[1]));
  const auto answer = [&](double began) {
    compute(times(random));
    Message message;
    message.data = {began};
    output->publish(message);
  };
  rclcpp::TimerBase::SharedPtr timer;
  rclcpp::Subscription<Message>::SharedPtr input;
  if (words[4] == "every") {
    timer = rclcpp::create_timer(node, node->get_clock(),
                                 rclcpp::Duration(std::chrono::microseconds(std::stoll(words[5]))),
                                 [&] { answer(static_cast<double>(read_clock(CLOCK_MONOTONIC))); });
  } else {
    input = node->create_subscription<Message>(
        words[5], 1, [&](const Message & message) { answer(message.data.at(0)); });
  }
  rclcpp::executors::SingleThreadedExecutor executor;
  executor.add_node(node);
  executor.spin();
  rclcpp::shutdown();
  return EXIT_SUCCESS;
}
