// Messages of any type, as they came from the wire: receiving them with their source timestamps,
// and publishing them, so that a tracer sees both.
//
// From Jazzy on rclcpp's generic subscriptions and publishers do all that. Before, their callbacks
// are given the message only (rclcpp issue 1604), and none of rclcpp, rcl and rmw has trace points
// on the way of serialized messages: here they are passed what rclcpp knows, and emit the events
// that Jazzy has. Upstream: ros2_tracing, `tracetools/include/tracetools/tracetools.h`, 4.1.1.

#pragma once

#include <functional>
#include <memory>
#include <string>

#include "rclcpp/rclcpp.hpp"
#include "rclcpp/version.h"

#if !RCLCPP_VERSION_GTE(25, 0, 0)
#include "rcl/subscription.h"
#include "tracetools/tracetools.h"
#endif

namespace chainshaper {

using Taken =
    std::function<void(std::shared_ptr<rclcpp::SerializedMessage>, const rclcpp::MessageInfo &)>;

#if RCLCPP_VERSION_GTE(25, 0, 0)

inline rclcpp::GenericSubscription::SharedPtr subscribe_serialized(rclcpp::Node & node,
                                                                   const std::string & topic,
                                                                   const std::string & type,
                                                                   const rclcpp::QoS & qos,
                                                                   Taken taken) {
  return node.create_generic_subscription(topic, type, qos, taken);
}

inline void publish_serialized(rclcpp::GenericPublisher & publisher,
                               const rclcpp::SerializedMessage & message) {
  publisher.publish(message);
}

#else

class SerializedSubscription : public rclcpp::GenericSubscription {
public:
  SerializedSubscription(rclcpp::Node & node, const std::string & topic, const std::string & type,
                         const rclcpp::QoS & qos, Taken taken)
      : GenericSubscription(
            node.get_node_base_interface().get(),
            rclcpp::get_typesupport_library(type, "rosidl_typesupport_cpp"), topic, type, qos,
            [](std::shared_ptr<rclcpp::SerializedMessage>) {}, rclcpp::SubscriptionOptions()),
        taken_(taken) {
    const void * handle = get_subscription_handle().get();
    TRACEPOINT(rclcpp_subscription_init, handle, static_cast<const void *>(this));
    TRACEPOINT(rclcpp_subscription_callback_added, static_cast<const void *>(this),
               static_cast<const void *>(&taken_));
  }

  void handle_serialized_message(const std::shared_ptr<rclcpp::SerializedMessage> & message,
                                 const rclcpp::MessageInfo & info) override {
    const auto source_timestamp = info.get_rmw_message_info().source_timestamp;
    const void * handle = rcl_subscription_get_rmw_handle(get_subscription_handle().get());
    const void * callback = &taken_;
    TRACEPOINT(rmw_take, handle, static_cast<const void *>(message.get()), source_timestamp, true);
    TRACEPOINT(callback_start, callback, false);
    taken_(message, info);
    TRACEPOINT(callback_end, callback);
  }

private:
  Taken taken_;
};

inline rclcpp::GenericSubscription::SharedPtr subscribe_serialized(rclcpp::Node & node,
                                                                   const std::string & topic,
                                                                   const std::string & type,
                                                                   const rclcpp::QoS & qos,
                                                                   Taken taken) {
  auto subscription = std::make_shared<SerializedSubscription>(node, topic, type, qos, taken);
  node.get_node_topics_interface()->add_subscription(subscription, nullptr);
  return subscription;
}

inline void publish_serialized(rclcpp::GenericPublisher & publisher,
                               const rclcpp::SerializedMessage & message) {
  const void * content = &message;
  const void * handle = publisher.get_publisher_handle().get();
  TRACEPOINT(rcl_publish, handle, content);
  TRACEPOINT(rmw_publish, content);
  publisher.publish(message);
}

#endif

}  // namespace chainshaper
