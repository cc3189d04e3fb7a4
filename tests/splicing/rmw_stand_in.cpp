// Stands in for rmw, rcutils, tracetools and std_msgs where no ROS 2 is: what the gates in the
// processes that publish and subscribe (robot/) call, and are called by. Compiled with
// PROGRAM, it is such a process instead: each line of its standard input is
//
//   subscription TOPIC NODE | take NS SUBSCRIPTION STAMP | publisher TOPIC NODE DEPTH | at NS PUBLISHER STAMP | serialized NS PUBLISHER STAMP
//   | loaned NS PUBLISHER STAMP | mode NS TOPIC NAME | end NS PUBLISHER | fork NS PUBLISHER | until NS
//
// in the order of their times, which count from the instant in the first line (CLOCK_MONOTONIC),
// which is asked for by "ready". A STAMP counts from there too; - is none. What is written to DDS, and what
// tracers see, is on standard output.

#include <sys/stat.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <iostream>
#include <map>
#include <mutex>
#include <string>

struct Node {
  const char * implementation;
  void * data;
  const char * name;
  const char * name_space;
};
struct Publisher {
  const char * implementation;
  void * data;
  const char * topic;
};
struct Qos {
  int history;
  std::size_t depth;
  std::uint64_t others[16];
};
struct Allocator {
  void * (*allocate)(std::size_t, void *);
  void (*deallocate)(void *, void *);
  void * (*reallocate)(void *, std::size_t, void *);
  void * (*zero_allocate)(std::size_t, std::size_t, void *);
  void * state;
};
struct Bytes {
  std::uint8_t * buffer;
  std::size_t length, capacity;
  Allocator allocator;
};
struct Options {
  void * payload[3];
};
struct Info {
  std::int64_t source_timestamp;
};
struct Message {
  std::int64_t stamp, number;
};

extern "C" {
const char * rmw_get_implementation_identifier();
Publisher * rmw_create_publisher(const Node *, const void *, const char *, const Qos *,
                                 const void *);
int rmw_destroy_publisher(Node *, Publisher *);
int rmw_publish(const Publisher *, const void *, void *);
int rmw_publish_serialized_message(const Publisher *, const Bytes *, void *);
int rmw_publish_loaned_message(const Publisher *, void *, void *);
int rmw_borrow_loaned_message(const Publisher *, const void *, void **);
bool rcl_publisher_can_loan_messages(const void *);
const Publisher * rcl_publisher_get_rmw_handle(const void *);
int rmw_serialize(const void *, const void *, Bytes *);
Options rmw_get_default_subscription_options();
void * rmw_create_subscription(const Node *, const void *, const char *, const Qos *,
                               const Options *);
int rmw_take_serialized_message_with_info(const void *, Bytes *, bool *, Info *, void *);
int rmw_take_with_info(const void *, void *, bool *, Info *, void *);
int rmw_destroy_subscription(Node *, void *);
Allocator rcutils_get_default_allocator();
const void * rosidl_typesupport_c__get_message_type_support_handle__std_msgs__msg__String();
void ros_trace_rcl_publisher_init(const void *, const void *, const void *, const char *,
                                  std::size_t);
void ros_trace_rcl_publish(const void *, const void *);
void announce(const char * topic, const char * mode, std::int64_t stamp);
}

