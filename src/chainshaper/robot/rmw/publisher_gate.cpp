// The gate in the process that publishes: `LD_PRELOAD` loads it into a node, where it stands before
// rmw. What the node publishes on a shaped output is serialized and waits in a thread of this
// library, which sends it in the slots of the output's server. The node's executor goes on at once.
//
// CHAINSHAPER_GATES names a file with the outputs, a block of lines `NAME VALUE` each, which begins
// with `output`: what ROS parameters say to a shaping node, and `node`, `input`, `publisher`,
// `thread`.
//
// Tracers see what they would see of a shaping node (`node`): the node of the application publishes
// on `input`, our thread takes that, as a callback of `node`, and publishes it on `output`.

#include <link.h>
#include <pthread.h>
#include <semaphore.h>

#include <memory>
#include <new>
#include <thread>

#include "chainshaper_shaping/gate_log.hpp"
#include "chainshaper_shaping/handover.hpp"
#include "in_front_of_rmw.hpp"

namespace {

using namespace chainshaper;  // NOLINT

// Emits an event of ros2_tracing, whose arguments are all integers or pointers.
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

// `rmw_publish` as the distribution has it: from Jazzy on with publisher and time stamp.
void emit_write(const void * publisher, const void * message, std::int64_t stamp) {
  if (is_humble())
    EMIT(rmw_publish, message);
  else
    EMIT(rmw_publish, publisher, message, stamp);
}

class Serialized {
public:
  Serialized() { bytes.allocator = RMW(rcutils_get_default_allocator)(); }

  Serialized(const Serialized &) = delete;
  Serialized & operator=(const Serialized &) = delete;

  ~Serialized() {
    if (bytes.buffer != nullptr) bytes.allocator.deallocate(bytes.buffer, bytes.allocator.state);
  }

  Bytes bytes{};
  std::int64_t stamp{0};       // CLOCK_REALTIME, when it was published
  Serialized * next{nullptr};  // that came before
};
using Message = std::unique_ptr<Serialized>;

struct Settings {
  explicit Settings(const Block & values) {
    output = first_of(values, "output"), input = first_of(values, "input");
    node = first_of(values, "node"), thread = first_of(values, "thread");
    parameters.each([&](const char * name, auto & value) {
      if (const auto found = values.find(name); found != values.end())
        for (const auto & word : found->second) assign(value, word);
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

// The topic on which modes are announced, as the gate's thread reads it: a std_msgs/String.
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

  // The modes that were announced since the last time, each with the time (CLOCK_MONOTONIC).
  template <typename Announced>
  void read(Announced announced) {
    const auto take = RMW(rmw_take_serialized_message_with_info);
    while (subscription_ != nullptr) {
      Serialized text;
      MessageInfo info{};
      bool taken = false;
      if (take(subscription_, &text.bytes, &taken, &info, nullptr) != 0 || !taken) return;
      const auto now = monotonic_ns(), sent = info.source_timestamp;
      const auto at = sent > 0 ? std::min(now, sent - clock_offset()) : now;
      if (const auto mode = text_of(text.bytes.buffer, text.bytes.length)) announced(*mode, at);
    }
  }

private:
  void * subscription_{nullptr};
};

struct Over {};  // the publisher is destroyed

// A publisher whose messages we send, with the thread that does it.
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
    show();
    const auto & parameters = settings_.parameters;
    if (!parameters.log.empty() && !log_.open_file(parameters.log, parameters.log_bytes))
      say("no log is written to %s: %s", parameters.log.c_str(), std::strerror(errno));
    sem_init(&more_, 0, 0);
    const SignalsBlocked inherited;
    thread_ = std::thread([this] { run(); });
  }

  ~Output() {
    over_ = true;
    sem_post(&more_);
    thread_.join();
    Message all(arrived_.exchange(nullptr));
    std::size_t left = shaper_.queue.waiting.size();
    for (; all; all.reset(all->next)) ++left;
    if (left > 0)
      say("%s: its publisher has ended, messages that were not published: %zu",
          settings_.output.c_str(), left);
    sem_destroy(&more_);
  }

  // Creation events: the application's node publishes on `input`, `node` takes that, and publishes.
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

  // In the thread that publishes; it waits for nothing. `fill` serializes the message. rmw's code;
  // none: the message is not taken, so that it is to be published at once.
  template <typename Fill>
  std::optional<int> take(const void * ros_message, Fill fill) {
    if (failed_at_all_) return std::nullopt;
    Message message(new (std::nothrow) Serialized);
    if (!message) return std::nullopt;
    // Where the event has no stamp, a message's publication is the last one before its stamp.
    if (is_humble()) emit_write(&rmw_input_, ros_message, 0);
    message->stamp = next_stamp();
    if (!is_humble()) emit_write(&rmw_input_, ros_message, message->stamp);
    if (const int failed = fill(message->bytes)) return failed;
    Serialized * const newest = message.release();
    newest->next = arrived_.load(std::memory_order_relaxed);
    while (!arrived_.compare_exchange_weak(newest->next, newest)) continue;
    sem_post(&more_);
    if (failed_at_all_) publish_arrived();  // meanwhile
    return 0;
  }

  const RmwPublisher * const publisher;
  const void * const type_support;
  const void * rcl_publisher{nullptr};

private:
  // A page shows what becomes of the output; no standby looks at it. Cycles begin where they did
  // for the process before this one, in its mode.
  void show() {
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

  // Of CLOCK_REALTIME, and each once: it tells a message from the others.
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
        for (const auto & gone : shaper_.overflowed) note(gone);
        shaper_.overflowed.clear();
        if (!shaper_.queue.waiting.empty()) serve();
      }
    } catch (const Over &) {
      return;
    } catch (const std::exception & error) {
      failed_at_all_ = true;
      say("%s: its gate has failed (%s): all that is published leaves at once from now on",
          settings_.output.c_str(), error.what());
      publish_all();
    }
  }

