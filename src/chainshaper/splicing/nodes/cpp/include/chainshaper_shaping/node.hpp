// What the shaping nodes and the throttler have in common on the side of ROS 2: parameters, the
// quality of service of a topic's publisher, real-time scheduling of the calling thread, and the
// shaping of one message. Written for Humble to Rolling; where they differ, it is said.

#ifndef CHAINSHAPER_SHAPING__NODE_HPP_
#define CHAINSHAPER_SHAPING__NODE_HPP_

#include <sched.h>
#include <sys/mman.h>

#include <algorithm>
#include <chrono>
#include <csignal>
#include <cstring>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/string.hpp"

#include "gate.hpp"
#include "gate_log.hpp"
#include "readiness.hpp"
#include "shaper.hpp"

namespace chainshaper
{

template<typename T>
T parameter(rclcpp::Node & node, const std::string & name, const T & otherwise)
{
  T value{};
  node.get_parameter_or(name, value, otherwise);
  return value;
}

// Parameters come from the file only: what is in it, is declared.
inline std::shared_ptr<rclcpp::Node> make_node(const std::string & name)
{
  return std::make_shared<rclcpp::Node>(
    name, rclcpp::NodeOptions().automatically_declare_parameters_from_overrides(true));
}

// A publisher as others know it, and the QoS with which to subscribe to it and to stand in for it.
struct Offer
{
  std::string type;
  rclcpp::QoS subscription;
  rclcpp::QoS publisher;
};

// Discovery does not always tell everything: unknown reliability is taken to be reliable, unknown
// durability volatile, unknown liveliness automatic, and an unknown history keeps the last
// `depth`. A subscription asks for reliability and durability only: that fits every publisher
// that offers them.
inline Offer offer_of(const rclcpp::TopicEndpointInfo & info, std::size_t depth)
{
  rmw_qos_profile_t offered = info.qos_profile().get_rmw_qos_profile();
  if (offered.history != RMW_QOS_POLICY_HISTORY_KEEP_ALL) {
    offered.history = RMW_QOS_POLICY_HISTORY_KEEP_LAST;
    offered.depth = offered.depth == 0 ? depth : offered.depth;
  }
  if (offered.reliability != RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT) {
    offered.reliability = RMW_QOS_POLICY_RELIABILITY_RELIABLE;
  }
  if (offered.durability != RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL) {
    offered.durability = RMW_QOS_POLICY_DURABILITY_VOLATILE;
  }
  if (offered.liveliness != RMW_QOS_POLICY_LIVELINESS_MANUAL_BY_TOPIC) {
    offered.liveliness = RMW_QOS_POLICY_LIVELINESS_AUTOMATIC;
  }
  const auto history = rclcpp::QoSInitialization::from_rmw(offered);
  rclcpp::QoS asked(history);
  asked.reliability(offered.reliability).durability(offered.durability);
  return {info.topic_type(), asked, rclcpp::QoS(history, offered)};
}

// Wait until somebody publishes a topic; none when the process is to stop.
inline std::optional<Offer> wait_for_publisher(
  rclcpp::Node & node, const std::string & topic, std::size_t depth)
{
  const std::string name = node.get_node_topics_interface()->resolve_topic_name(topic);
  bool said = false;
  while (rclcpp::ok()) {
    const auto found = node.get_publishers_info_by_topic(topic);
    if (!found.empty() && !found[0].topic_type().empty()) {
      if (found.size() > 1) {
        RCLCPP_WARN(
          node.get_logger(), "%s has %zu publishers: the QoS of the first is copied",
          name.c_str(), found.size());
      }
      const Offer offer = offer_of(found[0], depth);
      RCLCPP_INFO(
        node.get_logger(), "%s is published by %s/%s as %s", name.c_str(),
        found[0].node_namespace() == "/" ? "" : found[0].node_namespace().c_str(),
        found[0].node_name().c_str(), offer.type.c_str());
      return offer;
    }
    if (!said) {
      RCLCPP_INFO(node.get_logger(), "waiting for a publisher of %s", name.c_str());
      said = true;
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(50));
  }
  return std::nullopt;
}

// Lock the memory and give the calling thread its core and SCHED_FIFO priority, as the parameters
// `core` and `fifo_priority` say. To be called when all endpoints exist: threads inherit, and those
// of DDS must not; later ones do not get the class. What is not permitted is warned of.
inline void become_realtime(rclcpp::Node & node)
{
  const auto core = parameter<std::int64_t>(node, "core", -1);
  const auto priority = parameter<std::int64_t>(node, "fifo_priority", 0);
  const auto warn = [&](const char * what, const char * remedy) {
      RCLCPP_WARN(
        node.get_logger(), "%s: %s; it works on without: %s", what, std::strerror(errno), remedy);
    };
  if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0) {
    warn("memory cannot be locked", "give the user a memlock limit of unlimited");
  }
  if (priority > 0) {
    sched_param wanted{};
    wanted.sched_priority = static_cast<int>(priority);
    if (sched_setscheduler(0, SCHED_FIFO | SCHED_RESET_ON_FORK, &wanted) != 0) {
      warn("SCHED_FIFO is refused", "give the user an rtprio limit of 98");
    }
  }
  if (core >= 0) {
    cpu_set_t cores;
    CPU_ZERO(&cores);
    CPU_SET(static_cast<std::size_t>(core), &cores);
    if (sched_setaffinity(0, sizeof(cores), &cores) != 0) {
      warn("the core is refused", "name another in the plan");
    }
  }
}

