// The latency-shaping node: what it receives on `input` it republishes on `output` in the slots of
// its server (Managing End-to-End Timing Jitters in ROS2 Computation Chains, section 3.2.2). One
// source for two packages: with `message.hpp` it is for that type of message, without it for any,
// byte for byte.

#include <functional>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>

#include "chainshaper_shaping/node.hpp"

#if __has_include("message.hpp")
#include "message.hpp"

namespace {

using chainshaper::Message;

template <typename T, typename = void>
struct HasStamp : std::false_type {};

template <typename T>
struct HasStamp<T, std::void_t<decltype(std::declval<T>().header.stamp.nanosec)>> : std::true_type {
};

// The stamp of a message's header; none if it is zero, or the type has no header.
template <typename T>
chainshaper::Maybe stamp_of([[maybe_unused]] const T & message) {
  if constexpr (HasStamp<T>::value) {
    const auto & stamp = message.header.stamp;
    if (stamp.sec != 0 || stamp.nanosec != 0)
      return stamp.sec * std::int64_t{1'000'000'000} + stamp.nanosec;
  }
  return std::nullopt;
}

auto make_publisher(rclcpp::Node & node, const std::string & type, const rclcpp::QoS & qos) {
  if (type != chainshaper::message_type) {
    throw std::invalid_argument("this node was made for " + std::string(chainshaper::message_type) +
                                ", but its input is " + type + ": generate it again for that type");
  }
  return node.create_publisher<Message>("output", qos);
}

template <typename Taken>
auto subscribe(rclcpp::Node & node, const std::string &, const rclcpp::QoS & qos, Taken taken) {
  return node.create_subscription<Message>("input", qos, taken);
}

bool take(rclcpp::Subscription<Message> & input, Message & message, rclcpp::MessageInfo & info) {
  return input.take(message, info);
}

void execute(rclcpp::Subscription<Message> & input, const std::shared_ptr<Message> & message,
             const rclcpp::MessageInfo & info) {
  std::shared_ptr<void> untyped = message;
  input.handle_message(untyped, info);
}

void publish(rclcpp::Publisher<Message> & output, const Message & message) {
  output.publish(message);
}

}  // namespace

#else
#include "chainshaper_shaping/serialized.hpp"

namespace {

using Message = rclcpp::SerializedMessage;

chainshaper::Maybe stamp_of(const Message & message) {
  const auto & bytes = message.get_rcl_serialized_message();
  return chainshaper::origin_of(bytes.buffer, bytes.buffer_length);
}

auto make_publisher(rclcpp::Node & node, const std::string & type, const rclcpp::QoS & qos) {
  return node.create_generic_publisher("output", type, qos);
}

auto subscribe(rclcpp::Node & node, const std::string & type, const rclcpp::QoS & qos,
               chainshaper::Taken taken) {
  return chainshaper::subscribe_serialized(node, "input", type, qos, std::move(taken));
}

bool take(rclcpp::GenericSubscription & input, Message & message, rclcpp::MessageInfo & info) {
  return input.take_serialized(message, info);
}

void execute(rclcpp::GenericSubscription & input, const std::shared_ptr<Message> & message,
             const rclcpp::MessageInfo & info) {
  input.handle_serialized_message(message, info);
}

void publish(rclcpp::GenericPublisher & output, const Message & message) {
  chainshaper::publish_serialized(output, message);
}

}  // namespace
#endif

int main(int argc, char ** argv) {
  using Pointer = std::shared_ptr<Message>;
  std::optional<chainshaper::Shaping<Message>> shaping;
  return chainshaper::run(
      argc, argv, "chainshaper_shaping", [&](rclcpp::Node & node) -> std::function<bool()> {
        auto turn = chainshaper::turn_of(node);
        const auto offer = chainshaper::wait_for_publisher(node, "input");
        if (!offer) return {};
        shaping.emplace(node, *offer, std::move(turn));
        const auto output = make_publisher(node, offer->type, shaping->offered(offer->publisher));
        shaping->listen_to_modes();
        const auto input = subscribe(node, offer->type, shaping->asked(offer->subscription),
                                     [&](Pointer message, const rclcpp::MessageInfo & info) {
                                       shaping->shape(std::move(message), info);
                                     });
        shaping->connect({input,
                          [input](rclcpp::MessageInfo & info) {
                            auto message = std::make_shared<Message>();
                            return take(*input, *message, info) ? message : nullptr;
                          },
                          [](const Message & message) { return stamp_of(message); },
                          [output](const Message & message) { publish(*output, message); },
                          [input](const Pointer & message, const rclcpp::MessageInfo & info) {
                            execute(*input, message, info);
                          }});
        if (!shaping->await_receivers(*output)) return {};
        return [&] { return shaping->work_off(); };
      });
}
