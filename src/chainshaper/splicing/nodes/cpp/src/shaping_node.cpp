// The latency-shaping node for messages of any type: what it receives on `input` it republishes on
// `output`, byte for byte, in the slots of its server (Managing End-to-End Timing Jitters in ROS2
// Computation Chains, section 3.2.2).

#include <functional>
#include <memory>
#include <optional>
#include <utility>

#include "chainshaper_shaping/node.hpp"
#include "chainshaper_shaping/serialized.hpp"

using Message = rclcpp::SerializedMessage;

int main(int argc, char ** argv)
{
  std::optional<chainshaper::Shaping<Message>> shaping;
  rclcpp::GenericPublisher::SharedPtr publisher;
  return chainshaper::run(
    argc, argv, "chainshaper_shaping", [&](rclcpp::Node & node) -> std::function<bool()> {
      auto turn = chainshaper::turn_of(node);
      const auto depth = chainshaper::parameter<std::int64_t>(node, "output_depth", 10);
      const auto offer =
        chainshaper::wait_for_publisher(node, "input", static_cast<std::size_t>(depth));
      if (!offer) {
        return {};
      }
      shaping.emplace(node, *offer, std::move(turn));
      publisher = node.create_generic_publisher(
        "output", offer->type, shaping->offered(offer->publisher));
      shaping->listen_to_modes();
      const auto subscription = chainshaper::subscribe_serialized(
        node, "input", offer->type, shaping->asked(offer->subscription),
        [&](std::shared_ptr<Message> message, const rclcpp::MessageInfo & info) {
          shaping->shape(std::move(message), info);
        });
      shaping->connect(
        {subscription,
          [subscription](rclcpp::MessageInfo & info) {
            auto message = std::make_shared<Message>();
            return subscription->take_serialized(*message, info) ? message : nullptr;
          },
          [](const Message & message) {
            const auto & bytes = message.get_rcl_serialized_message();
            return chainshaper::origin_of(bytes.buffer, bytes.buffer_length);
          },
          [&](const Message & message) {chainshaper::publish_serialized(*publisher, message);},
          [subscription](const std::shared_ptr<Message> & message, const rclcpp::MessageInfo & info) {
            subscription->handle_serialized_message(message, info);
          }});
      if (!shaping->await_receivers(*publisher)) {
        return {};
      }
      return [&] {return shaping->work_off();};
    });
}