inline Policy policy_named(const std::string & name)
{
  for (std::size_t i = 0; i < policy_names.size(); ++i) {
    if (name == policy_names[i]) {
      return static_cast<Policy>(i);
    }
  }
  throw std::invalid_argument("there is no policy '" + name + "' for late messages");
}

inline Gate gate_from(rclcpp::Node & node)
{
  using Numbers = std::vector<std::int64_t>;
  Gate gate;
  const auto bounds = parameter<Numbers>(node, "slots_ns", {});
  for (std::size_t i = 0; i + 1 < bounds.size(); i += 2) {
    gate.slots.push_back({bounds[i], bounds[i + 1]});
  }
  gate.cycle_ns = parameter<std::int64_t>(node, "cycle_ns", 0);
  gate.phase_ns = parameter<std::int64_t>(node, "phase_ns", 0);
  gate.due_cycles = parameter<std::int64_t>(node, "due_cycles", 0);
  gate.overrun = policy_named(parameter<std::string>(node, "overrun", "wait"));
  const bool by_stamp = parameter<std::string>(node, "anchor", "stamp") == "stamp";
  gate.anchor = by_stamp ? Anchor::stamp : Anchor::cycle;
  if (!parameter<std::string>(node, "mode_topic", "").empty()) {
    Modes modes;
    modes.names = parameter<std::vector<std::string>>(node, "mode_names", {});
    for (const auto slot : parameter<Numbers>(node, "mode_slots", {})) {
      modes.bands.push_back(static_cast<std::size_t>(slot));
    }
    const auto initial = modes.find(parameter<std::string>(node, "mode_default", ""));
    modes.initial = initial.value_or(modes.names.size());
    modes.late = policy_named(parameter<std::string>(node, "mode_late", "wait"));
    gate.modes = modes;
  }
  return gate;
}

// Where DDS threads deliver the output: the first core that is ours to use and has no server. None
// where the plan does not name its servers' cores, because it leaves receivers alone.
inline std::optional<std::size_t> delivery_core(rclcpp::Node & node)
{
  const auto taken = parameter<std::vector<std::int64_t>>(node, "server_cores", {});
  cpu_set_t ours;
  if (taken.empty() || sched_getaffinity(0, sizeof(ours), &ours) != 0) {
    return std::nullopt;
  }
  for (std::size_t core = 0; core < CPU_SETSIZE; ++core) {
    const auto number = static_cast<std::int64_t>(core);
    if (CPU_ISSET(core, &ours) && std::find(taken.begin(), taken.end(), number) == taken.end()) {
      return core;
    }
  }
  return std::nullopt;
}

