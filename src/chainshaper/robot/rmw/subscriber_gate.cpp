// The gate in the process that subscribes: it hands a node's executor each message of a shaped
// output at a constant time behind the publication, whatever the transport took. The executor waits
// for it, less than a millisecond.
//
// In the file that CHAINSHAPER_GATES names, the output's block has `delivery_ns`, and a `receiver`
// for each node whose subscriptions are delayed. The time of the publication is the message's
// source timestamp: the publisher's middleware set it when the message was written. The gate hands
// on at once a message that arrives later than `delivery_ns` behind that.
//
// rcl takes every message of a subscription by one of the three functions at the end.

#include "chainshaper_shaping/shaper.hpp"
#include "in_front_of_rmw.hpp"

namespace {

using namespace chainshaper;  // NOLINT

// A sleep may end that much too late: the thread watches the clock for the last part of a wait.
constexpr std::int64_t watched_ns = 100'000;

struct Delivery {
  std::atomic<const void *> subscription{nullptr};
  std::int64_t after_ns{0};
};

// The delayed subscriptions of this process. A free place has none; a place never moves.
std::array<Delivery, 32> deliveries;

// Returns the delay of a block's output (ns). Throws std::invalid_argument if it is no number.
std::int64_t delay_of(const Block & block) {
  const auto text = first_of(block, "delivery_ns");
  char * end = nullptr;
  const std::int64_t delay_ns = std::strtoll(text.c_str(), &end, 10);
  if (text.empty() || *end != '\0') throw std::invalid_argument("no delivery_ns: " + text);
  return delay_ns;
}

// Delays a new subscription's messages if the file of settings says so.
void remember(const void * subscription, const RmwNode * node, const char * topic) {
  if (subscription == nullptr || node == nullptr || topic == nullptr) return;
  const auto block = block_of(topic, *node, [](const Block & candidate, const std::string & name) {
    const auto receivers = candidate.find("receiver");
    return receivers != candidate.end() && candidate.count("delivery_ns") > 0 &&
           std::find(receivers->second.begin(), receivers->second.end(), name) !=
               receivers->second.end();
  });
  if (!block || !usable()) return;
  const auto delay_ns = delay_of(*block);
  for (auto & delivery : deliveries) {
    // Containers load components in several threads: an address of ours reserves the place.
    const void * free_place = nullptr;
    if (!delivery.subscription.compare_exchange_strong(free_place, &delivery)) continue;
    delivery.after_ns = delay_ns;
    delivery.subscription = subscription;
    return;
  }
  say("%s: this process has too many subscriptions of shaped outputs: it is handed on at once",
      topic);
}

// Waits for the instant at which the executor gets a message. The wall clock, which timestamps are
// of, may be set at any time: no wait is longer than the whole delay.
void wait_for(const void * subscription, const bool * taken, const MessageInfo * info) {
  if (!*taken || info == nullptr || info->source_timestamp <= 0) return;
  for (const auto & delivery : deliveries) {
    if (delivery.subscription != subscription) continue;
    const auto passed_ns = clock_ns(CLOCK_REALTIME) - info->source_timestamp;
    const auto at_ns = monotonic_ns() + std::min(delivery.after_ns, delivery.after_ns - passed_ns);
    if (passed_ns >= delivery.after_ns) return;
    sleep_until(at_ns - watched_ns);
    watch_until(at_ns);
    return;
  }
}

}  // namespace

// The signatures of these functions are rmw's: NOLINTBEGIN(misc-const-correctness)

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
  for (auto & delivery : deliveries)
    if (delivery.subscription == subscription) delivery.subscription = nullptr;
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

// NOLINTEND(misc-const-correctness)
