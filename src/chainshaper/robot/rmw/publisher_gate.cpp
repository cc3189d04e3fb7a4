// The gate in the process that publishes: `LD_PRELOAD` loads it into a node, in front of rmw. It
// serializes what the node publishes on a shaped output, and queues it for a thread of this
// library, which sends it in the slots of the output's server. The node's executor goes on at once.
//
// CHAINSHAPER_GATES names a file with a block of lines `NAME VALUE` for each output, whose first
// line is `output`. A block has the parameters of a shaping node, and:
//
// * `publisher`: the full name of the node that publishes the output; none: any node.
// * `thread`: the name of the thread that sends.
// * `node`, `input`: names for tracers, which see what they would see of a shaping node: the node
// of
//   the application publishes on `input`; the thread takes that, as a callback of `node`, and
//   publishes it on `output`.

#include <link.h>
#include <pthread.h>
#include <semaphore.h>

#include <memory>
#include <new>
#include <thread>
#include <tuple>

#include "chainshaper_shaping/gate_log.hpp"
#include "chainshaper_shaping/handover.hpp"
#include "in_front_of_rmw.hpp"

namespace {

using namespace chainshaper;  // NOLINT

// Emits an event of ros2_tracing; its arguments are integers and pointers.
template <typename... Values>
void emit(void * event, Values... values) {
  using Emit = void (*)(std::conditional_t<true, std::uintptr_t, Values>...);
  if (event != nullptr) reinterpret_cast<Emit>(event)(std::uintptr_t(values)...);
}
#define EMIT(name, ...)                                     \
  do {                                                      \
    static void * const event = behind("ros_trace_" #name); \
    emit(event, __VA_ARGS__);                               \
  } while (false)

// Emits `rmw_publish` as the distribution declares it: from Jazzy on with publisher and time stamp.
void emit_write(const void * publisher, const void * message, std::int64_t stamp) {
  if (is_humble())
    EMIT(rmw_publish, message);
  else
    EMIT(rmw_publish, publisher, message, stamp);
}

// A serialized message, in a list of those that have arrived.
class Serialized {
public:
  Serialized() { bytes.allocator = RMW(rcutils_get_default_allocator)(); }

  Serialized(const Serialized &) = delete;
  Serialized & operator=(const Serialized &) = delete;

  ~Serialized() {
    if (bytes.buffer != nullptr) bytes.allocator.deallocate(bytes.buffer, bytes.allocator.state);
  }

  Bytes bytes{};
  std::int64_t stamp{0};       // when the node published it (ns of CLOCK_REALTIME)
  Serialized * next{nullptr};  // the message that arrived before it
};
using Message = std::unique_ptr<Serialized>;

// The settings of an output.
struct Settings {
  explicit Settings(const Block & values) {
    output = first_of(values, "output");
    input = first_of(values, "input");
    node = first_of(values, "node");
    thread = first_of(values, "thread");
    parameters.each([&](const char * name, auto & value) {
      if (const auto entry = values.find(name); entry != values.end())
        for (const auto & word : entry->second) assign(value, word);
    });
  }

  static void assign(std::string & value, const std::string & word) { value = word; }
  static void assign(std::int64_t & value, const std::string & word) { value = std::stoll(word); }
  template <typename Value>
  static void assign(std::vector<Value> & values, const std::string & word) {
    assign(values.emplace_back(), word);
  }

  std::string output, input, node, thread;
  Parameters parameters;
};

// The topic on which modes are announced (std_msgs/String), read by the gate's thread.
class ModeTopic {
public:
  ModeTopic(const RmwNode * node, const std::string & topic) {
    static constexpr const char * support =
        "rosidl_typesupport_c__get_message_type_support_handle__std_msgs__msg__String";
    void * const library = dlopen("libstd_msgs__rosidl_typesupport_c.so", RTLD_LAZY);
    void * const get = library == nullptr ? nullptr : dlsym(library, support);
    if (get != nullptr) {
      RmwQos qos{};
      qos.history = keep_last;
      qos.depth = 10;
      qos.reliability = is_humble() ? reliable : best_available_reliability;
      qos.durability = is_humble() ? volatile_durability : best_available_durability;
      const auto options = RMW(rmw_get_default_subscription_options)();
      const void * const type = reinterpret_cast<const void * (*)()>(get)();
      subscription_ = RMW(rmw_create_subscription)(node, type, topic.c_str(), &qos, &options);
    }
    if (subscription_ == nullptr) say("modes on %s cannot be read", topic.c_str());
  }

  // Calls `announce` with each mode that was announced since the last call, and the time of that
  // (CLOCK_MONOTONIC).
  template <typename Announce>
  void read(Announce announce) {
    const auto take = RMW(rmw_take_serialized_message_with_info);
    while (subscription_ != nullptr) {
      Serialized text;
      MessageInfo info{};
      bool taken = false;
      if (take(subscription_, &text.bytes, &taken, &info, nullptr) != 0 || !taken) return;
      const auto now = monotonic_ns();
      const auto sent = info.source_timestamp;  // 0: the middleware does not say
      const auto at = sent > 0 ? std::min(now, sent - clock_offset()) : now;
      if (const auto mode = text_of(text.bytes.buffer, text.bytes.length)) announce(*mode, at);
    }
  }

private:
  void * subscription_{nullptr};
};

// Ends the gate's thread: the node destroys the publisher.
struct PublisherDestroyed : std::exception {};

// A publisher whose messages wait for slots, and the thread that sends them.
class Output {
public:
  Output(Settings settings, const RmwNode * node, const RmwPublisher * publisher,
         const void * type_support, std::size_t depth)
      : publisher(publisher),
        type_support(type_support),
        settings_(std::move(settings)),
        node_(node),
        shaper_(gate_of(settings_.parameters, depth), settings_.parameters.spin_ns) {
    const FileSizeSignalBlocked blocked;
    shaper_.look = [this] { look(); };
    share_page();
    const auto & parameters = settings_.parameters;
    if (!parameters.log.empty() && !log_.open_file(parameters.log, parameters.log_bytes))
      say("no log is written to %s: %s", parameters.log.c_str(), std::strerror(errno));
    sem_init(&more_, 0, 0);
    const SignalsBlocked inherited;
    thread_ = std::thread([this] { run(); });
  }

  ~Output() {
    is_destroyed_ = true;
    sem_post(&more_);
    thread_.join();
    Message arrived(arrived_.exchange(nullptr));
    std::size_t unpublished = shaper_.queue.waiting.size();
    for (; arrived; arrived.reset(arrived->next)) ++unpublished;
    if (unpublished > 0)
      say("%s: its publisher has ended, messages that were not published: %zu",
          settings_.output.c_str(), unpublished);
    sem_destroy(&more_);
  }

  // Emits the creation events of what tracers see: the application's node publishes on `input`;
  // `node` takes that, and publishes on `output`.
  void describe(const void * rcl_publisher, const void * rcl_node, std::uintptr_t depth) {
    const char * const input = settings_.input.c_str();
    EMIT(rcl_node_init, &node_handle_, &rmw_node_, settings_.node.c_str(), "/");
    EMIT(rcl_publisher_init, &input_handle_, rcl_node, &rmw_input_, input, depth);
    EMIT(rcl_publisher_init, rcl_publisher, &node_handle_, publisher, settings_.output.c_str(),
         depth);
    EMIT(rcl_subscription_init, &subscription_handle_, &node_handle_, &rmw_subscription_, input,
         depth);
    EMIT(rclcpp_subscription_init, &subscription_handle_, &subscription_);
    EMIT(rclcpp_subscription_callback_added, &subscription_, &callback_);
    EMIT(rclcpp_callback_register, &callback_, "chainshaper::gate");
    this->rcl_publisher = rcl_publisher;
  }

  const void * input_handle() const { return &input_handle_; }

  // Queues a message, which `fill` serializes; called by the thread that publishes, which it never
  // makes wait. Returns rmw's code; none: the message is not queued, and the caller publishes it at
  // once.
  template <typename Fill>
  std::optional<int> take(const void * ros_message, Fill fill) {
    if (gate_failed_) return std::nullopt;
    Message message(new (std::nothrow) Serialized);
    if (!message) return std::nullopt;
    // On Humble the event has no stamp; a trace's reader takes the last event before the stamp.
    if (is_humble()) emit_write(&rmw_input_, ros_message, 0);
    message->stamp = next_stamp();
    if (!is_humble()) emit_write(&rmw_input_, ros_message, message->stamp);
    if (const int failed = fill(message->bytes)) return failed;
    Serialized * const newest = message.release();
    newest->next = arrived_.load(std::memory_order_relaxed);
    while (!arrived_.compare_exchange_weak(newest->next, newest)) continue;
    sem_post(&more_);
    if (gate_failed_) publish_arrived();  // it failed meanwhile: no thread sends the message
    return 0;
  }

  const RmwPublisher * const publisher;
  const void * const type_support;
  const void * rcl_publisher{nullptr};

private:
  // Opens the output's page, where `status` reads what becomes of messages, and through which the
  // gate's schedule is changed; there is no standby. Phase and mode are taken over from the process
  // before this one.
  void share_page() {
    const auto & name = settings_.parameters.handover;
    if (name.empty()) return;
    try {
      turn_.emplace(name, settings_.output, page_folders(), true);
      turn_->go_on(shaper_);
    } catch (const std::runtime_error & error) {
      say("%s is not among the outputs that are shown: %s", settings_.output.c_str(), error.what());
    }
  }

  void note(const Outcome<Message> & outcome, Maybe published_ns = {}, Maybe stalled_ns = {}) {
    log_.write(shaper_.queue.gate, outcome, published_ns, stalled_ns);
    if (turn_) turn_->count(outcome);
  }

  // Returns the time (CLOCK_REALTIME), no time twice: the stamp tells a message from the others.
  std::int64_t next_stamp() {
    std::int64_t before = stamp_.load();
    std::int64_t now = 0;
    do now = std::max(before + 1, clock_ns(CLOCK_REALTIME));
    while (!stamp_.compare_exchange_weak(before, now));
    return now;
  }

  void run() {
    pthread_setname_np(pthread_self(), settings_.thread.c_str());
    schedule(settings_.parameters, [this](const std::string & what, const char * remedy) {
      say("%s: %s: %s; %s", settings_.output.c_str(), what.c_str(), std::strerror(errno), remedy);
    });
    try {
      for (;;) {
        if (shaper_.queue.waiting.empty())
          while (sem_wait(&more_) != 0) continue;  // a signal ended the wait early
        look();
        for (const auto & outcome : shaper_.overflowed) note(outcome);
        shaper_.overflowed.clear();
        if (!shaper_.queue.waiting.empty()) serve();
      }
    } catch (const PublisherDestroyed &) {
      return;
    } catch (const std::exception & error) {
      gate_failed_ = true;
      say("%s: its gate has failed (%s): all that is published leaves at once from now on",
          settings_.output.c_str(), error.what());
      publish_all();
    }
  }

  // Publishes at once, in their order, all messages that wait.
  void publish_all() {
    for (const auto & waiting : shaper_.queue.waiting)
      if (waiting.message) publish(*waiting.message);
    shaper_.queue.waiting.clear();
    publish_arrived();
  }

  // Takes the messages that have arrived; returns them in their order.
  std::vector<Message> take_arrived() {
    std::vector<Message> messages;
    for (auto * message = arrived_.exchange(nullptr); message != nullptr; message = message->next)
      messages.emplace_back(message);
    std::reverse(messages.begin(), messages.end());
    return messages;
  }

  void publish_arrived() {
    for (const auto & message : take_arrived()) publish(*message);
  }

  // Hands the queue what has come since the last call. Throws PublisherDestroyed.
  void look() {
    if (is_destroyed_) throw PublisherDestroyed();
    read_modes();
    for (auto & message : take_arrived()) {
      const auto origin = origin_of(message->bytes.buffer, message->bytes.length);
      const auto stamp = message->stamp;
      shaper_.arrive(std::move(message), origin, stamp, true, 0);
    }
  }

  void read_modes() {
    if (settings_.parameters.mode_topic.empty()) return;
    if (!modes_) modes_.emplace(node_, settings_.parameters.mode_topic);
    modes_->read([this](const std::string & mode, std::int64_t at_ns) {
      if (!shaper_.announce(mode, at_ns))
        say("%s: there is no mode '%s'", settings_.output.c_str(), mode.c_str());
    });
  }

  // Deals with the oldest message: waits for its slot and publishes it, or drops it.
  void serve() {
    const auto & oldest = shaper_.queue.waiting.front();
    EMIT(rmw_take, &rmw_subscription_, oldest.message.get(), oldest.message->stamp, true);
    EMIT(callback_start, &callback_, false);
    const auto key = oldest.message->stamp;
    if (turn_) turn_->take(key);
    const auto outcome = shaper_.hold();
    Maybe published_ns;
    Maybe stalled_ns;
    if (outcome && outcome->release.at_ns) {
      publish(*outcome->waiting.message);
      published_ns = monotonic_ns();
    }
    EMIT(callback_end, &callback_);
    if (!outcome) return;
    if (turn_) turn_->done(key);
    if (published_ns) {
      stalled_ns = shaper_.time_lost(*outcome);
      shaper_.rest(*published_ns, settings_.parameters.pause_ns);
    }
    note(*outcome, published_ns, stalled_ns);
  }

  void publish(const Serialized & message) {
    EMIT(rcl_publish, rcl_publisher, &message.bytes);
    // Before Jazzy rmw has no trace point on the way of serialized messages.
    if (is_humble()) emit_write(publisher, &message.bytes, 0);
    const int code = RMW(rmw_publish_serialized_message)(publisher, &message.bytes, nullptr);
    if (code != 0 && !publication_failed_)
      say("%s cannot be published: %d", settings_.output.c_str(), code);
    publication_failed_ = code != 0;
  }

  const Settings settings_;
  const RmwNode * node_;
  // Handles, for traces, of the shaping node and its endpoints, which do not exist: their
  // addresses.
  char node_handle_{}, rmw_node_{}, input_handle_{}, rmw_input_{}, subscription_handle_{},
      rmw_subscription_{}, subscription_{}, callback_{};
  std::atomic<Serialized *> arrived_{nullptr};  // the newest first
  std::atomic<std::int64_t> stamp_{0};
  std::atomic<bool> is_destroyed_{false};  // the publisher is destroyed
  std::atomic<bool> gate_failed_{false};   // the gate's thread has ended by an error
  bool publication_failed_{false};         // the last one
  sem_t more_{};
  std::optional<Turn> turn_;
  Shaper<Message> shaper_;
  GateLog log_;
  std::optional<ModeTopic> modes_;
  std::thread thread_;
};

// The outputs of this process, which this list owns. A free place is null; a place never moves.
std::array<std::atomic<Output *>, 32> outputs;

template <typename Matches>
Output * find_output(Matches matches) {
  for (const auto & place : outputs)
    if (Output * const output = place; output != nullptr && matches(*output)) return output;
  return nullptr;
}

Output * output_of(const RmwPublisher * publisher) {
  return find_output([=](const Output & output) { return output.publisher == publisher; });
}

// Puts an output into the list; returns it where the list is full.
std::unique_ptr<Output> insert(std::unique_ptr<Output> output) {
  for (auto & place : outputs) {
    Output * free_place = nullptr;
    if (!place.compare_exchange_strong(free_place, output.get())) continue;
    std::ignore = output.release();  // it is the list's now
    return nullptr;
  }
  return output;
}

// Takes the output of a publisher out of the list; null: it has none.
std::unique_ptr<Output> take_out(const RmwPublisher * publisher) {
  for (auto & place : outputs) {
    Output * output = place;
    if (output == nullptr || output->publisher != publisher) continue;
    if (place.compare_exchange_strong(output, nullptr)) return std::unique_ptr<Output>(output);
  }
  return nullptr;
}

// Shapes nothing in a child of fork(): it has no threads of this library.
void in_child() {
  for (auto & place : outputs) place = nullptr;
}

// Makes the gate of a new publisher if the file of settings has one for it.
void shape(const RmwNode * node, const RmwPublisher * publisher, const void * type_support,
           const RmwQos & qos) {
  if (node == nullptr || publisher == nullptr || publisher->topic == nullptr) return;
  try {
    const auto block =
        block_of(publisher->topic, *node, [](const Block & candidate, const std::string & name) {
          const auto owner = first_of(candidate, "publisher");
          return !first_of(candidate, "node").empty() && (owner.empty() || owner == name);
        });
    if (!block || !usable()) return;
    const Settings settings(*block);
    [[maybe_unused]] static const int registered = pthread_atfork(nullptr, nullptr, in_child);
    const auto depth = depth_of(settings.parameters, qos.depth);
    auto output = std::make_unique<Output>(settings, node, publisher, type_support, depth);
    if (insert(std::move(output)) != nullptr)
      say("%s: this process has too many shaped outputs: it leaves at once", publisher->topic);
  } catch (const std::exception & error) {
    say("%s leaves at once: its gate in %s is wrong: %s", publisher->topic,
        std::getenv("CHAINSHAPER_GATES"), error.what());
  }
}

// `struct dl_find_object` of <dlfcn.h>, which the C library has from 2.35 on.
struct LoadedObject {
  unsigned long long flags;  // NOLINT - the C library's
  void * start;
  void * end;
  struct link_map * loaded;
  void * others[16];
};

// The functions of the loader that the making of a mutex needs. They are looked up while this
// library is loaded: later, the loader may hold locks for which a thread that makes a mutex must
// not wait.
struct Loader {
  decltype(&pthread_mutex_init) mutex_init{
      reinterpret_cast<decltype(&pthread_mutex_init)>(dlsym(RTLD_NEXT, "pthread_mutex_init"))};
  int (*find_object)(void *, LoadedObject *){
      reinterpret_cast<int (*)(void *, LoadedObject *)>(dlsym(RTLD_DEFAULT, "_dl_find_object"))};
};

const Loader & loader() noexcept {
  static const Loader functions;
  return functions;
}

[[maybe_unused]] const Loader & at_loading = loader();

// Returns the file of the library that has code at an address; "": not known.
const char * library_of(void * address) {
  LoadedObject object{};
  if (loader().find_object != nullptr) {  // takes no lock
    const bool is_known = loader().find_object(address, &object) == 0;
    return is_known && object.loaded->l_name != nullptr ? object.loaded->l_name : "";
  }
  Dl_info library{};
  const bool is_known = dladdr(address, &library) != 0 && library.dli_fname != nullptr;
  return is_known ? library.dli_fname : "";
}

bool is_of_middleware(void * address) {
  static constexpr std::array<const char *, 6> libraries{
      "/libddsc.so", "/libfastrtps.so", "/libfastdds.so", "/librmw_", "/libzenohc.so", "/libnddsc"};
  const char * const name = library_of(address);
  return std::any_of(libraries.begin(), libraries.end(),
                     [=](const char * part) { return std::strstr(name, part) != nullptr; });
}

}  // namespace

// The signatures of these functions are those of ROS 2 and the C library:
// NOLINTBEGIN(misc-const-correctness)

EXPORTED RmwPublisher * rmw_create_publisher(const RmwNode * node, const void * type_support,
                                             const char * topic, const RmwQos * qos,
                                             const void * options) {
  auto * const publisher = RMW(rmw_create_publisher)(node, type_support, topic, qos, options);
  shape(node, publisher, type_support, qos == nullptr ? RmwQos{} : *qos);
  return publisher;
}

EXPORTED int rmw_destroy_publisher(RmwNode * node, RmwPublisher * publisher) {
  take_out(publisher).reset();  // its thread ends before its publisher
  return RMW(rmw_destroy_publisher)(node, publisher);
}

EXPORTED int rmw_publish(const RmwPublisher * publisher, const void * message, void * allocation) {
  if (Output * const output = output_of(publisher)) {
    const auto code = output->take(message, [&](Bytes & bytes) {
      return RMW(rmw_serialize)(message, output->type_support, &bytes);
    });
    if (code) return *code;
  }
  return RMW(rmw_publish)(publisher, message, allocation);
}

EXPORTED int rmw_publish_serialized_message(const RmwPublisher * publisher, const Bytes * message,
                                            void * allocation) {
  if (Output * const output = output_of(publisher)) {
    const auto code = output->take(message, [&](Bytes & bytes) {
      bytes.buffer = static_cast<std::uint8_t *>(
          bytes.allocator.allocate(message->length, bytes.allocator.state));
      if (bytes.buffer == nullptr) return 10;  // RMW_RET_BAD_ALLOC
      std::memcpy(bytes.buffer, message->buffer, message->length);
      bytes.length = bytes.capacity = message->length;
      return 0;
    });
    if (code) return *code;
  }
  return RMW(rmw_publish_serialized_message)(publisher, message, allocation);
}

// A loaned message cannot wait without a copy. rclcpp asks before it borrows one; where the answer
// is no it publishes from its own memory, which is shaped as any other message.
EXPORTED bool rcl_publisher_can_loan_messages(const void * handle) {
  static std::atomic<bool> is_reported;
  if (!RMW(rcl_publisher_can_loan_messages)(handle)) return false;
  const auto * const publisher = RMW(rcl_publisher_get_rmw_handle)(handle);
  if (output_of(publisher) == nullptr) return true;
  if (!is_reported.exchange(true))
    say("%s: no messages are loaned: they cannot wait for their slot without a copy, so the node's "
        "own memory is used; plan with --publication synchronous to have loans",
        publisher->topic);
  return false;
}

EXPORTED int rmw_borrow_loaned_message(const RmwPublisher * publisher, const void * type_support,
                                       void ** message) {
  if (output_of(publisher) != nullptr) return 3;  // RMW_RET_UNSUPPORTED
  return RMW(rmw_borrow_loaned_message)(publisher, type_support, message);
}

// rcl calls this for each publisher after rmw_create_publisher.
EXPORTED void ros_trace_rcl_publisher_init(const void * handle, const void * node,
                                           const void * rmw_publisher, const char * topic,
                                           std::uintptr_t depth) {
  if (Output * const output = output_of(static_cast<const RmwPublisher *>(rmw_publisher)))
    output->describe(handle, node, depth);
  else
    EMIT(rcl_publisher_init, handle, node, rmw_publisher, topic, depth);
}

EXPORTED void ros_trace_rcl_publish(const void * handle, const void * message) {
  const auto publishes = [=](const Output & output) { return output.rcl_publisher == handle; };
  const Output * const output = find_output(publishes);
  EMIT(rcl_publish, output == nullptr ? handle : output->input_handle(), message);
}

// Gives the middleware's mutexes priority inheritance (`PTHREAD_PRIO_INHERIT`): a thread of
// real-time priority that waits for such a mutex hands its priority on to the thread that has it.
// Otherwise an ordinary thread of the process that loses its core within DDS makes the chain's
// threads and the gate's wait until it has a core again. Each call into Cyclone DDS takes a mutex
// that all threads share (`dds_handle_pin`).
//
// Other mutexes stay as they are: only the thread that has locked a mutex with priority inheritance
// may unlock it, and a robot's own code need not obey that.
EXPORTED int pthread_mutex_init(pthread_mutex_t * mutex, const pthread_mutexattr_t * given) {
  const auto init = loader().mutex_init;
  if (!is_of_middleware(__builtin_return_address(0))) return init(mutex, given);
  pthread_mutexattr_t attributes;
  int protocol = PTHREAD_PRIO_NONE;
  if (given != nullptr) {
    attributes = *given;
    pthread_mutexattr_getprotocol(given, &protocol);
  } else {
    pthread_mutexattr_init(&attributes);
  }
  if (protocol == PTHREAD_PRIO_NONE)
    pthread_mutexattr_setprotocol(&attributes, PTHREAD_PRIO_INHERIT);
  return init(mutex, &attributes) == 0 ? 0 : init(mutex, given);
}

// NOLINTEND(misc-const-correctness)
