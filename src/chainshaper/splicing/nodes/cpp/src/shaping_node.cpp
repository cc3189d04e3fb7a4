// The latency-shaping node: what it receives on `input` it republishes on `output` in the slots of
// its server (Managing End-to-End Timing Jitters in ROS2 Computation Chains, section 3.2.2), as
// chainshaper's Python node, which explains it. One source for two packages: with `message.hpp` it
// is for that type of message, without it for any, byte for byte.

#include <dlfcn.h>

#include <type_traits>

#include "chainshaper_shaping/gate_log.hpp"
#include "chainshaper_shaping/handover.hpp"
#include "chainshaper_shaping/readiness.hpp"
#include "rcl/subscription.h"
#include "std_msgs/msg/string.hpp"

#if __has_include("message.hpp")
#include "message.hpp"

namespace {

using chainshaper::Message;
using Publisher = rclcpp::Publisher<Message>;
using Input = rclcpp::Subscription<Message>;

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

bool take(Input & input, Message & message, rclcpp::MessageInfo & info) {
  return input.take(message, info);
}

void execute(Input & input, const std::shared_ptr<Message> & message,
             const rclcpp::MessageInfo & info) {
  std::shared_ptr<void> untyped = message;
  input.handle_message(untyped, info);
}

void publish(Publisher & output, const Message & message) { output.publish(message); }

}  // namespace

#else
namespace {

using Message = rclcpp::SerializedMessage;
using Publisher = rclcpp::GenericPublisher;
using Input = rclcpp::GenericSubscription;

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

bool take(Input & input, Message & message, rclcpp::MessageInfo & info) {
  return input.take_serialized(message, info);
}

void execute(Input & input, const std::shared_ptr<Message> & message,
             const rclcpp::MessageInfo & info) {
  input.handle_serialized_message(message, info);
}

void publish(Publisher & output, const Message & message) {
  chainshaper::publish_serialized(output, message);
}

}  // namespace
#endif

namespace {

using namespace chainshaper;  // NOLINT

// Where DDS threads deliver the output: the first core that is ours to use and has no server.
std::optional<std::size_t> delivery_core(const std::vector<std::int64_t> & taken) {
  cpu_set_t ours;
  if (taken.empty() || sched_getaffinity(0, sizeof(ours), &ours) != 0) return std::nullopt;
  for (std::size_t core = 0; core < CPU_SETSIZE; ++core) {
    const auto number = static_cast<std::int64_t>(core);
    if (CPU_ISSET(core, &ours) && std::find(taken.begin(), taken.end(), number) == taken.end())
      return core;
  }
  return std::nullopt;
}

// What is agreed with the standby; none: the node is alone, since nothing names a page.
std::optional<Turn> turn_of(rclcpp::Node & node) {
  const auto page = parameters_of(node).handover;
  if (page.empty()) return std::nullopt;
  std::optional<Turn> turn;
  try {
    turn.emplace(page, node.get_node_topics_interface()->resolve_topic_name("output"));
  } catch (const std::runtime_error & error) {  // the standby has none either
    RCLCPP_ERROR(node.get_logger(),
                 "nothing can be agreed with the standby, which does nothing: %s", error.what());
    return std::nullopt;
  }
  if (turn->wait_s() > 0) {
    RCLCPP_WARN(node.get_logger(), "has failed %d times: starting in %g s",
                static_cast<int>(turn->failed_before()), turn->wait_s());
    wait(turn->wait_s());
  }
  return turn;
}

// Emits the event of a take once more, when a callback is executed for its message.
void take_again(const rclcpp::SubscriptionBase & subscription, const void * message,
                Maybe source_timestamp) {
  using Emit = void (*)(const void *, const void *, std::int64_t, bool);
  static const auto emit = reinterpret_cast<Emit>(dlsym(RTLD_DEFAULT, "ros_trace_rmw_take"));
  if (emit != nullptr) {
    const auto handle = subscription.get_subscription_handle();
    emit(rcl_subscription_get_rmw_handle(handle.get()), message, source_timestamp.value_or(0),
         true);
  }
}

// How many messages may wait, by default as many as in the publisher's history.
std::size_t depth_of(const Parameters & parameters, const Offer & offer) {
  if (parameters.depth > 0) return static_cast<std::size_t>(parameters.depth);
  return std::max<std::size_t>(schema::depth, offer.publisher.depth());
}

rclcpp::QoS deeper(rclcpp::QoS qos, std::size_t depth) {
  if (qos.history() == rclcpp::HistoryPolicy::KeepLast) qos.keep_last(std::max(depth, qos.depth()));
  return qos;
}

// The gate of a node, with its endpoints and its log.
class Shaping {
public:
  using Pointer = std::shared_ptr<Message>;

