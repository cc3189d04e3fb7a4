// Nodes that a test starts, by the role they play: `role ROLE [NUMBER]`. What they did they print,
// with the time of CLOCK_MONOTONIC in ns, so that what a recording says can be compared with it.
//
//   client PERIOD_MS   timer -> request to /add -> its response -> /sum; prints `cycle BEGAN SENT`
//   server             /add, which takes 2 to 5 ms
//   asker PERIOD_MS    timer -> goal of /errand; feedback -> /progress, result -> /finished; prints
//                      `goal TIME`, `progress SENT`, `finished SENT`
//   worker             /errand: three times feedback, 20 ms apart, from a thread of the goal; prints
//                      `feedback TIME`
//   source PERIOD_MS   a timer of the node's clock -> /t1, stamped by that clock
//   managed            a lifecycle node: /t1 -> /t2 of a lifecycle publisher, after 1 to 6 ms
//   sink               /t2; prints `came TIME`
//   clock PERCENT      /clock, at so many percent of the speed of time, from 1000 s on

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <string>
#include <thread>

#include <example_interfaces/action/fibonacci.hpp>
#include <example_interfaces/srv/add_two_ints.hpp>
#include <rclcpp/rclcpp.hpp>
#include <rclcpp_action/rclcpp_action.hpp>
#include <rclcpp_lifecycle/lifecycle_node.hpp>
#include <rosgraph_msgs/msg/clock.hpp>
#include <std_msgs/msg/header.hpp>

using namespace std::chrono_literals;  // NOLINT
using Add = example_interfaces::srv::AddTwoInts;
using Work = example_interfaces::action::Fibonacci;
using Header = std_msgs::msg::Header;

int64_t now_ns() {
  return std::chrono::nanoseconds(std::chrono::steady_clock::now().time_since_epoch()).count();
}

void print(const char * what, int64_t first, int64_t second = 0) {
  std::printf("%s %lld %lld\n", what, static_cast<long long>(first),  // NOLINT
              static_cast<long long>(second));                         // NOLINT
  std::fflush(stdout);
}

void compute(std::chrono::microseconds duration) {
  const auto end = std::chrono::steady_clock::now() + duration;
  while (std::chrono::steady_clock::now() < end) {
  }
}

std::chrono::milliseconds milliseconds(const char * number) {
  return std::chrono::milliseconds(std::atoi(number));
}

rclcpp::Node::SharedPtr client(const char * number) {
  auto node = std::make_shared<rclcpp::Node>("client");
  auto calls = node->create_client<Add>("/add");
  auto sum = node->create_publisher<Header>("/sum", 10);
  static auto timer = node->create_wall_timer(milliseconds(number), [calls, sum] {
    if (!calls->service_is_ready()) return;
    auto request = std::make_shared<Add::Request>();
    request->a = now_ns();
    calls->async_send_request(request, [sum, began = request->a](rclcpp::Client<Add>::SharedFuture) {
      compute(500us);
      Header header;
      header.frame_id = std::to_string(began);
      const auto sent = now_ns();
      sum->publish(header);
      print("cycle", began, sent);
    });
  });
  return node;
}

rclcpp::Node::SharedPtr server(const char *) {
  auto node = std::make_shared<rclcpp::Node>("server");
  static auto service = node->create_service<Add>(
      "/add", [](const Add::Request::SharedPtr request, Add::Response::SharedPtr response) {
        compute(std::chrono::microseconds(2000 + std::rand() % 3000));  // NOLINT
        response->sum = request->a + request->b;
      });
  return node;
}

