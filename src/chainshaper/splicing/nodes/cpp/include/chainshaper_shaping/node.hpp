// What the shaping nodes and the throttler have in common on the side of ROS 2: parameters, the
// quality of service of a topic's publisher, real-time scheduling of the calling thread, and the
// shaping of one message. Written for Humble to Rolling; where they differ, it is said.

#ifndef CHAINSHAPER_SHAPING__NODE_HPP_
#define CHAINSHAPER_SHAPING__NODE_HPP_

#include <dlfcn.h>
#include <sched.h>
#include <sys/mman.h>

#include <algorithm>
#include <chrono>
#include <csignal>
#include <cstring>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "rcl/subscription.h"
#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/string.hpp"

#include "gate.hpp"
#include "gate_log.hpp"
#include "handover.hpp"
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

// Wait, unless the process is to stop; whether it goes on.
inline bool wait(double seconds)
{
  const auto until = monotonic_ns() + static_cast<std::int64_t>(seconds * 1e9);
  while (rclcpp::ok() && monotonic_ns() < until) {
    sleep_until(std::min(until, monotonic_ns() + 50'000'000));
  }
  return rclcpp::ok();
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
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
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

inline Messages messages_named(const std::string & name)
{
  for (std::size_t i = 0; i < messages_names.size(); ++i) {
    if (name == messages_names[i]) {
      return static_cast<Messages>(i);
    }
  }
  throw std::invalid_argument("there is no choice '" + name + "' of messages");
}

inline Gate gate_from(rclcpp::Node & node, const rclcpp::QoS & offered)
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
  gate.messages = messages_named(parameter<std::string>(node, "messages", "all-in-order"));
  const auto depth = parameter<std::int64_t>(node, "depth", 0);
  gate.depth = depth > 0 ? static_cast<std::size_t>(depth) : std::max(gate.depth, offered.depth());
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

// What is agreed with the standby; none: the node is alone, since nothing names a page. After
// several nodes that failed at once this one waits, so that starting over and over does not take a
// core; so this comes before anything that may fail.
inline std::optional<Turn> turn_of(rclcpp::Node & node)
{
  const auto page = parameter<std::string>(node, "handover", "");
  if (page.empty()) {
    return std::nullopt;
  }
  std::optional<Turn> turn;
  try {
    turn.emplace(page, node.get_node_topics_interface()->resolve_topic_name("output"));
  } catch (const std::runtime_error & error) {  // the standby has none either
    RCLCPP_ERROR(
      node.get_logger(), "nothing can be agreed with the standby, which does nothing: %s",
      error.what());
    return std::nullopt;
  }
  if (turn->wait_s() > 0) {
    RCLCPP_WARN(
      node.get_logger(), "has failed %d times: starting in %g s",
      static_cast<int>(turn->failed_before()), turn->wait_s());
    wait(turn->wait_s());
  }
  return turn;
}

// How many messages are missing before each, by its publisher's numbers; none: not known.
class Gaps
{
public:
  std::optional<std::int64_t> before(const rmw_message_info_t & info)
  {
    if (info.publication_sequence_number == RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED) {
      return std::nullopt;
    }
    const auto last = last_;
    last_ = static_cast<std::int64_t>(info.publication_sequence_number);
    // A publisher that is started again counts anew.
    return last ? std::max<std::int64_t>(0, last_.value() - *last - 1) : 0;
  }

private:
  std::optional<std::int64_t> last_;
};

// Emits the event of a take once more, when a callback is executed for its message: others were
// taken meanwhile, and a callback is for the message that was taken last.
inline void take_again(
  const rclcpp::SubscriptionBase & subscription, const void * message,
  std::optional<std::int64_t> source_timestamp)
{
  using Emit = void (*)(const void *, const void *, std::int64_t, bool);
  static const auto emit = reinterpret_cast<Emit>(dlsym(RTLD_DEFAULT, "ros_trace_rmw_take"));
  if (emit != nullptr) {
    const auto handle = subscription.get_subscription_handle();
    emit(
      rcl_subscription_get_rmw_handle(handle.get()), message, source_timestamp.value_or(0), true);
  }
}

// The gate of a node, with everything around it but the topics of the messages.
template<typename Message>
class Shaping
{
public:
  using Pointer = std::shared_ptr<Message>;

  Shaping(rclcpp::Node & node, const Offer & offer, std::optional<Turn> turn)
  : node_(node), pause_ns_(parameter<std::int64_t>(node, "pause_ns", 0)), turn_(std::move(turn)),
    readiness_(node, delivery_core(node), pause_ns_),
    shaper_(
      gate_from(node, offer.publisher), parameter<std::int64_t>(node, "spin_ns", 0),
      [this](std::int64_t release_ns) {readiness_.get_ready(release_ns);}, [] {},
      [this](const Release & release, std::int64_t phase_ns) {
        if (turn_) {
          turn_->hold(release.at_ns, phase_ns, release.mode);
        }
      })
  {
    if (turn_) {
      go_on();
    }
    const auto log = parameter<std::string>(node, "log", "");
    const auto most_bytes = parameter<std::int64_t>(node, "log_bytes", 100'000'000);
    if (!log.empty() && !log_.open_file(log, most_bytes)) {
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

  // The gate drops what it has no room for, and so counts it: its reader has more of it. What
  // leaves in one slot must find room in the writer, too.
  rclcpp::QoS asked(rclcpp::QoS qos) const {return deeper(qos, std::max(reader_depth, depth()));}
  rclcpp::QoS offered(rclcpp::QoS qos) const
  {
    const bool latched = qos.durability() == rclcpp::DurabilityPolicy::TransientLocal;
    return latched ? qos : deeper(qos, depth());
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

  // Leave the output to the standby, if there is one, until the receivers know this node too: what
  // is published before is lost to them. How far discovery has come at the other side cannot be
  // seen: it is given a little longer. Whether the node is to run.
  template<typename Publisher>
  bool await_receivers(const Publisher & publisher)
  {
    const auto topic = node_.get_node_topics_interface()->resolve_topic_name("output");
    const auto give_up = monotonic_ns() + 2'000'000'000;
    while (turn_ && turn_->has_standby() && rclcpp::ok() && monotonic_ns() < give_up) {
      if (publisher.get_subscription_count() >= node_.count_subscribers(topic)) {
        return wait(0.1);
      }
      wait(0.01);
    }
    return rclcpp::ok();
  }

  // How to take a message without waiting, to read its stamp, to publish it, and to execute the
  // subscription's callback for it.
  struct Topics
  {
    std::shared_ptr<rclcpp::SubscriptionBase> subscription;
    std::function<Pointer(rclcpp::MessageInfo &)> take;
    std::function<std::optional<std::int64_t>(const Message &)> stamp_of;
    std::function<void(const Message &)> publish;
    std::function<void(const Pointer &, const rclcpp::MessageInfo &)> execute;
  };

  void connect(Topics topics)
  {
    topics_ = std::move(topics);
    shaper_.look = [this] {
        rclcpp::MessageInfo info;
        while (const auto message = topics_.take(info)) {
          arrive(message, info.get_rmw_message_info(), true);
        }
      };
  }

  // The subscription's callback: hold the oldest message until its slot, publish it, rest so that
  // it is delivered, and note what was done.
  void shape(Pointer message, const rclcpp::MessageInfo & info)
  {
    if (!its_turn_) {  // the executor took it
      const bool alone = shaper_.queue.waiting.empty();
      arrive(std::move(message), info.get_rmw_message_info(), false);
      if (!alone) {
        return;
      }
    }
    const auto key = shaper_.queue.waiting.front().source_timestamp.value_or(0);
    if (turn_ && !turn_->take(key)) {
      shaper_.queue.leave({}, monotonic_ns());
      return;
    }
    const auto held = shaper_.hold();
    if (!held) {
      return;
    }
    if (turn_ && turn_->was_bypassed(key)) {
      readiness_.relax();
      return;
    }
    std::optional<std::int64_t> published_ns;
    std::optional<std::int64_t> stalled_ns;
    if (held->release.at_ns) {
      try {
        topics_.publish(*held->waiting.message);
      } catch (const rclcpp::exceptions::RCLError &) {
        if (rclcpp::ok()) {
          throw;
        }
        return;  // it was interrupted meanwhile; to ask before publishing would cost time
      }
      published_ns = monotonic_ns();
      if (turn_) {
        turn_->done(key);
      }
      stalled_ns = shaper_.time_lost(*held);
      shaper_.rest(*published_ns, pause_ns_);
    } else if (turn_) {
      turn_->done(key);
    }
    readiness_.relax();
    note(*held, published_ns, stalled_ns);
  }

  // Deal with what waits at the gate, each by the subscription's callback, until there is time for
  // the node's other callbacks; whether some are left.
  bool work_off()
  {
    for (bool served = false; rclcpp::ok(); served = true) {
      for (const auto & gone : shaper_.overflowed) {
        note(gone);
      }
      shaper_.overflowed.clear();
      if (shaper_.queue.waiting.empty() || (served && shaper_.nothing_due())) {
        break;
      }
      const auto oldest = shaper_.queue.waiting.front();
      take_again(*topics_.subscription, oldest.message.get(), oldest.source_timestamp);
      its_turn_ = true;
      topics_.execute(oldest.message, rclcpp::MessageInfo());
      its_turn_ = false;
    }
    return !shaper_.queue.waiting.empty();
  }

private:
  static constexpr std::size_t reader_depth = 1000;

  std::size_t depth() const {return shaper_.queue.gate.depth;}

  static rclcpp::QoS deeper(rclcpp::QoS qos, std::size_t depth)
  {
    if (qos.history() == rclcpp::HistoryPolicy::KeepLast) {
      qos.keep_last(std::max(depth, qos.depth()));
    }
    return qos;
  }

  void arrive(Pointer message, const rmw_message_info_t & info, bool waited)
  {
    const auto stamp = topics_.stamp_of(*message);
    const auto before = shaper_.overflowed.size();
    shaper_.arrive(std::move(message), stamp, info.source_timestamp, waited, gaps_.before(info));
    if (!turn_ || shaper_.overflowed.size() == before) {
      return;
    }
    const auto gone = shaper_.overflowed.back().waiting.source_timestamp.value_or(0);
    if (turn_->was_bypassed(gone)) {
      shaper_.overflowed.pop_back();
    } else {
      turn_->drop(gone);
    }
  }

  // Losses are said when they happen, at most every ten seconds.
  void note(
    const Held<Pointer> & held, std::optional<std::int64_t> published_ns = {},
    std::optional<std::int64_t> stalled_ns = {})
  {
    log_.write(shaper_.queue.gate, held, published_ns, stalled_ns);
    if (turn_) {
      turn_->count(held.dropped, held.waiting.lost, held.release.overrun.has_value());
    }
    const std::int64_t now = monotonic_ns();
    if (said_ns_ != 0 && now - said_ns_ < 10'000'000'000) {
      return;
    }
    const std::string losses = log_.losses();
    if (losses != said_) {
      RCLCPP_WARN(
        node_.get_logger(), "of %llu messages so far: %s",
        static_cast<unsigned long long>(log_.rows), losses.c_str());  // NOLINT(runtime/int)
      said_ = losses;
      said_ns_ = now;
    }
  }

  // Have cycles begin where they did for the node before this one, in its mode.
  void go_on()
  {
    const auto & gate = shaper_.queue.gate;
    if (const auto phase = turn_->phase_ns()) {
      shaper_.set_phase(*phase, monotonic_ns() - gate.cycle_ns);  // from now on, not the next cycle
    }
    if (const auto mode = turn_->mode(); gate.modes && mode && *mode < gate.modes->names.size()) {
      shaper_.announce(gate.modes->names[*mode], 0);
    }
  }

  rclcpp::Node & node_;
  std::int64_t pause_ns_;
  std::optional<Turn> turn_;
  Readiness readiness_;
  Shaper<Pointer> shaper_;
  GateLog log_;
  Gaps gaps_;
  Topics topics_;
  bool its_turn_{false};  // of the oldest message
  std::string said_;
  std::int64_t said_ns_{0};
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr phase_;
  rclcpp::Subscription<std_msgs::msg::String>::SharedPtr modes_;
};

// Run a node until it is interrupted: `set_up` makes its endpoints and returns what is to be called
// behind each callback, or nothing where it is not to run; that returns whether it wants to be called
// again although nothing has come. The exit code of the process.
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
    const std::function<bool()> work_off = set_up(*node);
    if (work_off) {
      become_realtime(*node);
      rclcpp::executors::SingleThreadedExecutor executor;
      executor.add_node(node);
      while (rclcpp::ok()) {
        executor.spin_once(std::chrono::nanoseconds(work_off() ? 0 : -1));
      }
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
