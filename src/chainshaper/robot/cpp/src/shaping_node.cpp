// The latency-shaping node: it republishes on `output`, in the slots of its server, what it
// receives on `input` (Managing End-to-End Timing Jitters in ROS2 Computation Chains,
// section 3.2.2). chainshaper's Python node does the same, and explains it.
//
// This source is built in three ways:
//
// * Without `message.hpp`: a node for messages of any type, passed on byte for byte.
// * With it: a node for that type.
// * With CHAINSHAPER_COMPONENT too: a component for that type. In the publisher's container it
// takes
//   the publisher's own message, without a copy, and publishes that very message. The container's
//   executor serves its parameters only: the gate has a thread and an executor of its own.

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
constexpr bool input_tells_takes = false;  // the execution of a callback emits no take
#ifdef CHAINSHAPER_COMPONENT
using Pointer = std::unique_ptr<Message>;
#else
using Pointer = std::shared_ptr<Message>;
#endif

// Returns the stamp of a message's header; none if it is zero, or the type has no header.
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

// Gives access to a protected function of rclcpp's subscription.
struct OpenSubscription : Input {
  using Input::matches_any_intra_process_publishers;
};

// Takes the next message that came by DDS. A message of a publisher in this process comes twice
// where other processes subscribe too; the second is left out, as rclcpp's executor does.
bool take(Input & input, Message & message, rclcpp::MessageInfo & info) {
  while (input.take(message, info)) {
    const auto & sender = info.get_rmw_message_info().publisher_gid;
    if (!(input.*&OpenSubscription::matches_any_intra_process_publishers)(&sender)) return true;
  }
  return false;
}

// What a subscription of rclcpp takes of its buffer of messages from the same process.
using IntraProcessData = std::pair<std::shared_ptr<const Message>, Pointer>;

// Takes the oldest message of the same process, which came without DDS; null: there is none. Only a
// component gets such messages.
Pointer take_intra_process(Input & input) {
  const auto waitable = input.get_intra_process_waitable();
  const auto data = waitable ? waitable->take_data() : nullptr;
  return data ? std::move(std::static_pointer_cast<IntraProcessData>(data)->second) : nullptr;
}

// Executes the subscription's callback. `Shaping` has the message already, so the callback gets
// none, or an empty one.
void execute(Input & input, const Pointer &, bool is_intra_process,
             const rclcpp::MessageInfo & info) {
  std::shared_ptr<void> placeholder = std::make_shared<IntraProcessData>();
  if (is_intra_process) return input.get_intra_process_waitable()->execute(placeholder);
  placeholder = std::make_shared<Message>();
  input.handle_message(placeholder, info);
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
               const rclcpp::SubscriptionOptions &, const chainshaper::Taken & taken) {
  return chainshaper::subscribe_serialized(node, "input", type, qos, taken);
}

bool take(Input & input, Message & message, rclcpp::MessageInfo & info) {
  return input.take_serialized(message, info);
}

Pointer take_intra_process(Input &) { return nullptr; }

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

// Returns the core where DDS threads deliver the output: the first one that this process may use
// and that has no server. None with Fast DDS on Humble: its threads have no names, so they get no
// priority, and would wait while the core is cleared.
Maybe delivery_core(const std::vector<std::int64_t> & server_cores) {
#if !RCLCPP_VERSION_GTE(17, 0, 0)  // Humble
  if (std::strncmp(rmw_get_implementation_identifier(), "rmw_fastrtps", 12) == 0)
    return std::nullopt;
#endif
  cpu_set_t usable;
  if (server_cores.empty() || sched_getaffinity(0, sizeof(usable), &usable) != 0)
    return std::nullopt;
  for (std::int64_t core = 0; core < CPU_SETSIZE; ++core)
    if (CPU_ISSET(static_cast<std::size_t>(core), &usable) && !place_of(server_cores, core))
      return core;
  return std::nullopt;
}

