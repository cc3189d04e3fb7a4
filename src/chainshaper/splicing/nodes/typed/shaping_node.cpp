// The latency-shaping node for one type of message: what it receives on `input` it republishes on
// `output` in the slots of its server (Managing End-to-End Timing Jitters in ROS2 Computation
// Chains, section 3.2.2).

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
  std::optional<chainshaper::Shaping> shaping;
  rclcpp::Publisher<Message>::SharedPtr publisher;
  rclcpp::Subscription<Message>::SharedPtr subscription;
  return chainshaper::run(
    argc, argv, "chainshaper_shaping", [&](rclcpp::Node & node) {
      shaping.emplace(node);
      const auto depth = chainshaper::parameter<std::int64_t>(node, "output_depth", 10);
      const auto offer =
        chainshaper::wait_for_publisher(node, "input", static_cast<std::size_t>(depth));
      if (!offer) {
        return false;
      }
      if (offer->type != chainshaper::message_type) {
        throw std::invalid_argument(
          "this node was made for " + std::string(chainshaper::message_type) +
          ", but its input is " + offer->type + ": generate it again for that type");
      }
      publisher = node.create_publisher<Message>("output", offer->publisher);
      shaping->listen_to_modes();
      subscription = node.create_subscription<Message>(
        "input", offer->subscription,
        [&](std::shared_ptr<const Message> message, const rclcpp::MessageInfo & info) {
          shaping->shape(
            stamp_of(*message), info.get_rmw_message_info().source_timestamp,
            [&] {publisher->publish(*message);});
        });
      return true;
    });
}
