// The latency-shaping node for messages of any type: what it receives on `input` it republishes on
// `output`, byte for byte, in the slots of its server (Managing End-to-End Timing Jitters in ROS2
// Computation Chains, section 3.2.2).

#include <memory>
#include <optional>

#include "rclcpp/version.h"

#include "chainshaper_shaping/node.hpp"

namespace
{

using chainshaper::Shaping;
using Message = rclcpp::SerializedMessage;

void shape(
  Shaping & shaping, rclcpp::GenericPublisher & publisher, const Message & message,
  std::optional<std::int64_t> source_timestamp)
{
  const auto & bytes = message.get_rcl_serialized_message();
  shaping.shape(
    chainshaper::origin_of(bytes.buffer, bytes.buffer_length), source_timestamp,
    [&] {publisher.publish(message);});
}

}  // namespace

int main(int argc, char ** argv)
{
  std::optional<Shaping> shaping;
  rclcpp::GenericPublisher::SharedPtr publisher;
  rclcpp::GenericSubscription::SharedPtr subscription;
  return chainshaper::run(
    argc, argv, "chainshaper_shaping", [&](rclcpp::Node & node) {
      shaping.emplace(node);
      const auto depth = chainshaper::parameter<std::int64_t>(node, "output_depth", 10);
      const auto offer =
        chainshaper::wait_for_publisher(node, "input", static_cast<std::size_t>(depth));
      if (!offer) {
        return false;
      }
      publisher = node.create_generic_publisher("output", offer->type, offer->publisher);
      shaping->listen_to_modes();
#if RCLCPP_VERSION_GTE(25, 0, 0)
      subscription = node.create_generic_subscription(
        "input", offer->type, offer->subscription,
        [&](std::shared_ptr<const Message> message, const rclcpp::MessageInfo & info) {
          shape(*shaping, *publisher, *message, info.get_rmw_message_info().source_timestamp);
        });
#else
      // Up to Iron the callback is given the message only (rclcpp issue 1604): the log lacks its
      // source timestamp.
      subscription = node.create_generic_subscription(
        "input", offer->type, offer->subscription, [&](std::shared_ptr<Message> message) {
          shape(*shaping, *publisher, *message, std::nullopt);
        });
#endif
      return true;
    });
}