// Returns what the node agrees with its standby; none: it has no standby, so no parameter names a
// page. Waits where the node has failed at once several times.
std::optional<Turn> turn_of(rclcpp::Node & node) {
  const auto page = parameters_of(node).handover;
  if (page.empty()) return std::nullopt;
  std::optional<Turn> turn;
  try {
    const auto topic = node.get_node_topics_interface()->resolve_topic_name("output");
    turn.emplace(page, topic, page_folders(), unloaded != nullptr);
  } catch (const std::runtime_error & error) {  // the standby has no page either
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

// Returns a QoS whose history has room for that many messages.
rclcpp::QoS deeper(rclcpp::QoS qos, std::size_t depth) {
  if (qos.history() == rclcpp::HistoryPolicy::KeepLast) qos.keep_last(std::max(depth, qos.depth()));
  return qos;
}

// Returns the number by which the standby knows a message; one that came without DDS has no stamp.
std::int64_t key_of(const Waiting<Pointer> & message) {
  return message.source_timestamp.value_or(message.arrival_ns);
}

// The gate of a node, with its endpoints (in the callback group, if one is given) and its log.
class Shaping {
public:
  Shaping(rclcpp::Node & node, const Offer & offer, std::optional<Turn> turn,
          const rclcpp::CallbackGroup::SharedPtr & group = nullptr)
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
    phase_callback_ =
        node.add_on_set_parameters_callback([this](const std::vector<rclcpp::Parameter> & changed) {
          // In a component, the container's executor calls this from another thread.
          const std::lock_guard<std::mutex> locked(phase_mutex_);
          for (const auto & parameter : changed)
            if (parameter.get_name() == "phase_ns")
              asked_phase_.emplace(parameter.as_int(), monotonic_ns());
          rcl_interfaces::msg::SetParametersResult result;
          result.successful = true;
          return result;
        });
    const auto depth = shaper_.queue.gate.depth;
    const auto input_depth = std::max<std::size_t>(depth, schema::reader_depth);
    const bool latched = offer.publisher.durability() == rclcpp::DurabilityPolicy::TransientLocal;
    output_ = make_publisher(node, offer.type,
                             latched ? offer.publisher : deeper(offer.publisher, depth));
    options_.callback_group = group;
    listen_to_modes();
    input_ = subscribe(node, offer.type, deeper(offer.subscription, input_depth), options_,
                       [this](Pointer message, const rclcpp::MessageInfo & info) {
                         shape(std::move(message), info);
                       });
  }

  // Leaves the output to the standby until the receivers know this node too; returns whether the
  // node goes on.
  bool await_receivers() {
    const auto topic = node_.get_node_topics_interface()->resolve_topic_name("output");
    const auto give_up = monotonic_ns() + 2'000'000'000;
    while (turn_ && turn_->has_standby() && goes_on() && monotonic_ns() < give_up) {
      if (output_->get_subscription_count() >= node_.count_subscribers(topic)) {
        // With Fast DDS a receiver's process may wait for a third of a second as it opens the
        // shared memory of each of this node's two ports (`SharedMemGlobal.hpp`, `healthy_check`).
        return wait(0.8);
      }
      wait(0.01);
    }
    return goes_on();
  }

  // Deals with the messages that wait at the gate, until there is time for the node's other
  // callbacks; returns whether some are left. A trace says of a message of the same process only
  // that a callback has the last one that was taken: while one waits, no other is taken.
  bool work_off() {
    for (bool served = false; goes_on(); served = true) {
      for (const auto & outcome : shaper_.overflowed) note(outcome);
      shaper_.overflowed.clear();
      if (shaper_.queue.waiting.empty() ||
          (served && !intra_process_waits_ && shaper_.nothing_due()))
        break;
      const auto & oldest = shaper_.queue.waiting.front();
      const bool is_intra_process = !oldest.source_timestamp;
      auto info = rclcpp::MessageInfo();
      info.get_rmw_message_info().source_timestamp = oldest.source_timestamp.value_or(0);
      if (!is_intra_process && !input_tells_takes)
        take_again(*input_, oldest.message.get(), oldest.source_timestamp);
      its_turn_ = true;
      execute(*input_, oldest.message, is_intra_process, info);
      its_turn_ = false;
    }
    return !shaper_.queue.waiting.empty();
  }

private:
  // Subscribes to the topic of modes. To be called when discovery knows its publishers.
  void listen_to_modes() {
    const auto & topic = parameters_.mode_topic;
    if (topic.empty()) return;
    rclcpp::QoS qos(10);
    for (const auto & info : node_.get_publishers_info_by_topic(topic))
      if (info.qos_profile().durability() == rclcpp::DurabilityPolicy::TransientLocal)
        qos.transient_local();
    modes_ = node_.create_subscription<std_msgs::msg::String>(
        topic, qos,
        [this](const std::shared_ptr<const std_msgs::msg::String> & mode) {
          if (shaper_.announce(mode->data, monotonic_ns()))
            RCLCPP_INFO(node_.get_logger(), "mode %s", mode->data.c_str());
          else
            RCLCPP_WARN(node_.get_logger(), "there is no mode '%s'", mode->data.c_str());
        },
        options_);
  }

  // The subscription's callback.
  void shape(Pointer message, const rclcpp::MessageInfo & info) {
    if (!its_turn_) {  // the executor took the message
      const bool is_alone = shaper_.queue.waiting.empty();
      arrive(std::move(message), info.get_rmw_message_info(), false);
      if (!is_alone) return;
    }
    intra_process_waits_ = false;
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
    Maybe published_ns;
    Maybe stalled_ns;
    if (outcome->release.at_ns) {
      try {
        publish(*output_, outcome->waiting.message);
      } catch (const rclcpp::exceptions::RCLError &) {
        if (rclcpp::ok()) throw;
        return;  // the node was interrupted meanwhile; to ask before publishing would cost time
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

  // Takes all messages that have come; of those of the same process one only: see `work_off`.
  void look() {
    rclcpp::MessageInfo info;
    for (;;) {
      Pointer taken = std::make_unique<Message>();
      if (!take(*input_, *taken, info)) break;
      arrive(std::move(taken), info.get_rmw_message_info(), true);
    }
    auto message = intra_process_waits_ ? nullptr : take_intra_process(*input_);
    if (!message) return;
    intra_process_waits_ = true;
    info.get_rmw_message_info().from_intra_process = true;
    arrive(std::move(message), info.get_rmw_message_info(), true);
  }

  // Queues a message; one that `waited` in the reader came before now.
  void arrive(Pointer message, const rmw_message_info_t & info, bool waited) {
    const auto stamp = stamp_of(*message, 0);
    const bool is_intra_process = info.from_intra_process;  // the rest of `info` is empty then
    if (const std::unique_lock<std::mutex> locked(phase_mutex_, std::try_to_lock);
        locked && asked_phase_) {
      shaper_.queue.set_phase(asked_phase_->first, asked_phase_->second);
      asked_phase_.reset();
    }
    const auto before = shaper_.overflowed.size();
    shaper_.arrive(std::move(message), stamp,
                   is_intra_process ? Maybe() : Maybe(info.source_timestamp), waited,
                   is_intra_process ? Maybe() : missing_before(info));
    if (!turn_ || shaper_.overflowed.size() == before) return;
    const auto overflowed = key_of(shaper_.overflowed.back().waiting);
    if (turn_->was_bypassed(overflowed))
      shaper_.overflowed.pop_back();
    else
      turn_->drop(overflowed);
  }

  // Returns how many messages are missing before this one, by its publisher's numbers; none: not
  // known.
  Maybe missing_before(const rmw_message_info_t & info) {
    if (info.publication_sequence_number == RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED)
      return std::nullopt;
    const auto last = last_number_;
    last_number_ = static_cast<std::int64_t>(info.publication_sequence_number);
    // A publisher that is started again counts anew.
    return last ? std::max<std::int64_t>(0, *last_number_ - *last - 1) : 0;
  }

  // Notes what became of a message, in the log and for the standby; warns of losses, at most every
  // ten seconds.
  void note(const Outcome<Pointer> & outcome, Maybe published_ns = {}, Maybe stalled_ns = {}) {
    log_.write(shaper_.queue.gate, outcome, published_ns, stalled_ns);
    if (turn_) turn_->count(outcome);
    const std::int64_t now = monotonic_ns();
    if (warned_ns_ != 0 && now - warned_ns_ < 10'000'000'000) return;
    const std::string losses = log_.losses();
    if (losses == std::exchange(reported_losses_, losses)) return;
    RCLCPP_WARN(node_.get_logger(), "of %zu messages so far: %s", log_.rows, losses.c_str());
    warned_ns_ = now;
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
  bool its_turn_{false};             // the callback is executed for the oldest message
  bool intra_process_waits_{false};  // a message of the same process is behind the oldest one
  Maybe last_number_;                // of the last message, which its publisher gave it
  std::string reported_losses_;
  std::int64_t warned_ns_{0};
  std::mutex phase_mutex_;                                            // for the next member
  std::optional<std::pair<std::int64_t, std::int64_t>> asked_phase_;  // the phase, and since when
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr phase_callback_;
  rclcpp::Subscription<std_msgs::msg::String>::SharedPtr modes_;
};

}  // namespace

#ifdef CHAINSHAPER_COMPONENT

// The namespace is named after the package: a container may have a component for each of several
// types.
namespace CHAINSHAPER_COMPONENT {

// The component. Its gate waits in a thread with an executor of its own.
class ShapingNode {
public:
  explicit ShapingNode(rclcpp::NodeOptions options)
      : node_(std::make_shared<rclcpp::Node>(
            "chainshaper_shaping", options.automatically_declare_parameters_from_overrides(true))),
        group_(node_->create_callback_group(rclcpp::CallbackGroupType::MutuallyExclusive, false)),
        threads_before_(threads()),
        services_(node_->create_wall_timer(std::chrono::nanoseconds(0), [this] { name_thread(); })),
        thread_([this] { run(); }) {}

  ~ShapingNode() {
    is_unloaded_ = true;
    executor_.cancel();
    thread_.join();
  }

  auto get_node_base_interface() { return node_->get_node_base_interface(); }

private:
  // Returns the ids of this process's threads.
  static std::set<std::string> threads() {
    std::set<std::string> ids;
    for (const auto & thread : std::filesystem::directory_iterator("/proc/self/task"))
      ids.insert(thread.path().filename());
    return ids;
  }

  // Names the thread of the container's executor, which calls this, if the container has started it
  // for this node alone: chainshaper tells an isolated container's threads apart by their order,
  // and leaves this one out.
  void name_thread() {
    services_->cancel();
    if (threads_before_.count(std::to_string(syscall(SYS_gettid))) == 0)
      pthread_setname_np(pthread_self(), "gate_services");
  }

  void run() {
    unloaded = &is_unloaded_;
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

  std::atomic<bool> is_unloaded_{false};
  rclcpp::Node::SharedPtr node_;
  rclcpp::CallbackGroup::SharedPtr group_;
  rclcpp::executors::SingleThreadedExecutor executor_;
  std::set<std::string> threads_before_;  // when the component was made
  rclcpp::TimerBase::SharedPtr services_;
  std::thread thread_;
};

}  // namespace CHAINSHAPER_COMPONENT

#include "rclcpp_components/register_node_macro.hpp"
RCLCPP_COMPONENTS_REGISTER_NODE(CHAINSHAPER_COMPONENT::ShapingNode)

#else

int main(int argc, char ** argv) {
  // The node goes on without a log that may grow no further (`ulimit -f`).
  std::signal(SIGXFSZ, SIG_IGN);
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
