// What the shaping nodes and the throttler have in common on the side of ROS 2: parameters, the
// quality of service of a topic's publisher, serialized messages, and real-time scheduling of the
// calling thread. Written for Humble to Rolling; where they differ, it is said.

#pragma once

#include <sys/mman.h>

#include <atomic>
#include <chrono>
#include <csignal>
#include <cstring>
#include <memory>

#include "rclcpp/rclcpp.hpp"
#include "rclcpp/version.h"
#include "shaper.hpp"

#if !RCLCPP_VERSION_GTE(25, 0, 0)
#include "rcl/subscription.h"
#include "tracetools/tracetools.h"
#endif

namespace chainshaper {

inline Parameters parameters_of(rclcpp::Node & node) {
  Parameters found;
  found.each([&](const char * name, auto & value) {
    const auto otherwise = value;
    node.get_parameter_or(name, value, otherwise);
  });
  return found;
}

// A publisher as others know it, and the QoS with which to subscribe to it and to stand in for it.
struct Offer {
  std::string type;
  rclcpp::QoS subscription;
  rclcpp::QoS publisher;
};

// What discovery does not tell is taken to be as in `offered_by` of chainshaper's Python node.
inline Offer offer_of(const rclcpp::TopicEndpointInfo & info, std::size_t depth) {
  rmw_qos_profile_t offered = info.qos_profile().get_rmw_qos_profile();
  if (offered.history != RMW_QOS_POLICY_HISTORY_KEEP_ALL) {
    offered.history = RMW_QOS_POLICY_HISTORY_KEEP_LAST;
    offered.depth = offered.depth == 0 ? depth : offered.depth;
  }
  if (offered.reliability != RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT)
    offered.reliability = RMW_QOS_POLICY_RELIABILITY_RELIABLE;
  if (offered.durability != RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL)
    offered.durability = RMW_QOS_POLICY_DURABILITY_VOLATILE;
  if (offered.liveliness != RMW_QOS_POLICY_LIVELINESS_MANUAL_BY_TOPIC)
    offered.liveliness = RMW_QOS_POLICY_LIVELINESS_AUTOMATIC;
  const auto history = rclcpp::QoSInitialization::from_rmw(offered);
  rclcpp::QoS asked(history);
  asked.reliability(offered.reliability).durability(offered.durability);
  return {info.topic_type(), asked, rclcpp::QoS(history, offered)};
}

// Set in the thread of a component, which is to stop when it is unloaded.
inline thread_local const std::atomic<bool> * unloaded = nullptr;

inline bool goes_on() { return rclcpp::ok() && (unloaded == nullptr || !*unloaded); }

// What chainshaper knows the thread of a gate in another's process by (`gate_thread_name`).
inline std::string gate_thread_name(const std::string & node) {
  std::uint32_t sum = ~0u;
  for (const char letter : node) {
    sum ^= static_cast<std::uint8_t>(letter);
    for (int bit = 0; bit < 8; ++bit) sum = (sum >> 1) ^ ((sum & 1) != 0 ? 0xEDB88320u : 0u);
  }
  char text[16];
  std::snprintf(text, sizeof(text), "gate-%08x", ~sum);
  return text;
}

// Wait, unless the node is to stop; whether it goes on.
inline bool wait(double seconds) {
  const auto until = monotonic_ns() + static_cast<std::int64_t>(seconds * 1e9);
  while (goes_on() && monotonic_ns() < until)
    sleep_until(std::min(until, monotonic_ns() + 50'000'000));
  return goes_on();
}

// Wait until a topic has a publisher; none when the node is to stop.
inline std::optional<Offer> wait_for_publisher(rclcpp::Node & node, const std::string & topic) {
  const auto depth = static_cast<std::size_t>(parameters_of(node).output_depth);
  const std::string name = node.get_node_topics_interface()->resolve_topic_name(topic);
  for (bool said = false; goes_on(); said = true) {
    const auto found = node.get_publishers_info_by_topic(topic);
    if (!found.empty() && !found[0].topic_type().empty()) {
      if (found.size() > 1)
        RCLCPP_WARN(node.get_logger(), "%s has %zu publishers: the QoS of the first is copied",
                    name.c_str(), found.size());
      const Offer offer = offer_of(found[0], depth);
      RCLCPP_INFO(node.get_logger(), "%s is published by %s/%s as %s", name.c_str(),
                  found[0].node_namespace() == "/" ? "" : found[0].node_namespace().c_str(),
                  found[0].node_name().c_str(), offer.type.c_str());
      return offer;
    }
    if (!said) RCLCPP_INFO(node.get_logger(), "waiting for a publisher of %s", name.c_str());
    wait(0.01);
  }
  return std::nullopt;
}

// Give the calling thread its core and SCHED_FIFO priority, and lock the memory of a process that
// is ours. To be called when all endpoints exist: threads inherit, and those of DDS must not; later
// ones do not get the class.
inline void become_realtime(rclcpp::Node & node) {
  const auto warn = [&](const std::string & what, const char * remedy) {
    RCLCPP_WARN(node.get_logger(), "%s: %s; it works on without: %s", what.c_str(),
                std::strerror(errno), remedy);
  };
  if (unloaded == nullptr && mlockall(MCL_CURRENT | MCL_FUTURE) != 0)
    warn("memory cannot be locked", "give the user a memlock limit of unlimited");
  schedule(parameters_of(node), warn);
}

// Run a node until it is interrupted: `set_up` makes its endpoints and returns what is to be called
// behind each callback, or nothing where it is not to run; that returns whether it wants to be
// called again although nothing has come. The exit code of the process.
template <typename SetUp>
int run(int argc, char ** argv, const std::string & name, SetUp && set_up) {
  // Ctrl-C reaches a node from its terminal, and then again from `ros2 launch`. When rclcpp has
  // seen the first it gives the signal back, as it was before: ignored.
  std::signal(SIGINT, SIG_IGN);
  rclcpp::init(argc, argv);
  // Parameters come from the file only: what is in it, is declared.
  const auto node = std::make_shared<rclcpp::Node>(
      name, rclcpp::NodeOptions().automatically_declare_parameters_from_overrides(true));
  int code = 0;
  try {
    const std::function<bool()> work_off = set_up(*node);
    if (work_off) {
      become_realtime(*node);
      rclcpp::executors::SingleThreadedExecutor executor;
      executor.add_node(node);
      while (rclcpp::ok()) executor.spin_once(std::chrono::nanoseconds(work_off() ? 0 : -1));
    }
  } catch (const std::exception & error) {
    RCLCPP_FATAL(node->get_logger(), "%s", error.what());
    code = 1;
  }
  rclcpp::shutdown();
  return code;
}

// Messages of any type, as they came from the wire: receiving them with their source timestamps,
// and publishing them, so that a tracer sees both.
//
// From Jazzy on rclcpp's generic subscriptions and publishers do all that. Before, their callbacks
// are given the message only (rclcpp issue 1604), and none of rclcpp, rcl and rmw has trace points
// on the way of serialized messages: here they are passed what rclcpp knows, and emit the events
// that Jazzy has. Upstream: ros2_tracing, `tracetools/include/tracetools/tracetools.h`, 4.1.1.

using Taken =
    std::function<void(std::shared_ptr<rclcpp::SerializedMessage>, const rclcpp::MessageInfo &)>;

#if RCLCPP_VERSION_GTE(25, 0, 0)

inline constexpr bool serialized_tells_takes = false;

#else

// Executing a callback emits the event of a take.
inline constexpr bool serialized_tells_takes = true;

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

#endif

inline rclcpp::GenericSubscription::SharedPtr subscribe_serialized(rclcpp::Node & node,
                                                                   const std::string & topic,
                                                                   const std::string & type,
                                                                   const rclcpp::QoS & qos,
                                                                   Taken taken) {
#if RCLCPP_VERSION_GTE(25, 0, 0)
  return node.create_generic_subscription(topic, type, qos, taken);
#else
  auto subscription = std::make_shared<SerializedSubscription>(node, topic, type, qos, taken);
  node.get_node_topics_interface()->add_subscription(subscription, nullptr);
  return subscription;
#endif
}

inline void publish_serialized(rclcpp::GenericPublisher & publisher,
                               const rclcpp::SerializedMessage & message) {
#if !RCLCPP_VERSION_GTE(25, 0, 0)
  const void * content = &message;
  const void * handle = publisher.get_publisher_handle().get();
  TRACEPOINT(rcl_publish, handle, content);
  TRACEPOINT(rmw_publish, content);
#endif
  publisher.publish(message);
}

}  // namespace chainshaper