  Shaping(rclcpp::Node & node, const Offer & offer, std::optional<Turn> turn)
      : node_(node),
        parameters_(parameters_of(node)),
        turn_(std::move(turn)),
        readiness_(node, delivery_core(parameters_.server_cores), parameters_.pause_ns),
        shaper_(
            gate_of(parameters_, depth_of(parameters_, offer)), parameters_.spin_ns,
            [this](std::int64_t release_ns) { readiness_.get_ready(release_ns); },
            [this] { look(); },
            [this](const Release & release, std::int64_t phase_ns) {
              if (turn_) turn_->hold(release.at_ns, phase_ns, release.mode);
            }) {
    if (turn_) turn_->go_on(shaper_);
    const auto & log = parameters_.log;
    if (!log.empty() && !log_.open_file(log, parameters_.log_bytes)) {
      RCLCPP_WARN(node.get_logger(), "no log is written to %s: %s", log.c_str(),
                  std::strerror(errno));
    }
    phase_ =
        node.add_on_set_parameters_callback([this](const std::vector<rclcpp::Parameter> & changed) {
          for (const auto & parameter : changed)
            if (parameter.get_name() == "phase_ns")
              shaper_.set_phase(parameter.as_int(), monotonic_ns());
          rcl_interfaces::msg::SetParametersResult result;
          result.successful = true;
          return result;
        });
    const auto depth = depth_of(parameters_, offer);
    const bool latched =
        offer.publisher.durability() == rclcpp::DurabilityPolicy::TransientLocal;
    output_ = make_publisher(node, offer.type,
                             latched ? offer.publisher : deeper(offer.publisher, depth));
    listen_to_modes();
    const auto asked =
        deeper(offer.subscription, std::max<std::size_t>(schema::reader_depth, depth));
    input_ = subscribe(node, offer.type, asked,
                       [this](Pointer message, const rclcpp::MessageInfo & info) {
                         shape(std::move(message), info);
                       });
  }

  // Leave the output to the standby until the receivers know this node too. Whether it is to run.
  bool await_receivers() {
    const auto topic = node_.get_node_topics_interface()->resolve_topic_name("output");
    const auto give_up = monotonic_ns() + 2'000'000'000;
    while (turn_ && turn_->has_standby() && rclcpp::ok() && monotonic_ns() < give_up) {
      if (output_->get_subscription_count() >= node_.count_subscribers(topic)) return wait(0.1);
      wait(0.01);
    }
    return rclcpp::ok();
  }

  // Deal with what waits at the gate; whether some are left.
  bool work_off() {
    for (bool served = false; rclcpp::ok(); served = true) {
      for (const auto & gone : shaper_.overflowed) note(gone);
      shaper_.overflowed.clear();
      if (shaper_.queue.waiting.empty() || (served && shaper_.nothing_due())) break;
      const auto oldest = shaper_.queue.waiting.front();
      take_again(*input_, oldest.message.get(), oldest.source_timestamp);
      its_turn_ = true;
      execute(*input_, oldest.message, rclcpp::MessageInfo());
      its_turn_ = false;
    }
    return !shaper_.queue.waiting.empty();
  }

private:
  // To be called when discovery has had its time.
  void listen_to_modes() {
    const auto & topic = parameters_.mode_topic;
    if (topic.empty()) return;
    rclcpp::QoS qos(10);
    for (const auto & info : node_.get_publishers_info_by_topic(topic))
      if (info.qos_profile().durability() == rclcpp::DurabilityPolicy::TransientLocal)
        qos.transient_local();
    modes_ = node_.create_subscription<std_msgs::msg::String>(
        topic, qos, [this](std::shared_ptr<const std_msgs::msg::String> mode) {
          if (shaper_.announce(mode->data, monotonic_ns()))
            RCLCPP_INFO(node_.get_logger(), "mode %s", mode->data.c_str());
          else
            RCLCPP_WARN(node_.get_logger(), "there is no mode '%s'", mode->data.c_str());
        });
  }

