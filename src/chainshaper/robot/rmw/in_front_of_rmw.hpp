// What the library in front of rmw has of ROS 2, for both its gates (`publisher_gate.cpp` and
// `subscriber_gate.cpp`): structs of rmw, the functions behind ours, and the file of settings.
//
// Upstream: rmw, `rmw/types.h` and `rmw/rmw.h`, Humble to Rolling. The first fields of these
// structs and the arguments of these functions are the same in all of them. Where ROS 2 is another
// one, everything passes as if we were not here, and a line on stderr says so.

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

// What we need of rmw's structs.
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
  std::uint64_t others[16];  // more than any version has; 0: as usual
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
  void * room[16];  // returned by value: more than any version has
};

struct MessageInfo {
  std::int64_t source_timestamp;  // CLOCK_REALTIME
  std::uint64_t others[31];       // more than any version has
};

// Of the functions behind ours, those that are called before ours of that name, or without one.
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

// The function behind ours. What Python's nodes load is in no scope of ours: rcl needs all of it.
void * behind(const char * name) {
  if (void * const found = dlsym(RTLD_NEXT, name)) return found;
  void * const loaded = dlopen("librcl.so", RTLD_LAZY | RTLD_NOLOAD);
  return loaded == nullptr ? nullptr : dlsym(loaded, name);
}

// The function of that name behind ours, which is there: `usable` has looked, or its caller has
// linked to it.
#define RMW(name)                                                               \
  (*[] {                                                                        \
    static const auto found = reinterpret_cast<decltype(&name)>(behind(#name)); \
    return found;                                                               \
  }())

[[maybe_unused]] bool is_humble() {
  static const bool is = [] {  // asked for each message
    const char * const distribution = std::getenv("ROS_DISTRO");
    return distribution != nullptr && std::strcmp(distribution, "humble") == 0;
  }();
  return is;
}

// Whether we know this ROS 2; said once where we do not.
bool usable() {
  static const bool known = [] {
    const char * const distribution = std::getenv("ROS_DISTRO");
    const auto is_one_of = [](const char * word, std::initializer_list<std::string> words) {
      return word != nullptr && std::find(words.begin(), words.end(), word) != words.end();
    };
    const bool has_rmw = behind("rmw_get_implementation_identifier") != nullptr;
    const char * const rmw = has_rmw ? RMW(rmw_get_implementation_identifier)() : "no rmw";
    const bool all =
        is_one_of(distribution, {"humble", "jazzy", "kilted", "lyrical", "rolling"}) &&
        is_one_of(rmw, {"rmw_cyclonedds_cpp", "rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp",
                        "rmw_zenoh_cpp", "rmw_connextdds"});
    if (!all)
      say("ROS 2 %s with %s is not known to the gate: outputs leave at once",
          distribution == nullptr ? "(no ROS_DISTRO)" : distribution, rmw);
    return all;
  }();
  return known;
}

// A block of the file that CHAINSHAPER_GATES names: each name with its values.
using Block = std::map<std::string, std::vector<std::string>>;

std::string first_of(const Block & values, const char * name) {
  const auto found = values.find(name);
  return found == values.end() ? std::string() : found->second.front();
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

// The block of an output that `wanted` agrees to, which is asked with it and the node's full name.
template <typename Wanted>
std::optional<Block> block_of(const std::string & topic, const RmwNode & node, Wanted wanted) {
  const char * const path = std::getenv("CHAINSHAPER_GATES");
  if (path == nullptr) return std::nullopt;
  const std::string within = node.name_space;
  const std::string name = (within == "/" ? "" : within) + "/" + node.name;
  for (const auto & block : blocks_of(path))
    if (first_of(block, "output") == topic && wanted(block, name)) return block;
  return std::nullopt;
}

}  // namespace
