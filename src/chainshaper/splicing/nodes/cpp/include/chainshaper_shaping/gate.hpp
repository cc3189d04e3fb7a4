// The gate: when may a message of the chain's output leave?
//
// The same decisions as chainshaper/gate/decision.py, which explains them: slots repeat every
// cycle from an anchor, an early message waits for its slot, one that comes behind the last slot
// it was due in is an overrun, and with modes each mode has its own slot. No ROS 2 here, no
// clocks, no allocation per message. All times are nanoseconds.

#ifndef CHAINSHAPER_SHAPING__GATE_HPP_
#define CHAINSHAPER_SHAPING__GATE_HPP_

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace chainshaper
{

enum class Anchor {stamp, cycle};
enum class Policy {wait, discard, publish, next_slot};
enum class Messages {all_in_order, newest, first};
enum class Dropped {replaced, surplus, overflowed, discarded};

inline constexpr std::array<const char *, 2> anchor_names{"stamp", "cycle"};
inline constexpr std::array<const char *, 4> policy_names{"wait", "discard", "publish", "next-slot"};
inline constexpr std::array<const char *, 3> messages_names{"all-in-order", "newest", "first"};
inline constexpr std::array<const char *, 4> dropped_names{
  "replaced", "surplus", "overflowed", "discarded"};

// A half-open interval, counted from the anchor.
struct Slot
{
  std::int64_t start;
  std::int64_t end;
};

// Modes are numbered in the order of `names`; `bands` has the place of each one's slot.
struct Modes
{
  std::vector<std::string> names;
  std::vector<std::size_t> bands;
  std::size_t initial{0};
  Policy late{Policy::wait};

  std::optional<std::size_t> find(const std::string & name) const
  {
    const auto found = std::find(names.begin(), names.end(), name);
    if (found == names.end()) {
      return std::nullopt;
    }
    return static_cast<std::size_t>(found - names.begin());
  }
};

struct Gate
{
  std::vector<Slot> slots;
  std::int64_t cycle_ns{0};
  Anchor anchor{Anchor::stamp};
  std::int64_t phase_ns{0};
  std::optional<std::int64_t> max_age_ns{};  // none: ten cycles and those it is due after
  std::int64_t max_future_ns{1'000'000};
  Policy overrun{Policy::wait};
  std::int64_t due_cycles{0};
  std::optional<Modes> modes{};
  Messages messages{Messages::all_in_order};
  std::size_t depth{10};
};

// A mode that was announced, and when.
using Change = std::pair<std::int64_t, std::size_t>;

// The decision for one message. No `at_ns`: never; no `slot`: in none; no `overrun`: in time.
struct Release
{
  std::optional<std::int64_t> at_ns;
  std::int64_t origin_ns;
  std::optional<std::size_t> slot;
  std::int64_t cycles_waited;
  Anchor anchor;
  std::optional<Policy> overrun;
  std::optional<std::size_t> mode;
};

// Throws std::invalid_argument for a gate that makes no sense.
inline void check(const Gate & gate)
{
  if (gate.cycle_ns <= 0 || gate.slots.empty() || gate.due_cycles < 0 || gate.depth == 0) {
    throw std::invalid_argument(
      "a gate needs a cycle, at least one slot, no negative delay, and room for a message");
  }
  std::int64_t previous_end = 0;
  for (const auto & slot : gate.slots) {
    if (slot.start < previous_end || slot.end <= slot.start || slot.end > gate.cycle_ns) {
      throw std::invalid_argument("slots must ascend, not overlap and lie within the cycle");
    }
    previous_end = slot.end;
  }
  if (!gate.modes) {
    return;
  }
  const auto & bands = gate.modes->bands;
  if (bands.empty() || bands.size() != gate.modes->names.size() ||
    gate.modes->initial >= bands.size() ||
    *std::max_element(bands.begin(), bands.end()) >= gate.slots.size())
  {
    throw std::invalid_argument("each mode needs the number of one of the slots");
  }
}

// The mode of the cycle that began at `origin_ns`; none without modes.
inline std::optional<std::size_t> mode_at(
  const Gate & gate, std::int64_t origin_ns, const std::deque<Change> & changes)
{
  if (!gate.modes) {
    return std::nullopt;
  }
  for (auto change = changes.rbegin(); change != changes.rend(); ++change) {
    if (change->first <= origin_ns) {
      return change->second;
    }
  }
  return gate.modes->initial;
}

// What becomes of a message that comes behind the last slot that is open to it.
inline Policy policy_of(const Gate & gate)
{
  const bool own = gate.modes && gate.modes->late != Policy::next_slot;
  return own ? gate.modes->late : gate.overrun;
}

// The places [first, last) of the slots that are open to messages of a mode.
inline std::pair<std::size_t, std::size_t> open_to(
  const Gate & gate, std::optional<std::size_t> mode)
{
  if (!mode) {
    return {0, gate.slots.size()};
  }
  const std::size_t band = gate.modes->bands[*mode];
  return {band, gate.modes->late == Policy::next_slot ? gate.slots.size() : band + 1};
}

inline bool usable(const Gate & gate, std::int64_t age_ns)
{
  const std::int64_t max_age = gate.max_age_ns.value_or((10 + gate.due_cycles) * gate.cycle_ns);
  return -gate.max_future_ns <= age_ns && age_ns <= max_age;
}

// Decide when a message that arrived at `arrival_ns`, with this stamp (both CLOCK_MONOTONIC), may
// leave. `changes` are the modes that were announced, ascending in time. It leaves at `ready_ns` at
// the earliest, where others are before it.
inline Release release_of(
  const Gate & gate, std::int64_t arrival_ns, std::optional<std::int64_t> stamp_ns,
  const std::deque<Change> & changes, std::int64_t ready_ns, std::int64_t phase_ns)
{
  const std::int64_t cycle_ns = gate.cycle_ns;
  std::int64_t origin{};
  Anchor anchor{};
  std::int64_t due = gate.due_cycles;
  if (gate.anchor == Anchor::stamp && stamp_ns && usable(gate, arrival_ns - *stamp_ns)) {
    origin = *stamp_ns;
    anchor = Anchor::stamp;
  } else {
    const std::int64_t rest = (arrival_ns - phase_ns) % cycle_ns;
    origin = arrival_ns - (rest < 0 ? rest + cycle_ns : rest);
    anchor = Anchor::cycle;
    due = std::min<std::int64_t>(due, 1);
  }
  const auto mode = mode_at(gate, origin, changes);
  const auto [first, last] = open_to(gate, mode);
  const std::int64_t ready = std::max(arrival_ns, ready_ns);
  // A stamp slightly from the future puts the arrival before its own cycle: cycle 0 still.
  std::int64_t cycle = ready < origin ? 0 : (ready - origin) / cycle_ns;
  const std::int64_t due_from = origin + due * cycle_ns;
  const bool overran = ready >= due_from + gate.slots[last - 1].end;
  const Policy policy = policy_of(gate);
  if (overran && policy != Policy::wait) {
    std::optional<std::int64_t> at_once;
    if (policy == Policy::publish) {
      at_once = ready;
    }
    return {at_once, origin, std::nullopt, cycle, anchor, policy, mode};
  }
  std::optional<Policy> treated;
  if (overran) {
    treated = Policy::wait;
  } else if (mode && ready >= due_from + gate.slots[first].end) {
    treated = Policy::next_slot;
  }
  for (cycle = std::max(due, cycle); ; ++cycle) {
    const std::int64_t cycle_start = origin + cycle * cycle_ns;
    for (std::size_t slot = first; slot < last; ++slot) {
      if (ready < cycle_start + gate.slots[slot].end) {
        const std::int64_t at = std::max(ready, cycle_start + gate.slots[slot].start);
        return {at, origin, slot, cycle, anchor, treated, mode};
      }
    }
  }
}

inline Release withheld(Release release)
{
  release.at_ns.reset();
  release.slot.reset();
  return release;
}

// Whether the slot that a message was to leave in is over.
inline bool missed(const Gate & gate, const Release & release, std::int64_t now_ns)
{
  if (!release.slot) {
    return false;
  }
  return now_ns >=
         release.origin_ns + release.cycles_waited * gate.cycle_ns + gate.slots[*release.slot].end;
}

// The header stamp of a serialized message in ns of its clock; none if it is zero or short. It
// stands right behind the 4-byte CDR encapsulation header, whose second byte gives the byte order.
inline std::optional<std::int64_t> origin_of(const std::uint8_t * payload, std::size_t size)
{
  if (size < 12) {
    return std::nullopt;
  }
  const bool little = payload[1] & 1;
  const auto word = [&](std::size_t at) {
      std::uint32_t value = 0;
      for (std::size_t i = 0; i < 4; ++i) {
        value |= std::uint32_t{payload[at + i]} << (8 * (little ? i : 3 - i));
      }
      return value;
    };
  const std::int64_t seconds = static_cast<std::int32_t>(word(4));
  const std::int64_t nanoseconds = word(8);
  if ((seconds == 0 && nanoseconds == 0) || nanoseconds >= 1'000'000'000) {
    return std::nullopt;
  }
  return seconds * 1'000'000'000 + nanoseconds;
}

}  // namespace chainshaper

#endif  // CHAINSHAPER_SHAPING__GATE_HPP_