rclcpp::Node::SharedPtr asker(const char * number) {
  auto node = std::make_shared<rclcpp::Node>("asker");
  auto client = rclcpp_action::create_client<Work>(node, "/errand");
  auto progress = node->create_publisher<Header>("/progress", 10);
  auto finished = node->create_publisher<Header>("/finished", 10);
  static auto timer = node->create_wall_timer(milliseconds(number), [=] {
    if (!client->action_server_is_ready()) return;
    rclcpp_action::Client<Work>::SendGoalOptions options;
    options.feedback_callback = [progress](auto, auto) {
      const auto sent = now_ns();
      progress->publish(Header());
      print("progress", sent);
    };
    options.result_callback = [finished](const auto &) {
      const auto sent = now_ns();
      finished->publish(Header());
      print("finished", sent);
    };
    print("goal", now_ns());
    client->async_send_goal(Work::Goal(), options);
  });
  return node;
}

rclcpp::Node::SharedPtr worker(const char *) {
  auto node = std::make_shared<rclcpp::Node>("worker");
  using Goal = rclcpp_action::ServerGoalHandle<Work>;
  static auto server = rclcpp_action::create_server<Work>(
      node, "/errand",
      [](auto, auto) { return rclcpp_action::GoalResponse::ACCEPT_AND_EXECUTE; },
      [](auto) { return rclcpp_action::CancelResponse::ACCEPT; },
      [](const std::shared_ptr<Goal> goal) {
        std::thread([goal] {
          for (int part = 0; part < 3; ++part) {
            std::this_thread::sleep_for(20ms);
            print("feedback", now_ns());
            goal->publish_feedback(std::make_shared<Work::Feedback>());
          }
          goal->succeed(std::make_shared<Work::Result>());
        }).detach();
      });
  return node;
}

rclcpp::Node::SharedPtr source(const char * number) {
  auto node = std::make_shared<rclcpp::Node>("source");
  auto out = node->create_publisher<Header>("/t1", 10);
  static auto timer =
      rclcpp::create_timer(node, node->get_clock(), milliseconds(number), [out, clock = node->get_clock()] {
        Header header;
        header.stamp = clock->now();
        out->publish(header);
      });
  return node;
}

class Managed : public rclcpp_lifecycle::LifecycleNode {
public:
  Managed() : rclcpp_lifecycle::LifecycleNode("managed") {}

  CallbackReturn on_configure(const rclcpp_lifecycle::State &) override {
    out_ = create_publisher<Header>("/t2", 10);
    in_ = create_subscription<Header>("/t1", 10, [this](const Header & header) {
      compute(std::chrono::microseconds(1000 + std::rand() % 5000));  // NOLINT
      if (out_->is_activated()) out_->publish(header);
    });
    return CallbackReturn::SUCCESS;
  }

private:
  rclcpp_lifecycle::LifecyclePublisher<Header>::SharedPtr out_;
  rclcpp::Subscription<Header>::SharedPtr in_;
};

rclcpp::Node::SharedPtr sink(const char *) {
  auto node = std::make_shared<rclcpp::Node>("sink");
  static auto in = node->create_subscription<Header>(
      "/t2", 10, [](const Header &) { print("came", now_ns()); });
  return node;
}

rclcpp::Node::SharedPtr simulated_clock(const char * percent) {
  auto node = std::make_shared<rclcpp::Node>("clock");
  auto out = node->create_publisher<rosgraph_msgs::msg::Clock>("/clock", 10);
  static auto timer = node->create_wall_timer(
      10ms, [out, began = now_ns(), percent = std::atoi(percent)] {
        rosgraph_msgs::msg::Clock message;
        message.clock = rclcpp::Time(1'000'000'000'000 + (now_ns() - began) / 100 * percent);
        out->publish(message);
      });
  return node;
}

int main(int count, char ** words) {
  rclcpp::init(count, words);
  const std::string role = words[1];
  const char * const number = count > 2 ? words[2] : "0";
  if (role == "managed") {
    rclcpp::spin(std::make_shared<Managed>()->get_node_base_interface());
  } else {
    const auto make = role == "client"   ? client
                      : role == "server" ? server
                      : role == "asker"  ? asker
                      : role == "worker" ? worker
                      : role == "source" ? source
                      : role == "sink"   ? sink
                                         : simulated_clock;
    rclcpp::spin(make(number));
  }
  rclcpp::shutdown();
}
