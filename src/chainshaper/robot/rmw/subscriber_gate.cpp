// The gate in the process that subscribes: what a node takes of a shaped output is handed on to its
// executor at a constant time behind the publication, whatever the transport took. The executor
// waits for that long, which is less than a millisecond.
//
// The block of an output in the file that CHAINSHAPER_GATES names has `delivery_ns`, and a
// `receiver` for each node that is meant. The publication is the message's source timestamp, which
// the publisher's middleware has set when it was written. What arrives later is handed on at once.
//
// rcl takes every message of a subscription by one of the three functions below.

#include "chainshaper_shaping/shaper.hpp"
#include "in_front_of_rmw.hpp"

namespace {

using namespace chainshaper;  // NOLINT

constexpr std::int64_t watched_ns = 100'000;  // a sleep may end later than it should by that much

struct Delivery {
  std::atomic<const void *> subscription{nullptr};
  std::int64_t after_ns{0};
};

// The subscriptions of this process that are meant; room is given back, but never moved.
std::array<Delivery, 32> deliveries;

void remember(const void * subscription, const RmwNode * node, const char * topic) {
  if (subscription == nullptr || node == nullptr || topic == nullptr) return;
  const auto block = block_of(topic, *node, [](const auto & one, const auto & name) {
    const auto receivers = one.find("receiver");
    return receivers != one.end() && one.count("delivery_ns") > 0 &&
           std::find(receivers->second.begin(), receivers->second.end(), name) !=
               receivers->second.end();
  });
  if (!block || !usable()) return;
  for (auto & one : deliveries) {
    const void * none = nullptr;  // containers load components in several threads
    if (!one.subscription.compare_exchange_strong(none, &one)) continue;
    one.after_ns = std::atoll(first_of(*block, "delivery_ns").c_str());
    one.subscription = subscription;
    return;
  }
  say("%s: this process has too many subscriptions of shaped outputs: it is handed on at once",
      topic);
}

// Wait for the instant at which the executor is to have a message. The clock of its timestamp may
// be set at any time, so the wait is bounded by the whole time.
void wait_for(const void * subscription, const bool * taken, const MessageInfo * info) {
  if (!*taken || info == nullptr || info->source_timestamp <= 0) return;
  for (const auto & one : deliveries) {
    if (one.subscription != subscription) continue;
    const auto passed_ns = clock_ns(CLOCK_REALTIME) - info->source_timestamp;
    const auto at_ns = monotonic_ns() + std::min(one.after_ns, one.after_ns - passed_ns);
    if (passed_ns >= one.after_ns) return;
    sleep_until(at_ns - watched_ns);
    watch_until(at_ns);
    return;
  }
}

}  // namespace

EXPORTED void * rmw_create_subscription(const RmwNode * node, const void * type_support,
                                        const char * topic, const RmwQos * qos,
                                        const void * options) {
  void * const subscription = RMW(rmw_create_subscription)(node, type_support, topic, qos, options);
  try {
    remember(subscription, node, topic);
  } catch (const std::exception & error) {
    say("%s is handed on at once: %s", topic, error.what());
  }
  return subscription;
}

EXPORTED int rmw_destroy_subscription(RmwNode * node, void * subscription) {
  for (auto & one : deliveries)
    if (one.subscription == subscription) one.subscription = nullptr;
  return RMW(rmw_destroy_subscription)(node, subscription);
}

#define TAKE(name)                                                                               \
  EXPORTED int name(const void * subscription, void * message, bool * taken, MessageInfo * info, \
                    void * allocation) {                                                         \
    const int code = RMW(name)(subscription, message, taken, info, allocation);                  \
    if (code == 0) wait_for(subscription, taken, info);                                          \
    return code;                                                                                 \
  }
TAKE(rmw_take_with_info)
TAKE(rmw_take_serialized_message_with_info)
TAKE(rmw_take_loaned_message_with_info)
