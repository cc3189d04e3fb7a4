// The gate: when may a message of the chain's output leave, and which of those that wait?
//
// The same decisions as chainshaper/gate/decision.py, which explains them: slots repeat every
// cycle from an anchor, an early message waits for its slot, one that comes behind the last slot
// it was due in is an overrun, and with modes each mode has its own slot. No ROS 2 here, no
// clocks. All times are nanoseconds.

#pragma once

#include <algorithm>
#include <cstdlib>
#include <deque>
#include <optional>
#include <stdexcept>
#include <utility>

#include "schema.hpp"

namespace chainshaper {

// A number, or none.
using Maybe = std::optional<std::int64_t>;

// A half-open interval, counted from the anchor.
struct Slot {
  std::int64_t start;
  std::int64_t end;
};

// The place of a word among those that there are; none: it is none of them.
template <typename Words>
std::optional<std::size_t> place_of(const Words & words, const std::string & word) {
  const auto found = std::find(words.begin(), words.end(), word);
  return found == words.end()
             ? std::nullopt
             : std::optional<std::size_t>(static_cast<std::size_t>(found - words.begin()));
}

// Modes are numbered in the order of `names`; `bands` has the place of each one's slot.
struct Modes {
  std::vector<std::string> names;
  std::vector<std::size_t> bands;
  std::size_t initial{0};
  Policy late{Policy::wait};
};

struct Gate {
  std::vector<Slot> slots;
  std::int64_t cycle_ns{0};
  Anchor anchor{Anchor::stamp};
  std::int64_t phase_ns{0};
  Maybe max_age_ns{};  // none: max_age_cycles and those it is due after
  std::int64_t max_future_ns{default_max_future_ns};
  Policy overrun{Policy::wait};
  std::int64_t due_cycles{0};
  std::optional<Modes> modes{};
  Messages messages{Messages::all_in_order};
  std::size_t depth{default_depth};
};

// A mode that was announced, and when.
using Change = std::pair<std::int64_t, std::size_t>;

// The decision for one message. No `at_ns`: never; no `slot`: in none; no `overrun`: in time.
struct Release {
  Maybe at_ns;
  std::int64_t origin_ns;
  std::optional<std::size_t> slot;
  std::int64_t cycles_waited;
  Anchor anchor;
  std::optional<Policy> overrun;
  std::optional<std::size_t> mode;
};

// Throws std::invalid_argument for a gate that makes no sense.
inline void check(const Gate & gate) {
  if (gate.cycle_ns <= 0 || gate.slots.empty() || gate.due_cycles < 0 || gate.depth == 0) {
    throw std::invalid_argument(
        "a gate needs a cycle, at least one slot, no negative delay, and room for a message");
  }
  std::int64_t previous_end = 0;
  for (const auto & slot : gate.slots) {
    if (slot.start < previous_end || slot.end <= slot.start || slot.end > gate.cycle_ns)
      throw std::invalid_argument("slots must ascend, not overlap and lie within the cycle");
    previous_end = slot.end;
  }
  if (!gate.modes) return;
  const auto & bands = gate.modes->bands;
  if (bands.empty() || bands.size() != gate.modes->names.size() ||
      gate.modes->initial >= bands.size() ||
      *std::max_element(bands.begin(), bands.end()) >= gate.slots.size()) {
    throw std::invalid_argument("each mode needs the number of one of the slots");
  }
}

// The gate that a node's parameters describe, with room for so many messages. Throws
// std::invalid_argument where they describe none.
inline Gate gate_of(const Parameters & parameters, std::size_t depth) {
  const auto one_of = [](const auto & words, const std::string & word) {
    if (const auto place = place_of(words, word)) return *place;
    throw std::invalid_argument("'" + word + "' is no word for a gate");
  };
  Gate gate;
  const auto & bounds = parameters.slots_ns;
  for (std::size_t i = 0; i + 1 < bounds.size(); i += 2)
    gate.slots.push_back({bounds[i], bounds[i + 1]});
  gate.cycle_ns = parameters.cycle_ns;
  gate.anchor = static_cast<Anchor>(one_of(anchor_names, parameters.anchor));
  gate.phase_ns = parameters.phase_ns;
  gate.overrun = static_cast<Policy>(one_of(policy_names, parameters.overrun));
  gate.due_cycles = parameters.due_cycles;
  gate.messages = static_cast<Messages>(one_of(messages_names, parameters.messages));
  gate.depth = depth;
  if (!parameters.mode_topic.empty()) {
    const auto & slots = parameters.mode_slots;
    gate.modes = Modes{parameters.mode_names,
                       {slots.begin(), slots.end()},
                       one_of(parameters.mode_names, parameters.mode_default),
                       static_cast<Policy>(one_of(policy_names, parameters.mode_late))};
  }
  check(gate);
  return gate;
}

// The mode of the cycle that began at `origin_ns`; none without modes.
inline std::optional<std::size_t> mode_at(const Gate & gate, std::int64_t origin_ns,
                                          const std::deque<Change> & changes) {
  if (!gate.modes) return std::nullopt;
  for (auto change = changes.rbegin(); change != changes.rend(); ++change)
    if (change->first <= origin_ns) return change->second;
  return gate.modes->initial;
}

// What becomes of a message that comes behind the last slot that is open to it.
inline Policy policy_of(const Gate & gate) {
  const bool own = gate.modes && gate.modes->late != Policy::next_slot;
  return own ? gate.modes->late : gate.overrun;
}

// The places [first, last) of the slots that are open to messages of a mode.
inline std::pair<std::size_t, std::size_t> open_to(const Gate & gate,
                                                   std::optional<std::size_t> mode) {
  if (!mode) return {0, gate.slots.size()};
  const std::size_t band = gate.modes->bands[*mode];
  return {band, gate.modes->late == Policy::next_slot ? gate.slots.size() : band + 1};
}

// As Python's: never negative.
inline std::int64_t modulo(std::int64_t value, std::int64_t cycle_ns) {
  const std::int64_t rest = value % cycle_ns;
  return rest < 0 ? rest + cycle_ns : rest;
}

inline bool usable(const Gate & gate, std::int64_t age_ns) {
  const std::int64_t max_age =
      gate.max_age_ns.value_or((max_age_cycles + gate.due_cycles) * gate.cycle_ns);
  return -gate.max_future_ns <= age_ns && age_ns <= max_age;
}

// Decide when a message that arrived at `arrival_ns`, with this stamp (both CLOCK_MONOTONIC), may
// leave. `changes` are the modes that were announced, ascending in time. It leaves at `ready_ns` at
// the earliest, where others are before it.
inline Release release_of(const Gate & gate, std::int64_t arrival_ns, Maybe stamp_ns,
                          const std::deque<Change> & changes, std::int64_t ready_ns,
                          std::int64_t phase_ns) {
  const std::int64_t cycle_ns = gate.cycle_ns;
  std::int64_t origin{};
  Anchor anchor{};
  std::int64_t due = gate.due_cycles;
  if (gate.anchor == Anchor::stamp && stamp_ns && usable(gate, arrival_ns - *stamp_ns)) {
    origin = *stamp_ns;
    anchor = Anchor::stamp;
  } else {
    origin = arrival_ns - modulo(arrival_ns - phase_ns, cycle_ns);
    anchor = Anchor::cycle;
    due = std::min<std::int64_t>(due, 1);
  }
  const auto mode = mode_at(gate, origin, changes);
  const auto [first, last] = open_to(gate, mode);
  const std::int64_t ready = std::max(arrival_ns, ready_ns);
  // A stamp slightly from the future puts the arrival before its own cycle: cycle 0 still.
  std::int64_t cycle = std::max<std::int64_t>(0, (ready - origin) / cycle_ns);
  const std::int64_t due_from = origin + due * cycle_ns;
  const bool overran = ready >= due_from + gate.slots[last - 1].end;
  const Policy policy = policy_of(gate);
  if (overran && policy != Policy::wait) {
    Maybe at_once;
    if (policy == Policy::publish) at_once = ready;
    return {at_once, origin, std::nullopt, cycle, anchor, policy, mode};
  }
  std::optional<Policy> treated;
  if (overran)
    treated = Policy::wait;
  else if (mode && ready >= due_from + gate.slots[first].end)
    treated = Policy::next_slot;
  for (cycle = std::max(due, cycle);; ++cycle) {
    const std::int64_t cycle_start = origin + cycle * cycle_ns;
    for (std::size_t slot = first; slot < last; ++slot) {
      if (ready < cycle_start + gate.slots[slot].end) {
        const std::int64_t at = std::max(ready, cycle_start + gate.slots[slot].start);
        return {at, origin, slot, cycle, anchor, treated, mode};
      }
    }
  }
}

inline Release withheld(Release release) {
  release.at_ns.reset();
  release.slot.reset();
  return release;
}

// Whether the slot that a message was to leave in is over.
inline bool missed(const Gate & gate, const Release & release, std::int64_t now_ns) {
  if (!release.slot) return false;
  return now_ns >=
         release.origin_ns + release.cycles_waited * gate.cycle_ns + gate.slots[*release.slot].end;
}

// The header stamp of a serialized message in ns of its clock; none if it is zero or short. It
// stands right behind the 4-byte CDR encapsulation header, whose second byte gives the byte order.
inline Maybe origin_of(const std::uint8_t * payload, std::size_t size) {
  if (size < 12) return std::nullopt;
  const bool little = payload[1] & 1;
  const auto word = [&](std::size_t at) {
    std::uint32_t value = 0;
    for (std::size_t i = 0; i < 4; ++i)
      value |= std::uint32_t{payload[at + i]} << (8 * (little ? i : 3 - i));
    return value;
  };
  const std::int64_t seconds = static_cast<std::int32_t>(word(4));
  const std::int64_t nanoseconds = word(8);
  if ((seconds == 0 && nanoseconds == 0) || nanoseconds >= 1'000'000'000) return std::nullopt;
  return seconds * 1'000'000'000 + nanoseconds;
}

// A message that has come and not left. `number` tells it from the others; `lost` counts those
// that were lost on the way between the one before it and this one (none: not known).
template <typename Message>
struct Waiting {
  Message message;
  std::int64_t arrival_ns;
  Maybe stamp_ns;
  std::int64_t phase_ns;
  Maybe source_timestamp;
  Maybe lost;
  std::uint64_t number;
};

// What became of a message: it may leave now, or was dropped, for that reason.
template <typename Message>
struct Outcome {
  Waiting<Message> waiting;
  Release release;
  std::int64_t awake_ns;
  std::optional<Dropped> dropped;
};

template <typename Message>
class Queue {
public:
  explicit Queue(Gate gate) : gate(std::move(gate)), phase_ns(this->gate.phase_ns) {
    check(this->gate);
  }

  // A message came; the one for which there is no room any more.
  std::optional<Outcome<Message>> arrive(Message message, std::int64_t arrival_ns, Maybe stamp_ns,
                                         Maybe source_timestamp = {}, Maybe lost = {}) {
    waiting.push_back(
        {std::move(message), arrival_ns, stamp_ns, phase_ns, source_timestamp, lost, number_++});
    if (gate.anchor == Anchor::stamp && stamp_ns && usable(gate, arrival_ns - *stamp_ns))
      phase_ns = *stamp_ns % gate.cycle_ns;
    if (waiting.size() <= gate.depth) return std::nullopt;
    Waiting<Message> oldest = std::move(waiting.front());
    waiting.pop_front();
    const Release release = withheld(release_at(oldest, arrival_ns));
    return Outcome<Message>{std::move(oldest), release, arrival_ns, Dropped::overflowed};
  }

  // When the oldest message may leave, or why it never does.
  std::pair<Release, std::optional<Dropped>> decide() {
    const auto & oldest = waiting.front();
    const std::int64_t ready_ns = std::max(oldest.arrival_ns, free_ns);
    Release release = release_at(oldest, ready_ns);
    if (!release.at_ns) return {release, Dropped::discarded};
    if (!release.slot || gate.messages == Messages::all_in_order) return {release, std::nullopt};
    if (left_ && same_cycle(start_of(release), *left_)) {
      if (gate.messages == Messages::first) return {withheld(release), Dropped::surplus};
      release = release_at(oldest, std::max(ready_ns, *left_ + gate.slots.back().end));
      if (!release.at_ns) return {release, Dropped::discarded};
      if (!release.slot) {
        release.at_ns = ready_ns;
        return {release, std::nullopt};
      }
    }
    const std::int64_t start = start_of(release);
    if (!leaving_ || !same_cycle(start, *leaving_)) leaving_ = start;
    return {release, std::nullopt};
  }

  // Whether a newer message leaves for the oldest one, which was to leave like this.
  bool replaced(const Release & release, std::int64_t now_ns) const {
    if (gate.messages != Messages::newest || !release.slot || !leaving_) return false;
    return std::any_of(waiting.begin() + 1, waiting.end(), [&](const Waiting<Message> & newer) {
      const Release other = release_at(newer, now_ns);
      return other.slot && same_cycle(start_of(other), *leaving_);
    });
  }

  // The oldest message leaves, or is dropped; no release: it is not this gate's to decide.
  Waiting<Message> leave(const std::optional<Release> & release, std::int64_t now_ns) {
    free_ns = now_ns;
    if (release && release->slot) left_ = leaving_;
    Waiting<Message> oldest = std::move(waiting.front());
    waiting.pop_front();
    return oldest;
  }

  const Gate gate;
  std::int64_t phase_ns;
  std::deque<Waiting<Message>> waiting;
  std::deque<Change> changes;
  std::int64_t free_ns{0};  // when it is the turn of the oldest message, if it is there then

private:
  Release release_at(const Waiting<Message> & one, std::int64_t ready_ns) const {
    return release_of(gate, one.arrival_ns, one.stamp_ns, changes, ready_ns, one.phase_ns);
  }

  std::int64_t start_of(const Release & release) const {
    return release.origin_ns + release.cycles_waited * gate.cycle_ns;
  }

  // Stamps are not quite periodic: cycles are the same less than half a cycle apart.
  bool same_cycle(std::int64_t start_ns, std::int64_t other_ns) const {
    return 2 * std::abs(start_ns - other_ns) < gate.cycle_ns;
  }

  // The starts of the cycle that the oldest message, or another for it, leaves in, and of that in
  // which one has left.
  Maybe leaving_;
  Maybe left_;
  std::uint64_t number_{0};
};

}  // namespace chainshaper
