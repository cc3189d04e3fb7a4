// The latency-shaping node for messages of any type: what it receives on `input` it republishes on
// `output`, byte for byte, in the slots of its server (Managing End-to-End Timing Jitters in ROS2
// Computation Chains, section 3.2.2).

#include <memory>
#include <optional>

#include "chainshaper_shaping/node.hpp"
#include "chainshaper_shaping/serialized.hpp"

using Message = rclcpp::SerializedMessage;

int main(int argc, char ** argv)
{
  std::optional<chainshaper::Shaping> shaping;
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
      subscription = chainshaper::subscribe_serialized(
        node, "input", offer->type, offer->subscription,
        [&](std::shared_ptr<const Message> message, std::int64_t source_timestamp) {
          const auto & bytes = message->get_rcl_serialized_message();
          shaping->shape(
            chainshaper::origin_of(bytes.buffer, bytes.buffer_length), source_timestamp,
            [&] {chainshaper::publish_serialized(*publisher, *message);});
        });
      return true;
    });
}
