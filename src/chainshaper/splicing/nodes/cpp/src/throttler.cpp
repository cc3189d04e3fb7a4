// The throttler: a strictly periodic start for chains whose input is not quite periodic (Managing
// End-to-End Timing Jitters in ROS2 Computation Chains, section 5.1).
//
// Each topic of `inputs` is republished on the topic of `outputs` in the same place, once every
// `period_ns`, at `phase_ns` after multiples of it on CLOCK_MONOTONIC: the newest message that
// came since the last time. Where none came nothing is published, and where several came the
// older ones are dropped; both are counted, and said at the end. chainshaper's Python throttler does
// the same, and says why that is not the paper's rule to the letter.

#include <memory>
#include <string>
#include <vector>

#include "chainshaper_shaping/node.hpp"
#include "chainshaper_shaping/serialized.hpp"

namespace
{

struct Channel
{
  std::string output;
  rclcpp::GenericPublisher::SharedPtr publisher;
  rclcpp::GenericSubscription::SharedPtr subscription;
  rclcpp::TimerBase::SharedPtr timer;
  std::shared_ptr<const rclcpp::SerializedMessage> newest;
  std::uint64_t published{0};
  std::uint64_t dropped{0};
  std::uint64_t missing{0};
};

void take(Channel & channel, std::shared_ptr<const rclcpp::SerializedMessage> message)
{
  channel.dropped += channel.newest ? 1 : 0;
  channel.newest = std::move(message);
}

void publish(rclcpp::Node & node, Channel & channel)
{
  if (channel.newest) {
    chainshaper::publish_serialized(*channel.publisher, *channel.newest);
    channel.newest.reset();
    ++channel.published;
    return;
  }
  ++channel.missing;
  RCLCPP_WARN_THROTTLE(
    node.get_logger(), *node.get_clock(), 10'000, "nothing new for %s; this is no. %zu",
    channel.output.c_str(), static_cast<std::size_t>(channel.missing));
}

}  // namespace

int main(int argc, char ** argv)
{
  std::vector<std::unique_ptr<Channel>> channels;
  const int code = chainshaper::run(
    argc, argv, "chainshaper_throttler", [&](rclcpp::Node & node) -> std::function<bool()> {
      using Names = std::vector<std::string>;
      const auto inputs = chainshaper::parameter<Names>(node, "inputs", {});
      const auto outputs = chainshaper::parameter<Names>(node, "outputs", {});
      const auto period = chainshaper::parameter<std::int64_t>(node, "period_ns", 0);
      const auto phase = chainshaper::parameter<std::int64_t>(node, "phase_ns", 0);
      const auto depth = chainshaper::parameter<std::int64_t>(node, "output_depth", 10);
      if (inputs.empty() || inputs.size() != outputs.size() || period <= 0) {
        throw std::invalid_argument("inputs, as many outputs, and a period are needed");
      }
      for (std::size_t i = 0; i < inputs.size(); ++i) {
        const auto offer =
        chainshaper::wait_for_publisher(node, inputs[i], static_cast<std::size_t>(depth));
        if (!offer) {
          return {};
        }
        channels.push_back(std::make_unique<Channel>());
        Channel & channel = *channels.back();
        channel.output = outputs[i];
        channel.publisher =
        node.create_generic_publisher(outputs[i], offer->type, offer->publisher);
        channel.subscription = chainshaper::subscribe_serialized(
          node, inputs[i], offer->type, offer->subscription,
          [&channel](std::shared_ptr<rclcpp::SerializedMessage> message, const rclcpp::MessageInfo &) {
            take(channel, std::move(message));
          });
      }
      // A timer keeps the phase at which it was made, on the same clock.
      const std::int64_t since = chainshaper::monotonic_ns() - phase;
      chainshaper::sleep_until(phase + (since / period + 1) * period);
      for (auto & channel : channels) {
        channel->timer = node.create_wall_timer(
          std::chrono::nanoseconds(period), [&node, &channel] {publish(node, *channel);});
      }
      return [] {return false;};
    });
  for (const auto & channel : channels) {
    std::printf(
      "%s: %zu published, %zu times nothing new, %zu dropped for newer ones\n",
      channel->output.c_str(), static_cast<std::size_t>(channel->published),
      static_cast<std::size_t>(channel->missing), static_cast<std::size_t>(channel->dropped));
  }
  return code;
}