static std::int64_t now(clockid_t clock) {
  timespec time{};
  clock_gettime(clock, &time);
  return time.tv_sec * std::int64_t{1'000'000'000} + time.tv_nsec;
}

#ifndef PROGRAM

static std::mutex one_at_a_time;
using Modes = std::deque<std::pair<std::string, std::int64_t>>;
static std::map<std::string, Modes> all_modes;  // by topic

template <typename... Values>
static void line(const char * format, Values... values) {
  const std::lock_guard<std::mutex> lock(one_at_a_time);
  std::printf(format, values...);
  std::fflush(stdout);
}

const char * rmw_get_implementation_identifier() {
  const char * const other = std::getenv("STAND_IN_FOR");
  return other == nullptr ? "rmw_cyclonedds_cpp" : other;
}

Publisher * rmw_create_publisher(const Node *, const void *, const char * topic, const Qos *,
                                 const void *) {
  return new Publisher{rmw_get_implementation_identifier(), nullptr, strdup(topic)};
}

int rmw_destroy_publisher(Node *, Publisher * publisher) {
  line("destroyed %s\n", publisher->topic);
  return 0;
}

static int written(const char * how, const Publisher * publisher, std::int64_t number) {
  const auto began = now(CLOCK_MONOTONIC);
  while (now(CLOCK_MONOTONIC) < began + 125'000) continue;
  line("%s %s %lld %lld\n", how, publisher->topic, static_cast<long long>(number),
       static_cast<long long>(began));
  return 0;
}

int rmw_publish(const Publisher * publisher, const void * message, void *) {
  return written("typed", publisher, static_cast<const Message *>(message)->number);
}

int rmw_publish_loaned_message(const Publisher * publisher, void * message, void *) {
  return written("loaned", publisher, static_cast<const Message *>(message)->number);
}

int rmw_borrow_loaned_message(const Publisher *, const void *, void **) { return 0; }

// An rcl_publisher_t is here a pointer to one of rmw's.
bool rcl_publisher_can_loan_messages(const void *) { return true; }

const Publisher * rcl_publisher_get_rmw_handle(const void * handle) {
  return *static_cast<const Publisher * const *>(handle);
}

int rmw_publish_serialized_message(const Publisher * publisher, const Bytes * bytes, void *) {
  std::int64_t number = 0;
  std::memcpy(&number, bytes->buffer + 12, 8);
  return written("serialized", publisher, number);
}

int rmw_serialize(const void * message, const void *, Bytes * bytes) {
  const auto & [stamp, number] = *static_cast<const Message *>(message);
  const auto seconds = static_cast<std::int32_t>(stamp / 1'000'000'000);
  const auto nanoseconds = static_cast<std::uint32_t>(stamp % 1'000'000'000);
  bytes->buffer = static_cast<std::uint8_t *>(bytes->allocator.allocate(20, nullptr));
  bytes->length = bytes->capacity = 20;
  const std::uint8_t little[4] = {0, 1, 0, 0};
  std::memcpy(bytes->buffer, little, 4);
  std::memcpy(bytes->buffer + 4, &seconds, 4);
  std::memcpy(bytes->buffer + 8, &nanoseconds, 4);
  std::memcpy(bytes->buffer + 12, &number, 8);
  return 0;
}

Options rmw_get_default_subscription_options() { return {}; }

void * rmw_create_subscription(const Node *, const void *, const char * topic, const Qos *,
                               const Options *) {
  return new std::string(topic);
}

int rmw_take_serialized_message_with_info(const void * from, Bytes * bytes, bool * taken,
                                          Info * info, void *) {
  const std::lock_guard<std::mutex> lock(one_at_a_time);
  auto & modes = all_modes[*static_cast<const std::string *>(from)];
  *taken = !modes.empty();
  if (!*taken) return 0;
  const auto [mode, stamp] = modes.front();
  modes.pop_front();
  info->source_timestamp = stamp;
  bytes->length = bytes->capacity = 9 + mode.size();
  bytes->buffer = static_cast<std::uint8_t *>(bytes->allocator.allocate(bytes->length, nullptr));
  const std::uint8_t little[4] = {0, 1, 0, 0};
  const auto length = static_cast<std::uint32_t>(mode.size() + 1);
  std::memcpy(bytes->buffer, little, 4);
  std::memcpy(bytes->buffer + 4, &length, 4);
  std::memcpy(bytes->buffer + 8, mode.c_str(), mode.size() + 1);
  return 0;
}

// A message is nothing but its source timestamp; without one there is none to take.
int rmw_take_with_info(const void *, void * message, bool * taken, Info * info, void *) {
  info->source_timestamp = *static_cast<std::int64_t *>(message);
  *taken = info->source_timestamp != 0;
  return 0;
}

int rmw_destroy_subscription(Node *, void * subscription) {
  delete static_cast<std::string *>(subscription);
  return 0;
}

void announce(const char * topic, const char * mode, std::int64_t stamp) {
  const std::lock_guard<std::mutex> lock(one_at_a_time);
  all_modes[topic].emplace_back(mode, stamp);
}

Allocator rcutils_get_default_allocator() {
  return {[](std::size_t size, void *) { return std::malloc(size); },
          [](void * bytes, void *) { std::free(bytes); },
          [](void * bytes, std::size_t size, void *) { return std::realloc(bytes, size); },
          [](std::size_t count, std::size_t size, void *) { return std::calloc(count, size); },
          nullptr};
}

const void * rosidl_typesupport_c__get_message_type_support_handle__std_msgs__msg__String() {
  return &all_modes;
}

#define TRACED(name) \
  extern "C" void ros_trace_##name(std::uintptr_t a, std::uintptr_t b, std::uintptr_t c) { \
    line("trace " #name " %llx %llx %lld %lld\n", static_cast<unsigned long long>(a), \
         static_cast<unsigned long long>(b), static_cast<long long>(c), \
         static_cast<long long>(now(CLOCK_REALTIME))); \
  }
TRACED(rcl_node_init)
TRACED(rcl_subscription_init)
TRACED(rclcpp_subscription_init)
TRACED(rclcpp_subscription_callback_added)
TRACED(rclcpp_callback_register)
TRACED(rmw_publish)
TRACED(rmw_take)
TRACED(callback_start)
TRACED(callback_end)

void ros_trace_rcl_publisher_init(const void * handle, const void * node, const void * rmw,
                                  const char * topic, std::size_t) {
  line("trace rcl_publisher_init %p %p %p %s\n", handle, node, rmw, topic);
}

void ros_trace_rcl_publish(const void * handle, const void *) {
  line("trace rcl_publish %p\n", handle);
}

#else

int main() {
  std::puts("ready");
  std::fflush(stdout);
  std::int64_t start = 0;
  std::cin >> start;
  const std::int64_t offset = now(CLOCK_REALTIME) - now(CLOCK_MONOTONIC);
  std::deque<Publisher *> publishers;
  std::deque<void *> subscriptions;
  std::deque<std::string> names;
  std::deque<Node> nodes;
  std::deque<std::FILE *> own_files;
  std::int64_t number = 0;
  for (std::string what; std::cin >> what;) {
    if (what == "publisher") {
      std::string topic;
      std::size_t depth = 0;
      std::cin >> topic >> names.emplace_back() >> depth;
      nodes.push_back({"", nullptr, names.back().c_str(), "/"});
      const Qos qos{1, depth, {}};
      publishers.push_back(
          rmw_create_publisher(&nodes.back(), &nodes, topic.c_str(), &qos, nullptr));
      ros_trace_rcl_publisher_init(&publishers.back(), &nodes.back(), publishers.back(),
                                   topic.c_str(), depth);
      continue;
    }
    if (what == "subscription") {
      std::string topic;
      std::cin >> topic >> names.emplace_back();
      const Node node{"", nullptr, names.back().c_str(), "/"};
      subscriptions.push_back(
          rmw_create_subscription(&node, &nodes, topic.c_str(), nullptr, nullptr));
      continue;
    }
    std::int64_t at = 0;
    std::cin >> at;
    const timespec until{(start + at) / 1'000'000'000, (start + at) % 1'000'000'000};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, nullptr);
    std::string word;
    if (what != "until") std::cin >> word;
    if (what == "mode") {
      std::string mode;
      std::cin >> mode;
      announce(word.c_str(), mode.c_str(), start + at + offset);
    }
    if (what == "mode" || what == "until") continue;
    if (what == "take") {
      std::int64_t stamp = 0;
      bool taken = false;
      Info info[32]{};
      std::cin >> stamp;
      if (stamp != 0) stamp += start + offset;
      const auto began = now(CLOCK_MONOTONIC);
      rmw_take_with_info(subscriptions[std::stoul(word)], &stamp, &taken, info, nullptr);
      std::printf("handed %s %lld %lld\n", word.c_str(), static_cast<long long>(began - start),
                  static_cast<long long>(now(CLOCK_MONOTONIC) - start));
      continue;
    }
    if (what == "reuse") {  // as a daemon: closes all descriptors, and has files under the same numbers
      for (int file = 3; file < 100; ++file) close(file);
      for (int count = 0; count < 20; ++count) own_files.push_back(std::tmpfile());
      continue;
    }
    Publisher *& publisher = publishers[std::stoul(word)];
    if (what == "fork") {  // a child that ends as its parent would
      const pid_t child = fork();
      if (child == 0) _exit(rmw_destroy_publisher(&nodes[0], publisher));
      waitpid(child, nullptr, 0);
      continue;
    }
    if (what == "end") {
      rmw_destroy_publisher(&nodes[0], publisher);
      continue;
    }
    Message message{0, number++};
    std::cin >> word;
    if (word != "-") message.stamp = start + offset + std::stoll(word);
    if (what == "loaned") {  // what rclcpp does not do without having asked
      void * loan = nullptr;
      std::printf("borrowed %d\n", rmw_borrow_loaned_message(publisher, nullptr, &loan));
    }
    const auto began = now(CLOCK_MONOTONIC);
    if (what == "loaned" && rcl_publisher_can_loan_messages(&publisher)) {
      rmw_publish_loaned_message(publisher, &message, nullptr);
    } else {
      ros_trace_rcl_publish(&publisher, &message);
      Bytes bytes{nullptr, 0, 0, rcutils_get_default_allocator()};
      if (what == "serialized") rmw_serialize(&message, nullptr, &bytes);
      what == "serialized" ? rmw_publish_serialized_message(publisher, &bytes, nullptr)
                           : rmw_publish(publisher, &message, nullptr);
      std::free(bytes.buffer);
    }
    std::printf("took %lld\n", static_cast<long long>(now(CLOCK_MONOTONIC) - began));
  }
  for (auto * one : subscriptions) rmw_destroy_subscription(nullptr, one);
  for (auto * publisher : publishers) rmw_destroy_publisher(&nodes[0], publisher);
  for (auto * file : own_files) {
    struct stat found {};
    const bool is_open = fstat(fileno(file), &found) == 0;
    std::printf("own %d %lld\n", is_open, static_cast<long long>(found.st_size));
  }
}

#endif
