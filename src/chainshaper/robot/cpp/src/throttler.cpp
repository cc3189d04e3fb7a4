// The throttler, for chains whose input is not quite periodic (Managing End-to-End Timing Jitters
// in ROS2 Computation Chains, section 5.1). chainshaper's Python throttler does the same; its
// source says what that is.

#include <memory>
#include <string>
#include <tuple>
#include <vector>

#include "chainshaper_shaping/node.hpp"
#include "gate/throttling.hpp"

namespace {

// A topic, and counts of what became of its messages.
struct Channel {
  std::string output;
  rclcpp::GenericPublisher::SharedPtr publisher;
  rclcpp::GenericSubscription::SharedPtr subscription;
  rclcpp::TimerBase::SharedPtr timer;
  std::optional<chainshaper::FirstOfPeriod> periods;  // none: the rule is `newest`
  std::shared_ptr<const rclcpp::SerializedMessage> newest;
  std::size_t published{0};
  std::size_t dropped{0};
  std::size_t missing{0};

  // Publishes the newest message that came since the last publication.
  void publish(rclcpp::Node & node) {
    if (newest) {
      chainshaper::publish_serialized(*publisher, *newest);
      newest.reset();
      ++published;
      return;
    }
    ++missing;
    RCLCPP_WARN_THROTTLE(node.get_logger(), *node.get_clock(), 10'000,
                         "nothing new for %s; this is no. %zu", output.c_str(), missing);
  }

  // Publishes a message if it is the first of its period; or keeps it until the next tick.
  void take(rclcpp::Node & node, const std::shared_ptr<const rclcpp::SerializedMessage> & message) {
    const bool passes = !periods || periods->passes(chainshaper::monotonic_ns());
    dropped += newest || !passes ? 1 : 0;
    newest = passes ? message : nullptr;
    if (passes && periods) publish(node);
  }
};

}  // namespace

int main(int argc, char ** argv) {
  std::vector<std::unique_ptr<Channel>> channels;
  const int code = chainshaper::run(
      argc, argv, "chainshaper_throttler", [&](rclcpp::Node & node) -> std::function<bool()> {
        const auto parameters = chainshaper::parameters_of(node);
        const auto & [inputs, outputs] = std::tie(parameters.inputs, parameters.outputs);
        const auto period = parameters.period_ns;
        const bool is_first = parameters.rule == "first";
        const bool is_known = is_first || parameters.rule == "newest";
        if (inputs.empty() || inputs.size() != outputs.size() || period <= 0 || !is_known)
          throw std::invalid_argument("inputs, as many outputs, a period, and a rule are needed");
        for (std::size_t i = 0; i < inputs.size(); ++i) {
          const auto offer = chainshaper::wait_for_publisher(node, inputs[i]);
          if (!offer) return {};
          channels.push_back(std::make_unique<Channel>());
          Channel & channel = *channels.back();
          channel.output = outputs[i];
          if (is_first) channel.periods = chainshaper::FirstOfPeriod{period};
          channel.publisher =
              node.create_generic_publisher(outputs[i], offer->type, offer->publisher);
          channel.subscription = chainshaper::subscribe_serialized(
              node, inputs[i], offer->type, offer->subscription,
              [&node, &channel](const std::shared_ptr<rclcpp::SerializedMessage> & message,
                                const rclcpp::MessageInfo &) { channel.take(node, message); });
        }
        if (is_first) return [] { return false; };
        // A timer keeps the phase at which it was made, on the same clock.
        const std::int64_t since = chainshaper::monotonic_ns() - parameters.phase_ns;
        chainshaper::sleep_until(parameters.phase_ns + (since / period + 1) * period);
        for (auto & channel : channels)
          channel->timer = node.create_wall_timer(std::chrono::nanoseconds(period),
                                                  [&node, &channel] { channel->publish(node); });
        return [] { return false; };
      });
  for (const auto & channel : channels)
    std::printf("%s: %zu published, %zu times nothing new, %zu dropped\n", channel->output.c_str(),
                channel->published, channel->missing, channel->dropped);
  return code;
}
