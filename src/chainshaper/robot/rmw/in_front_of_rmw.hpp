// What the library in front of rmw uses of ROS 2, for both its gates (`publisher_gate.cpp` and
// `subscriber_gate.cpp`): structs of rmw, the functions behind ours, and the file of settings.
//
// Upstream: rmw, `rmw/types.h` and `rmw/rmw.h`, Humble to Rolling. The first fields of these
// structs and the arguments of these functions are the same in all of these distributions. With any
// other distribution or middleware the library shapes nothing, and a line on stderr says so.

#pragma once

#include <dlfcn.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <initializer_list>
#include <map>
#include <optional>
#include <string>
#include <vector>

#define EXPORTED extern "C" __attribute__((visibility("default")))

// The parts of rmw's structs that the gates read or write.
struct RmwNode {
  const char * implementation;
  void * data;
  const char * name;
  const char * name_space;
};

struct RmwPublisher {
  const char * implementation;
  void * data;
  const char * topic;
};

struct RmwQos {
  int history;
  std::size_t depth;
  int reliability;
  int durability;
  std::uint64_t others[16];  // more than any version has; 0: the default
};
enum { keep_last = 1, reliable = 1, best_available_reliability = 4 };
enum { volatile_durability = 2, best_available_durability = 4 };

struct Allocator {
  void * (*allocate)(std::size_t, void *);
  void (*deallocate)(void *, void *);
  void * others[2];
  void * state;
};

struct Bytes {  // rcutils_uint8_array_t
  std::uint8_t * buffer;
  std::size_t length;
  std::size_t capacity;
  Allocator allocator;
};

struct SubscriptionOptions {
  void * room[16];  // more than any version has: the struct is returned by value
};

struct MessageInfo {
  std::int64_t source_timestamp;  // CLOCK_REALTIME
  std::uint64_t others[31];       // more than any version has
};

// Functions of ROS 2 that the gates call, but for those that they define themselves further down.
extern "C" {
Allocator rcutils_get_default_allocator();
const RmwPublisher * rcl_publisher_get_rmw_handle(const void * handle);
const char * rmw_get_implementation_identifier();
SubscriptionOptions rmw_get_default_subscription_options();
int rmw_publish_serialized_message(const RmwPublisher * publisher, const Bytes * message,
                                   void * allocation);
int rmw_serialize(const void * message, const void * type_support, Bytes * bytes);
void * rmw_create_subscription(const RmwNode * node, const void * type_support, const char * topic,
                               const RmwQos * qos, const void * options);
int rmw_take_serialized_message_with_info(const void * subscription, void * bytes, bool * taken,
                                          MessageInfo * info, void * allocation);
}

namespace {

template <typename... Values>
void say(const char * format, Values... values) {
  const std::string line = std::string("[chainshaper] ") + format + "\n";
  std::fprintf(stderr, line.c_str(), values...);
}

// Returns the function of that name in the libraries behind this one; null: there is none.
void * behind(const char * name) {
  if (void * const function = dlsym(RTLD_NEXT, name)) return function;
  // Python's nodes load ROS 2 into a scope of their own, which rcl's library leads to.
  void * const rcl = dlopen("librcl.so", RTLD_LAZY | RTLD_NOLOAD);
  return rcl == nullptr ? nullptr : dlsym(rcl, name);
}

// Returns that function where there must be one: `usable` has looked for it, or the caller of ours
// is linked to it.
template <typename Function>
Function required_behind(const char * name) {
  void * const function = behind(name);
  if (function == nullptr) {
    say("%s is not in this process's ROS 2", name);
    std::abort();
  }
  return reinterpret_cast<Function>(function);
}

// Calls the function of that name behind ours: `RMW(rmw_publish)(publisher, …)`.
#define RMW(name)                                                           \
  (*[] {                                                                    \
    static const auto function = required_behind<decltype(&(name))>(#name); \
    return function;                                                        \
  }())

[[maybe_unused]] bool is_humble() {
  static const bool humble = [] {  // the gates ask for each message
    const char * const distribution = std::getenv("ROS_DISTRO");
    return distribution != nullptr && std::strcmp(distribution, "humble") == 0;
  }();
  return humble;
}

// Returns whether the gates know this distribution and middleware; says once that they do not.
bool usable() {
  static const bool is_known = [] {
    const char * const distribution = std::getenv("ROS_DISTRO");
    const auto is_one_of = [](const char * word, std::initializer_list<std::string> words) {
      return word != nullptr && std::find(words.begin(), words.end(), word) != words.end();
    };
    const bool has_rmw = behind("rmw_get_implementation_identifier") != nullptr;
    const char * const rmw = has_rmw ? RMW(rmw_get_implementation_identifier)() : "no rmw";
    const bool are_known =
        is_one_of(distribution, {"humble", "jazzy", "kilted", "lyrical", "rolling"}) &&
        is_one_of(rmw, {"rmw_cyclonedds_cpp", "rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp",
                        "rmw_zenoh_cpp", "rmw_connextdds"});
    if (!are_known)
      say("ROS 2 %s with %s is not known to the gate: outputs leave at once",
          distribution == nullptr ? "(no ROS_DISTRO)" : distribution, rmw);
    return are_known;
  }();
  return is_known;
}

// A block of lines of the file that CHAINSHAPER_GATES names: each name with its values.
using Block = std::map<std::string, std::vector<std::string>>;

std::string first_of(const Block & values, const char * name) {
  const auto entry = values.find(name);
  return entry == values.end() ? std::string() : entry->second.front();
}

std::vector<Block> blocks_of(const std::string & path) {
  std::vector<Block> blocks;
  std::ifstream file(path);
  for (std::string line; std::getline(file, line);) {
    const auto space = line.find(' ');
    if (space == std::string::npos) continue;
    const auto name = line.substr(0, space);
    if (name == "output" || blocks.empty()) blocks.emplace_back();
    blocks.back()[name].push_back(line.substr(space + 1));
  }
  return blocks;
}

// Returns the first block of an output for which `applies` returns true, given the block and the
// node's full name.
template <typename Applies>
std::optional<Block> block_of(const std::string & topic, const RmwNode & node, Applies applies) {
  const char * const path = std::getenv("CHAINSHAPER_GATES");
  if (path == nullptr) return std::nullopt;
  const std::string name_space = node.name_space;
  const std::string name = (name_space == "/" ? "" : name_space) + "/" + node.name;
  for (const auto & block : blocks_of(path))
    if (first_of(block, "output") == topic && applies(block, name)) return block;
  return std::nullopt;
}

}  // namespace