  // What waits leaves at once, in its order.
  void publish_all() {
    for (const auto & waiting : shaper_.queue.waiting)
      if (waiting.message) publish(*waiting.message);
    shaper_.queue.waiting.clear();
    publish_arrived();
  }

  void publish_arrived() {
    std::vector<Message> newest_first;
    for (auto * message = arrived_.exchange(nullptr); message != nullptr; message = message->next)
      newest_first.emplace_back(message);
    for (auto message = newest_first.rbegin(); message != newest_first.rend(); ++message)
      publish(**message);
  }

  void look() {
    if (over_) throw Over();
    read_modes();
    std::vector<Message> all;  // the newest first
    for (auto * one = arrived_.exchange(nullptr); one != nullptr; one = one->next)
      all.emplace_back(one);
    for (auto one = all.rbegin(); one != all.rend(); ++one) {
      const auto & [bytes, stamp, next] = **one;
      const auto origin = origin_of(bytes.buffer, bytes.length);
      const auto source = stamp;
      shaper_.arrive(std::move(*one), origin, source, true, 0);
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

  void serve() {
    const auto & oldest = shaper_.queue.waiting.front();
    EMIT(rmw_take, &rmw_subscription_, oldest.message.get(), oldest.message->stamp, true);
    EMIT(callback_start, &callback_, false);
    const auto key = oldest.message->stamp;
    if (turn_) turn_->take(key);
    const auto outcome = shaper_.hold();
    Maybe published_ns, stalled_ns;
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
    if (code != 0 && !failed_) say("%s cannot be published: %d", settings_.output.c_str(), code);
    failed_ = code != 0;
  }

  const Settings settings_;
  const RmwNode * node_;
  // What traces call the things that are not there: addresses of their own.
  char node_handle_, rmw_node_, input_handle_, rmw_input_, subscription_handle_, rmw_subscription_,
      subscription_, callback_;
  std::atomic<Serialized *> arrived_{nullptr};  // the newest first
  std::atomic<std::int64_t> stamp_{0};
  std::atomic<bool> over_{false};
  std::atomic<bool> failed_at_all_{false};  // the gate's thread has ended by an error
  bool failed_{false};
  sem_t more_{};
  std::optional<Turn> turn_;
  Shaper<Message> shaper_;
  GateLog log_;
  std::optional<ModeTopic> modes_;
  std::thread thread_;
};

// The outputs of this process, in the order of their making; room is given back, but never moved.
std::array<std::atomic<Output *>, 32> outputs;

template <typename Is>
Output * find_output(Is is) {
  for (const auto & one : outputs)
    if (Output * const output = one; output != nullptr && is(*output)) return output;
  return nullptr;
}

Output * output_of(const RmwPublisher * publisher) {
  return find_output([=](const Output & one) { return one.publisher == publisher; });
}

// A child of fork() has none of our threads, so nothing of it is shaped.
void in_child() {
  for (auto & one : outputs) one = nullptr;
}

void shape(const RmwNode * node, const RmwPublisher * publisher, const void * type_support,
           const RmwQos & qos) {
  if (node == nullptr || publisher == nullptr || publisher->topic == nullptr) return;
  try {
    const auto block = block_of(publisher->topic, *node, [](const auto & one, const auto & name) {
      const auto meant = first_of(one, "publisher");
      return !first_of(one, "node").empty() && (meant.empty() || meant == name);
    });
    if (!block || !usable()) return;
    const Settings settings(*block);
    [[maybe_unused]] static const int once = pthread_atfork(nullptr, nullptr, in_child);
    const auto depth = depth_of(settings.parameters, qos.depth);
    auto output = std::make_unique<Output>(settings, node, publisher, type_support, depth);
    for (auto & one : outputs)
      if (Output * none = nullptr; one.compare_exchange_strong(none, output.get())) {
        output.release();
        return;
      }
    say("%s: this process has too many shaped outputs: it leaves at once", publisher->topic);
  } catch (const std::exception & error) {
    say("%s leaves at once: its gate in %s is wrong: %s", publisher->topic,
        std::getenv("CHAINSHAPER_GATES"), error.what());
  }
}

// As the C library of 2.35 and later has it in <dlfcn.h>.
struct FoundObject {
  unsigned long long flags;  // NOLINT - the C library's
  void * start;
  void * end;
  struct link_map * loaded;
  void * others[16];
};

// What making a mutex needs of the loader. It is asked as we are loaded: later it may have locks
// taken for whose end a thread must not wait that makes a mutex.
struct Loader {
  decltype(&pthread_mutex_init) mutex_init{
      reinterpret_cast<decltype(&pthread_mutex_init)>(dlsym(RTLD_NEXT, "pthread_mutex_init"))};
  int (*find_object)(void *, FoundObject *){
      reinterpret_cast<int (*)(void *, FoundObject *)>(dlsym(RTLD_DEFAULT, "_dl_find_object"))};
};

const Loader & loader() {
  static const Loader known;
  return known;
}

[[maybe_unused]] const Loader & at_loading = loader();

// The file of the library that has code at an address; "": not known.
const char * library_of(void * address) {
  FoundObject object{};
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

EXPORTED RmwPublisher * rmw_create_publisher(const RmwNode * node, const void * type_support,
                                             const char * topic, const RmwQos * qos,
                                             const void * options) {
  auto * const publisher = RMW(rmw_create_publisher)(node, type_support, topic, qos, options);
  shape(node, publisher, type_support, qos == nullptr ? RmwQos{} : *qos);
  return publisher;
}

EXPORTED int rmw_destroy_publisher(RmwNode * node, RmwPublisher * publisher) {
  Output * const output = output_of(publisher);
  for (auto & one : outputs)
    if (output != nullptr && one == output) one = nullptr;
  delete output;
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

// A loaned message leaves as it is: it cannot wait without a copy. rclcpp asks before it borrows
// one, and where the answer is no it publishes from memory of its own, which is shaped like any
// other.
EXPORTED bool rcl_publisher_can_loan_messages(const void * handle) {
  static std::atomic<bool> said;
  if (!RMW(rcl_publisher_can_loan_messages)(handle)) return false;
  const auto * const publisher = RMW(rcl_publisher_get_rmw_handle)(handle);
  if (output_of(publisher) == nullptr) return true;
  if (!said.exchange(true))
    say("%s: no messages are loaned: they cannot wait for their slot without a copy, so the node's "
        "own"
        " memory is used; plan with --publication synchronous to have loans",
        publisher->topic);
  return false;
}

EXPORTED int rmw_borrow_loaned_message(const RmwPublisher * publisher, const void * type_support,
                                       void ** message) {
  if (output_of(publisher) != nullptr) return 3;  // RMW_RET_UNSUPPORTED
  return RMW(rmw_borrow_loaned_message)(publisher, type_support, message);
}

// Called by rcl for each publisher, behind rmw_create_publisher.
EXPORTED void ros_trace_rcl_publisher_init(const void * handle, const void * node,
                                           const void * rmw_publisher, const char * topic,
                                           std::uintptr_t depth) {
  if (Output * const output = output_of(static_cast<const RmwPublisher *>(rmw_publisher)))
    output->describe(handle, node, depth);
  else
    EMIT(rcl_publisher_init, handle, node, rmw_publisher, topic, depth);
}

EXPORTED void ros_trace_rcl_publish(const void * handle, const void * message) {
  const auto is = [=](const Output & one) { return one.rcl_publisher == handle; };
  const Output * const output = find_output(is);
  EMIT(rcl_publish, output == nullptr ? handle : output->input_handle(), message);
}

// A thread of real-time priority that waits for a mutex hands its priority on to the thread that
// has it, as does the kernel for what is `PTHREAD_PRIO_INHERIT`: else an ordinary thread of the
// process which loses its core within DDS keeps the chain's threads and the gate's waiting until it
// has one again. Each call into Cyclone DDS takes a mutex that all threads share
// (`dds_handle_pin`).
//
// Only mutexes that the middleware makes are changed. One with priority inheritance may be unlocked
// by the thread only that has locked it, which a robot's own code need not keep to.
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
