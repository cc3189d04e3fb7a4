// The latency-shaping node: what it receives on `input` it republishes on `output` in the slots of
// its server (Managing End-to-End Timing Jitters in ROS2 Computation Chains, section 3.2.2), as
// chainshaper's Python node, which explains it. One source for three packages: with `message.hpp`
// it is for that type of message, without it for any, byte for byte. With CHAINSHAPER_COMPONENT it
// is a component for that type: in the publisher's container it takes the publisher's own message,
// and publishes that very one. The container's executor has the services of its node only.

#include <dlfcn.h>

#include <filesystem>
#include <set>
#include <thread>

#include "chainshaper_shaping/gate_log.hpp"
#include "chainshaper_shaping/handover.hpp"
#include "chainshaper_shaping/readiness.hpp"
#include "rcl/subscription.h"
#include "rmw/rmw.h"
#include "std_msgs/msg/string.hpp"

#if __has_include("message.hpp")
#include "message.hpp"

namespace {

using chainshaper::Message;
using Publisher = rclcpp::Publisher<Message>;
using Input = rclcpp::Subscription<Message>;
constexpr bool input_tells_takes = false;  // where a callback is executed
#ifdef CHAINSHAPER_COMPONENT
using Pointer = std::unique_ptr<Message>;
#else
using Pointer = std::shared_ptr<Message>;
#endif

// The stamp of a message's header; none if it is zero, or the type has no header.
template <typename T>
auto stamp_of(const T & message, int)
    -> decltype(message.header.stamp.nanosec, chainshaper::Maybe()) {
  const auto & stamp = message.header.stamp;
  if (stamp.sec == 0 && stamp.nanosec == 0) return std::nullopt;
  return stamp.sec * std::int64_t{1'000'000'000} + stamp.nanosec;
}

template <typename T>
chainshaper::Maybe stamp_of(const T &, long) {  // NOLINT(runtime/int)
  return std::nullopt;
}

auto make_publisher(rclcpp::Node & node, const std::string & type, const rclcpp::QoS & qos) {
  if (type != chainshaper::message_type)
    throw std::invalid_argument("this node was made for " + std::string(chainshaper::message_type) +
                                ", but its input is " + type + ": generate it again for that type");
  return node.create_publisher<Message>("output", qos);
}

template <typename Taken>
auto subscribe(rclcpp::Node & node, const std::string &, const rclcpp::QoS & qos,
               const rclcpp::SubscriptionOptions & options, Taken taken) {
  return node.create_subscription<Message>("input", qos, taken, options);
}

// What a publisher of this process sent to subscribers of others as well, the executor leaves out.
struct Open : Input {
  using Input::matches_any_intra_process_publishers;
};

bool take(Input & input, Message & message, rclcpp::MessageInfo & info) {
  while (input.take(message, info)) {
    const auto & sender = info.get_rmw_message_info().publisher_gid;
    if (!(input.*&Open::matches_any_intra_process_publishers)(&sender)) return true;
  }
  return false;
}

// What a ring buffer of rclcpp gives its subscription.
using Within = std::pair<std::shared_ptr<const Message>, Pointer>;

// The oldest message that came without DDS, which only a component's may, or none.
Pointer take_within(Input & input) {
  const auto waitable = input.get_intra_process_waitable();
  const auto data = waitable ? waitable->take_data() : nullptr;
  return data ? std::move(std::static_pointer_cast<Within>(data)->second) : nullptr;
}

// The callback has its message already, so it is given none, or an empty one.
void execute(Input & input, const Pointer &, bool within, const rclcpp::MessageInfo & info) {
  std::shared_ptr<void> nothing = std::make_shared<Within>();
  if (within) return input.get_intra_process_waitable()->execute(nothing);
  nothing = std::make_shared<Message>();
  input.handle_message(nothing, info);
}

#ifdef CHAINSHAPER_COMPONENT
void publish(Publisher & output, Pointer & message) { output.publish(std::move(message)); }
#else
void publish(Publisher & output, const Pointer & message) { output.publish(*message); }
#endif

}  // namespace

#else
namespace {

using Message = rclcpp::SerializedMessage;
using Publisher = rclcpp::GenericPublisher;
using Input = rclcpp::GenericSubscription;
using Pointer = std::shared_ptr<Message>;
constexpr bool input_tells_takes = chainshaper::serialized_tells_takes;

chainshaper::Maybe stamp_of(const Message & message, int) {
  const auto & bytes = message.get_rcl_serialized_message();
  return chainshaper::origin_of(bytes.buffer, bytes.buffer_length);
}

auto make_publisher(rclcpp::Node & node, const std::string & type, const rclcpp::QoS & qos) {
  return node.create_generic_publisher("output", type, qos);
}

auto subscribe(rclcpp::Node & node, const std::string & type, const rclcpp::QoS & qos,
               const rclcpp::SubscriptionOptions &, chainshaper::Taken taken) {
  return chainshaper::subscribe_serialized(node, "input", type, qos, std::move(taken));
}

bool take(Input & input, Message & message, rclcpp::MessageInfo & info) {
  return input.take_serialized(message, info);
}

Pointer take_within(Input &) { return nullptr; }

void execute(Input & input, const Pointer & message, bool, const rclcpp::MessageInfo & info) {
  input.handle_serialized_message(message, info);
}

void publish(Publisher & output, const Pointer & message) {
  chainshaper::publish_serialized(output, *message);
}

}  // namespace
#endif

namespace {

using namespace chainshaper;  // NOLINT

// Where DDS threads deliver the output: the first core that is ours to use and has no server. Those
// of Fast DDS on Humble have no names, so no priority, and would wait while the core is cleared.
Maybe delivery_core(const std::vector<std::int64_t> & taken) {
#if !RCLCPP_VERSION_GTE(17, 0, 0)  // Humble
  if (std::strncmp(rmw_get_implementation_identifier(), "rmw_fastrtps", 12) == 0)
    return std::nullopt;
#endif
  cpu_set_t ours;
  if (taken.empty() || sched_getaffinity(0, sizeof(ours), &ours) != 0) return std::nullopt;
  for (std::int64_t core = 0; core < CPU_SETSIZE; ++core)
    if (CPU_ISSET(static_cast<std::size_t>(core), &ours) && !place_of(taken, core)) return core;
  return std::nullopt;
}

// What is agreed with the standby; none: the node is alone, since nothing names a page.
std::optional<Turn> turn_of(rclcpp::Node & node) {
  const auto page = parameters_of(node).handover;
  if (page.empty()) return std::nullopt;
  std::optional<Turn> turn;
  try {
    const auto topic = node.get_node_topics_interface()->resolve_topic_name("output");
    turn.emplace(page, topic, page_folders(), unloaded != nullptr);
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
  const auto handle = rcl_subscription_get_rmw_handle(subscription.get_subscription_handle().get());
  if (emit != nullptr) emit(handle, message, source_timestamp.value_or(0), true);
}

rclcpp::QoS deeper(rclcpp::QoS qos, std::size_t depth) {
  if (qos.history() == rclcpp::HistoryPolicy::KeepLast) qos.keep_last(std::max(depth, qos.depth()));
  return qos;
}

// By what the standby and the log's readers know a message; one that came without DDS has no stamp.
std::int64_t key_of(const Waiting<Pointer> & one) {
  return one.source_timestamp.value_or(one.arrival_ns);
}

// The gate of a node, with its endpoints, which are in the group if one is given, and its log.
class Shaping {
public:
  Shaping(rclcpp::Node & node, const Offer & offer, std::optional<Turn> turn,
          rclcpp::CallbackGroup::SharedPtr group = nullptr)
      : node_(node),
        parameters_(parameters_of(node)),
        turn_(std::move(turn)),
        readiness_(node, delivery_core(parameters_.server_cores), parameters_.pause_ns),
        shaper_(gate_of(parameters_, depth_of(parameters_, offer.publisher.depth())),
                parameters_.spin_ns) {
    shaper_.on_waking = [this](std::int64_t release_ns) { readiness_.get_ready(release_ns); };
    shaper_.look = [this] { look(); };
    if (turn_) turn_->go_on(shaper_);
    const auto & log = parameters_.log;
    if (!log.empty() && !log_.open_file(log, parameters_.log_bytes))
      RCLCPP_WARN(node.get_logger(), "no log is written to %s: %s", log.c_str(),
                  std::strerror(errno));
    phase_ =
        node.add_on_set_parameters_callback([this](const std::vector<rclcpp::Parameter> & changed) {
          const std::lock_guard<std::mutex> locked(asking_);  // the executor may be another one
          for (const auto & parameter : changed)
            if (parameter.get_name() == "phase_ns")
              asked_phase_.emplace(parameter.as_int(), monotonic_ns());
          rcl_interfaces::msg::SetParametersResult result;
          result.successful = true;
          return result;
        });
    const auto depth = shaper_.queue.gate.depth;
    const auto most = std::max<std::size_t>(depth, schema::reader_depth);
    const bool latched = offer.publisher.durability() == rclcpp::DurabilityPolicy::TransientLocal;
    output_ = make_publisher(node, offer.type,
                             latched ? offer.publisher : deeper(offer.publisher, depth));
    options_.callback_group = group;
    listen_to_modes();
    input_ = subscribe(node, offer.type, deeper(offer.subscription, most), options_,
                       [this](Pointer message, const rclcpp::MessageInfo & info) {
                         shape(std::move(message), info);
                       });
  }

  // Leave the output to the standby until the receivers know this node too. Whether it is to run.
  bool await_receivers() {
    const auto topic = node_.get_node_topics_interface()->resolve_topic_name("output");
    const auto give_up = monotonic_ns() + 2'000'000'000;
    while (turn_ && turn_->has_standby() && goes_on() && monotonic_ns() < give_up) {
      if (output_->get_subscription_count() >= node_.count_subscribers(topic)) return wait(0.1);
      wait(0.01);
    }
    return goes_on();
  }

  // Deal with what waits at the gate; whether some are left. Where nothing says which message of a
  // buffer a callback has, but that it was the last one taken, the executor takes none meanwhile.
  bool work_off() {
    for (bool served = false; goes_on(); served = true) {
      for (const auto & gone : shaper_.overflowed) note(gone);
      shaper_.overflowed.clear();
      if (shaper_.queue.waiting.empty() || (served && !ahead_ && shaper_.nothing_due())) break;
      const auto & oldest = shaper_.queue.waiting.front();
      const bool within = !oldest.source_timestamp;
      auto info = rclcpp::MessageInfo();
      info.get_rmw_message_info().source_timestamp = oldest.source_timestamp.value_or(0);
      if (!within && !input_tells_takes)
        take_again(*input_, oldest.message.get(), oldest.source_timestamp);
      its_turn_ = true;
      execute(*input_, oldest.message, within, info);
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
        topic, qos,
        [this](std::shared_ptr<const std_msgs::msg::String> mode) {
          if (shaper_.announce(mode->data, monotonic_ns()))
            RCLCPP_INFO(node_.get_logger(), "mode %s", mode->data.c_str());
          else
            RCLCPP_WARN(node_.get_logger(), "there is no mode '%s'", mode->data.c_str());
        },
        options_);
  }

  // The subscription's callback.
  void shape(Pointer message, const rclcpp::MessageInfo & info) {
    if (!its_turn_) {  // the executor took it
      const bool alone = shaper_.queue.waiting.empty();
      arrive(std::move(message), info.get_rmw_message_info(), false);
      if (!alone) return;
    }
    ahead_ = false;
    const auto key = key_of(shaper_.queue.waiting.front());
    if (turn_ && !turn_->take(key)) {
      shaper_.queue.leave({}, monotonic_ns());
      return;
    }
    auto outcome = shaper_.hold();
    if (!outcome) return;
    if (turn_ && turn_->was_bypassed(key)) return readiness_.ask_for();
    const auto & newer = shaper_.queue.waiting;
    if (turn_ && std::any_of(newer.begin(), newer.end(), [this](const auto & waiting) {
          return turn_->is_overtaken_by(key_of(waiting));
        }))
      outcome->release.drop(Dropped::replaced);
    Maybe published_ns, stalled_ns;
    if (outcome->release.at_ns) {
      try {
        publish(*output_, outcome->waiting.message);
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
    readiness_.ask_for();
    note(*outcome, published_ns, stalled_ns);
  }

  // Take all that has come, but of what came without DDS one message only: see `work_off`.
  void look() {
    rclcpp::MessageInfo info;
    for (Pointer message(new Message); take(*input_, *message, info); message.reset(new Message))
      arrive(std::move(message), info.get_rmw_message_info(), true);
    auto message = ahead_ ? nullptr : take_within(*input_);
    if (!message) return;
    ahead_ = true;
    info.get_rmw_message_info().from_intra_process = true;
    arrive(std::move(message), info.get_rmw_message_info(), true);
  }

  void arrive(Pointer message, const rmw_message_info_t & info, bool waited) {
    const auto stamp = stamp_of(*message, 0);
    const bool within = info.from_intra_process;  // without anything else of DDS
    if (const std::unique_lock<std::mutex> ours(asking_, std::try_to_lock); ours && asked_phase_) {
      shaper_.queue.set_phase(asked_phase_->first, asked_phase_->second);
      asked_phase_.reset();
    }
    const auto before = shaper_.overflowed.size();
    shaper_.arrive(std::move(message), stamp, within ? Maybe() : Maybe(info.source_timestamp),
                   waited, within ? Maybe() : missing_before(info));
    if (!turn_ || shaper_.overflowed.size() == before) return;
    const auto gone = key_of(shaper_.overflowed.back().waiting);
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
    if (turn_) turn_->count(outcome);
    const std::int64_t now = monotonic_ns();
    if (said_ns_ != 0 && now - said_ns_ < 10'000'000'000) return;
    const std::string losses = log_.losses();
    if (losses == std::exchange(said_, losses)) return;
    RCLCPP_WARN(node_.get_logger(), "of %zu messages so far: %s", log_.rows, losses.c_str());
    said_ns_ = now;
  }

  rclcpp::Node & node_;
  Parameters parameters_;
  rclcpp::SubscriptionOptions options_;
  std::optional<Turn> turn_;
  Readiness readiness_;
  Shaper<Pointer> shaper_;
  GateLog log_;
  std::shared_ptr<Publisher> output_;
  std::shared_ptr<Input> input_;
  bool its_turn_{false};  // of the oldest message
  bool ahead_{false};     // one that came without DDS waits behind it
  Maybe number_;          // its publisher's, of the last message
  std::string said_;
  std::int64_t said_ns_{0};
  std::mutex asking_;
  std::optional<std::pair<std::int64_t, std::int64_t>> asked_phase_;  // which, and when
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr phase_;
  rclcpp::Subscription<std_msgs::msg::String>::SharedPtr modes_;
};

}  // namespace

#ifdef CHAINSHAPER_COMPONENT

// Its class has the name of the package: a container may have one for each of several types.
namespace CHAINSHAPER_COMPONENT {

// What is loaded into a container. The gate waits in a thread of its own, as an executor of its
// own.
class ShapingNode {
public:
  explicit ShapingNode(rclcpp::NodeOptions options)
      : node_(std::make_shared<rclcpp::Node>(
            "chainshaper_shaping", options.automatically_declare_parameters_from_overrides(true))),
        group_(node_->create_callback_group(rclcpp::CallbackGroupType::MutuallyExclusive, false)),
        before_(threads()),
        services_(node_->create_wall_timer(std::chrono::nanoseconds(0), [this] { name_thread(); })),
        thread_([this] { run(); }) {}

  ~ShapingNode() {
    unloaded_ = true;
    executor_.cancel();
    thread_.join();
  }

  auto get_node_base_interface() { return node_->get_node_base_interface(); }

private:
  static std::set<std::string> threads() {
    std::set<std::string> found;
    for (const auto & one : std::filesystem::directory_iterator("/proc/self/task"))
      found.insert(one.path().filename());
    return found;
  }

  // In the container's executor. One that it has started for this node alone gets a name of its
  // own: an isolated container's threads are told apart by their order, as it had them without us.
  void name_thread() {
    services_->cancel();
    if (before_.count(std::to_string(syscall(SYS_gettid))) == 0)
      pthread_setname_np(pthread_self(), "gate_services");
  }

  void run() {
    unloaded = &unloaded_;
    const FileSizeSignalBlocked blocked;  // the container is the robot's
    pthread_setname_np(pthread_self(), gate_thread_name(node_->get_name()).c_str());
    try {
      auto turn = turn_of(*node_);
      const auto offer = wait_for_publisher(*node_, "input");
      if (!offer) return;
      Shaping shaping(*node_, *offer, std::move(turn), group_);
      executor_.add_callback_group(group_, get_node_base_interface());
      become_realtime(*node_);
      while (goes_on()) executor_.spin_once(std::chrono::nanoseconds(shaping.work_off() ? 0 : -1));
    } catch (const std::exception & error) {
      RCLCPP_FATAL(node_->get_logger(), "nothing is published any more: %s", error.what());
    }
  }

  std::atomic<bool> unloaded_{false};
  rclcpp::Node::SharedPtr node_;
  rclcpp::CallbackGroup::SharedPtr group_;
  rclcpp::executors::SingleThreadedExecutor executor_;
  std::set<std::string> before_;
  rclcpp::TimerBase::SharedPtr services_;
  std::thread thread_;
};

}  // namespace CHAINSHAPER_COMPONENT

#include "rclcpp_components/register_node_macro.hpp"
RCLCPP_COMPONENTS_REGISTER_NODE(CHAINSHAPER_COMPONENT::ShapingNode)

#else

int main(int argc, char ** argv) {
  std::signal(SIGXFSZ,
              SIG_IGN);  // a log that may grow no further (`ulimit -f`) is no reason to end
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

#endif