  // The subscription's callback.
  void shape(Pointer message, const rclcpp::MessageInfo & info) {
    if (!its_turn_) {  // the executor took it
      const bool alone = shaper_.queue.waiting.empty();
      arrive(std::move(message), info.get_rmw_message_info(), false);
      if (!alone) return;
    }
    const auto key = shaper_.queue.waiting.front().source_timestamp.value_or(0);
    if (turn_ && !turn_->take(key)) {
      shaper_.queue.leave({}, monotonic_ns());
      return;
    }
    const auto outcome = shaper_.hold();
    if (!outcome) return;
    if (turn_ && turn_->was_bypassed(key)) {
      readiness_.relax();
      return;
    }
    Maybe published_ns;
    Maybe stalled_ns;
    if (outcome->release.at_ns) {
      try {
        publish(*output_, *outcome->waiting.message);
      } catch (const rclcpp::exceptions::RCLError &) {
        if (rclcpp::ok()) throw;
        return;  // it was interrupted meanwhile; to ask before publishing would cost time
      }
      published_ns = monotonic_ns();
    }
    if (turn_) turn_->done(key);
    if (published_ns) {
      stalled_ns = shaper_.time_lost(*outcome);
      shaper_.rest(*published_ns, parameters_.pause_ns);
    }
    readiness_.relax();
    note(*outcome, published_ns, stalled_ns);
  }

  // Take all that has come.
  void look() {
    rclcpp::MessageInfo info;
    for (auto message = std::make_shared<Message>(); take(*input_, *message, info);
         message = std::make_shared<Message>())
      arrive(message, info.get_rmw_message_info(), true);
  }

  void arrive(Pointer message, const rmw_message_info_t & info, bool waited) {
    const auto stamp = stamp_of(*message);
    if (const auto moved = turn_ ? turn_->moved() : std::nullopt)
      shaper_.move_slots(moved->first, moved->second);
    const auto before = shaper_.overflowed.size();
    shaper_.arrive(std::move(message), stamp, info.source_timestamp, waited, missing_before(info));
    if (!turn_ || shaper_.overflowed.size() == before) return;
    const auto gone = shaper_.overflowed.back().waiting.source_timestamp.value_or(0);
    if (turn_->was_bypassed(gone))
      shaper_.overflowed.pop_back();
    else
      turn_->drop(gone);
  }

  // How many messages are missing before this one, by its publisher's numbers; none: not known.
  Maybe missing_before(const rmw_message_info_t & info) {
    if (info.publication_sequence_number == RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED)
      return std::nullopt;
    const auto last = number_;
    number_ = static_cast<std::int64_t>(info.publication_sequence_number);
    // A publisher that is started again counts anew.
    return last ? std::max<std::int64_t>(0, *number_ - *last - 1) : 0;
  }

  // Losses are said when they happen, at most every ten seconds.
  void note(const Outcome<Pointer> & outcome, Maybe published_ns = {}, Maybe stalled_ns = {}) {
    log_.write(shaper_.queue.gate, outcome, published_ns, stalled_ns);
    if (turn_)
      turn_->count(outcome.dropped, outcome.waiting.lost, outcome.release.overrun.has_value(),
                   outcome.waiting.arrival_ns - outcome.release.origin_ns);
    const std::int64_t now = monotonic_ns();
    if (said_ns_ != 0 && now - said_ns_ < 10'000'000'000) return;
    const std::string losses = log_.losses();
    if (losses != said_) {
      RCLCPP_WARN(node_.get_logger(), "of %llu messages so far: %s",
                  static_cast<unsigned long long>(log_.rows),
                  losses.c_str());  // NOLINT(runtime/int)
      said_ = losses;
      said_ns_ = now;
    }
  }

  rclcpp::Node & node_;
  Parameters parameters_;
  std::optional<Turn> turn_;
  Readiness readiness_;
  Shaper<Pointer> shaper_;
  GateLog log_;
  std::shared_ptr<Publisher> output_;
  std::shared_ptr<Input> input_;
  bool its_turn_{false};  // of the oldest message
  Maybe number_;          // its publisher's, of the last message
  std::string said_;
  std::int64_t said_ns_{0};
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr phase_;
  rclcpp::Subscription<std_msgs::msg::String>::SharedPtr modes_;
};

}  // namespace

int main(int argc, char ** argv) {
  std::optional<Shaping> shaping;
  return run(argc, argv, "chainshaper_shaping", [&](rclcpp::Node & node) -> std::function<bool()> {
    auto turn = turn_of(node);
    const auto offer = wait_for_publisher(node, "input");
    if (!offer) return {};
    shaping.emplace(node, *offer, std::move(turn));
    if (!shaping->await_receivers()) return {};
    return [&] { return shaping->work_off(); };
  });
}
