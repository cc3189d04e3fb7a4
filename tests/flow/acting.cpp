// A node with a rate loop in the thread of its action, as Nav2's controller server has it:
//
// acting NOTES PERIOD_MS GOAL_MS
//
// Each goal has a thread of its own, as those of Nav2's SimpleActionServer; the node sends itself
// one goal after another.
#include <cstdlib>
#include <example_interfaces/action/fibonacci.hpp>
#include <future>
#include <memory>
#include <rclcpp_action/rclcpp_action.hpp>

#include "looping.hpp"

using Follow = example_interfaces::action::Fibonacci;
using Goal = rclcpp_action::ServerGoalHandle<Follow>;

int main(int count, char ** words) {
  rclcpp::init(count, words);
  const std::chrono::milliseconds period(std::atoi(words[2])), lasts(std::atoi(words[3]));
  const auto node = std::make_shared<rclcpp::Node>("actor");
  Loop loop(node, words[1], true);
  std::future<void> execution;
  const auto follow = [&](const std::shared_ptr<Goal> & goal) {
    rclcpp::WallRate rate(period);
    for (const auto until = Clock::now() + lasts; rclcpp::ok() && Clock::now() < until;) {
      loop.turn();
      rate.sleep();
    }
    if (rclcpp::ok()) goal->succeed(std::make_shared<Follow::Result>());
  };
  const auto server = rclcpp_action::create_server<Follow>(
      node, "follow_path",
      [](const rclcpp_action::GoalUUID &, const std::shared_ptr<const Follow::Goal> &) {
        return rclcpp_action::GoalResponse::ACCEPT_AND_EXECUTE;
      },
      [](const std::shared_ptr<Goal> &) { return rclcpp_action::CancelResponse::ACCEPT; },
      [&](const std::shared_ptr<Goal> & goal) {
        execution = std::async(std::launch::async, follow, goal);
      });
  const auto client = rclcpp_action::create_client<Follow>(node, "follow_path");
  rclcpp_action::Client<Follow>::SendGoalOptions options;
  options.result_callback = [&](const auto &) { client->async_send_goal(Follow::Goal(), options); };
  rclcpp::TimerBase::SharedPtr first;
  first = node->create_wall_timer(std::chrono::milliseconds(100), [&] {
    if (!client->action_server_is_ready()) return;
    client->async_send_goal(Follow::Goal(), options);
    first->cancel();
  });
  rclcpp::spin(node);
  return 0;
}