// The gate of a node, with everything around it but the topics of the messages.
class Shaping
{
public:
  explicit Shaping(rclcpp::Node & node)
  : node_(node), pause_ns_(parameter<std::int64_t>(node, "pause_ns", 0)),
    readiness_(node, delivery_core(node), pause_ns_),
    shaper_(
      gate_from(node), parameter<std::int64_t>(node, "spin_ns", 0),
      [this](std::int64_t release_ns) {readiness_.get_ready(release_ns);})
  {
    const auto log = parameter<std::string>(node, "log", "");
    if (!log.empty() && !log_.open_file(log)) {
      RCLCPP_WARN(
        node.get_logger(), "no log is written to %s: %s", log.c_str(), std::strerror(errno));
    }
    phase_ = node.add_on_set_parameters_callback(
      [this](const std::vector<rclcpp::Parameter> & changed) {
        for (const auto & parameter : changed) {
          if (parameter.get_name() == "phase_ns") {
            shaper_.set_phase(parameter.as_int(), monotonic_ns());
          }
        }
        rcl_interfaces::msg::SetParametersResult result;
        result.successful = true;
        return result;
      });
  }

  // To be called when discovery has had its time. A mode that was announced before is only
  // delivered when it is asked for, and only if its publisher keeps it.
  void listen_to_modes()
  {
    const auto topic = parameter<std::string>(node_, "mode_topic", "");
    if (topic.empty()) {
      return;
    }
    rclcpp::QoS qos(10);
    for (const auto & info : node_.get_publishers_info_by_topic(topic)) {
      if (info.qos_profile().durability() == rclcpp::DurabilityPolicy::TransientLocal) {
        qos.transient_local();
      }
    }
    modes_ = node_.create_subscription<std_msgs::msg::String>(
      topic, qos, [this](std::shared_ptr<const std_msgs::msg::String> mode) {
        if (shaper_.announce(mode->data, monotonic_ns())) {
          RCLCPP_INFO(node_.get_logger(), "mode %s", mode->data.c_str());
        } else {
          RCLCPP_WARN(node_.get_logger(), "there is no mode '%s'", mode->data.c_str());
        }
      });
  }

  // Hold a message until its slot, publish it, rest so that it is delivered, and note what was
  // done. One that waited for another cycle is followed at once by the next: no rest.
  template<typename Publish>
  void shape(
    std::optional<std::int64_t> stamp_ns, std::optional<std::int64_t> source_timestamp,
    Publish && publish)
  {
    const Held held = shaper_.hold(stamp_ns);
    std::optional<std::int64_t> published_ns;
    std::optional<std::int64_t> stalled_ns;
    if (held.release.at_ns) {
      try {
        publish();
      } catch (const rclcpp::exceptions::RCLError &) {
        if (rclcpp::ok()) {
          throw;
        }
        return;  // it was interrupted meanwhile; to ask before publishing would cost time
      }
      published_ns = monotonic_ns();
      stalled_ns = shaper_.time_lost(held);
      if (!held.release.overrun) {
        sleep_until(*published_ns + pause_ns_);
      }
    }
    readiness_.relax();
    log_.write(shaper_.gate(), held, source_timestamp, published_ns, stalled_ns);
  }

private:
  rclcpp::Node & node_;
  std::int64_t pause_ns_;
  Readiness readiness_;
  Shaper shaper_;
  GateLog log_;
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr phase_;
  rclcpp::Subscription<std_msgs::msg::String>::SharedPtr modes_;
};

// Run a node until it is interrupted: `set_up` makes its endpoints and returns whether it is to
// run. The exit code of the process.
template<typename SetUp>
int run(int argc, char ** argv, const std::string & name, SetUp && set_up)
{
  // Ctrl-C reaches a node from its terminal, and then again from `ros2 launch`. When rclcpp has
  // seen the first it gives the signal back, as it was before: ignored.
  std::signal(SIGINT, SIG_IGN);
  rclcpp::init(argc, argv);
  auto node = make_node(name);
  int code = 0;
  try {
    if (set_up(*node)) {
      become_realtime(*node);
      rclcpp::spin(node);
    }
  } catch (const std::exception & error) {
    RCLCPP_FATAL(node->get_logger(), "%s", error.what());
    code = 1;
  }
  rclcpp::shutdown();
  return code;
}

}  // namespace chainshaper

#endif  // CHAINSHAPER_SHAPING__NODE_HPP_
