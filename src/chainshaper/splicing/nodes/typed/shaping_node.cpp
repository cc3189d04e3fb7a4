// The latency-shaping node for one type of message: what it receives on `input` it republishes on
// `output` in the slots of its server (Managing End-to-End Timing Jitters in ROS2 Computation
// Chains, section 3.2.2).

#include <functional>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>

#include "chainshaper_shaping/node.hpp"
#include "message.hpp"

namespace
{

using chainshaper::Message;

template<typename T, typename = void>
struct HasStamp : std::false_type {};

template<typename T>
struct HasStamp<T, std::void_t<decltype(std::declval<T>().header.stamp.nanosec)>>: std::true_type {};

// The stamp of a message's header; none if it is zero, or the type has no header.
template<typename T>
std::optional<std::int64_t> stamp_of([[maybe_unused]] const T & message)
{
  if constexpr (HasStamp<T>::value) {
    const auto & stamp = message.header.stamp;
    if (stamp.sec != 0 || stamp.nanosec != 0) {
      return stamp.sec * std::int64_t{1'000'000'000} + stamp.nanosec;
    }
  }
  return std::nullopt;
}

}  // namespace

int main(int argc, char ** argv)
{
  std::optional<chainshaper::Shaping<Message>> shaping;
  rclcpp::Publisher<Message>::SharedPtr publisher;
  return chainshaper::run(
    argc, argv, "chainshaper_shaping", [&](rclcpp::Node & node) -> std::function<bool()> {
      auto turn = chainshaper::turn_of(node);
      const auto depth = chainshaper::parameter<std::int64_t>(node, "output_depth", 10);
      const auto offer =
        chainshaper::wait_for_publisher(node, "input", static_cast<std::size_t>(depth));
      if (!offer) {
        return {};
      }
      if (offer->type != chainshaper::message_type) {
        throw std::invalid_argument(
          "this node was made for " + std::string(chainshaper::message_type) +
          ", but its input is " + offer->type + ": generate it again for that type");
      }
      shaping.emplace(node, *offer, std::move(turn));
      publisher = node.create_publisher<Message>("output", shaping->offered(offer->publisher));
      shaping->listen_to_modes();
      const auto subscription = node.create_subscription<Message>(
        "input", shaping->asked(offer->subscription),
        [&](std::shared_ptr<Message> message, const rclcpp::MessageInfo & info) {
          shaping->shape(std::move(message), info);
        });
      shaping->connect(
        {subscription,
          [subscription](rclcpp::MessageInfo & info) {
            auto message = std::make_shared<Message>();
            return subscription->take(*message, info) ? message : nullptr;
          },
          [](const Message & message) {return stamp_of(message);},
          [&](const Message & message) {publisher->publish(message);},
          [subscription](const std::shared_ptr<Message> & message, const rclcpp::MessageInfo & info) {
            std::shared_ptr<void> untyped = message;
            subscription->handle_message(untyped, info);
          }});
      if (!shaping->await_receivers(*publisher)) {
        return {};
      }
      return [&] {return shaping->work_off();};
    });
}
