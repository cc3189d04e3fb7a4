// What the shaping nodes and the throttler share on the side of ROS 2: parameters, the quality of
// service of a topic's publisher, serialized messages, and real-time scheduling of the calling
// thread. For Humble to Rolling; comments name the distributions that differ.

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

// Returns a node's parameters, with defaults for those that its file does not have.
inline Parameters parameters_of(rclcpp::Node & node) {
  Parameters parameters;
  parameters.each([&](const char * name, auto & value) {
    const auto default_value = value;
    node.get_parameter_or(name, value, default_value);
  });
  return parameters;
}

// A publisher as other nodes know it: its type, the QoS of a subscription to it, and the QoS of a
// publisher in its place.
struct Offer {
  std::string type;
  rclcpp::QoS subscription;
  rclcpp::QoS publisher;
};

// Returns what a publisher offers. For what discovery does not tell, it assumes the same as
// `offered_by` of chainshaper's Python node.
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

// In the thread of a component: whether the component is unloaded, and the thread has to stop.
inline thread_local const std::atomic<bool> * unloaded = nullptr;

inline bool goes_on() { return rclcpp::ok() && (unloaded == nullptr || !*unloaded); }

// Returns the name of a gate's thread in a process of the robot, by which chainshaper finds it
// (`gate_thread_name` in Python).
inline std::string gate_thread_name(const std::string & node) {
  std::uint32_t sum = ~0u;
  for (const char letter : node) {
    sum ^= static_cast<std::uint8_t>(letter);
    for (int bit = 0; bit < 8; ++bit) sum = (sum >> 1) ^ ((sum & 1) != 0 ? 0xEDB88320u : 0u);
  }
  char text[16]{};
  std::snprintf(text, sizeof(text), "gate-%08x", ~sum);
  return text;
}

// Waits, at most until the node has to stop; returns whether it goes on.
inline bool wait(double seconds) {
  const auto until = monotonic_ns() + static_cast<std::int64_t>(seconds * 1e9);
  while (goes_on() && monotonic_ns() < until)
    sleep_until(std::min(until, monotonic_ns() + 50'000'000));
  return goes_on();
}

// Waits until a topic has a publisher, and returns what that offers; none: the node has to stop.
inline std::optional<Offer> wait_for_publisher(rclcpp::Node & node, const std::string & topic) {
  const auto depth = static_cast<std::size_t>(parameters_of(node).output_depth);
  const std::string name = node.get_node_topics_interface()->resolve_topic_name(topic);
  for (bool is_reported = false; goes_on(); is_reported = true) {
    const auto publishers = node.get_publishers_info_by_topic(topic);
    if (!publishers.empty() && !publishers[0].topic_type().empty()) {
      const auto & first = publishers[0];
      if (publishers.size() > 1)
        RCLCPP_WARN(node.get_logger(), "%s has %zu publishers: the QoS of the first is copied",
                    name.c_str(), publishers.size());
      Offer offer = offer_of(first, depth);
      RCLCPP_INFO(node.get_logger(), "%s is published by %s/%s as %s", name.c_str(),
                  first.node_namespace() == "/" ? "" : first.node_namespace().c_str(),
                  first.node_name().c_str(), offer.type.c_str());
      return offer;
    }
    if (!is_reported) RCLCPP_INFO(node.get_logger(), "waiting for a publisher of %s", name.c_str());
    wait(0.01);
  }
  return std::nullopt;
}

// Gives the calling thread its core and SCHED_FIFO priority; locks the memory, but not that of the
// robot's process. To be called when all endpoints exist: new threads inherit the core, and threads
// of DDS must not. (They do not inherit the priority.)
inline void become_realtime(rclcpp::Node & node) {
  const auto warn = [&](const std::string & problem, const char * remedy) {
    RCLCPP_WARN(node.get_logger(), "%s: %s; it works on without: %s", problem.c_str(),
                std::strerror(errno), remedy);
  };
  if (unloaded == nullptr && mlockall(MCL_CURRENT | MCL_FUTURE) != 0)
    warn("memory cannot be locked", "give the user a memlock limit of unlimited");
  schedule(parameters_of(node), warn);
}

// Runs a node until it is interrupted; returns the exit code of the process. `set_up` makes the
// node's endpoints and returns a function, or nothing where the node has to stop. The function is
// called behind each callback; it returns true to be called again before another message comes.
template <typename SetUp>
int run(int argc, char ** argv, const std::string & name, SetUp && set_up) {
  // Ctrl-C reaches a node from its terminal, and then again from `ros2 launch`. After the first one
  // rclcpp restores what the signal did before: nothing.
  std::signal(SIGINT, SIG_IGN);
  rclcpp::init(argc, argv);
  // The file declares the parameters.
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

// Serialized messages of any type: what follows receives them with their source timestamps, and
// publishes them, so that a tracer sees both.
//
// From Jazzy on rclcpp's generic subscriptions and publishers do all that. Before Jazzy, a callback
// gets the message only (rclcpp issue 1604), and neither rclcpp nor rcl nor rmw has trace points on
// the way of serialized messages: the code below passes on what rclcpp knows, and emits the events
// that Jazzy has. Upstream: ros2_tracing, `tracetools/include/tracetools/tracetools.h`, 4.1.1.

using Taken =
    std::function<void(std::shared_ptr<rclcpp::SerializedMessage>, const rclcpp::MessageInfo &)>;

#if RCLCPP_VERSION_GTE(25, 0, 0)

inline constexpr bool serialized_tells_takes = false;

#else

// Whether the execution of a callback emits the event of a take.
inline constexpr bool serialized_tells_takes = true;

class SerializedSubscription : public rclcpp::GenericSubscription {
public:
  SerializedSubscription(rclcpp::Node & node, const std::string & topic, const std::string & type,
                         const rclcpp::QoS & qos, const Taken & taken)
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
                                                                   const Taken & taken) {
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
