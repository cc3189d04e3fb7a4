// The gate: when may a message of the chain's output leave? The same as
// chainshaper/robot/decision.py, which explains it. Nodes of ROS 2, the gate in a publisher's
// process and the simulator decide by this file. It knows no clock and asks the operating system
// for nothing.
//
// All times are nanoseconds of one clock. C++17, since that is what ROS 2 builds nodes with.

#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <deque>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "gate/words.hpp"

namespace chainshaper {

using Maybe = std::optional<std::int64_t>;

// A half-open interval, counted from the anchor.
struct Slot {
  std::int64_t start;
  std::int64_t end;
};

// The place of a word in a list; none where it is not there.
template <typename Words, typename Word>
std::optional<std::size_t> place_of(const Words & words, const Word & word) {
  const auto found = std::find(words.begin(), words.end(), word);
  if (found == words.end()) return std::nullopt;
  return static_cast<std::size_t>(found - words.begin());
}

// The publish slots of one output. Its numbers and words are declared in chainshaper/robot/gate.py.
struct Gate : GateValues {
  std::vector<Slot> slots;
  std::vector<std::string> modes;  // their names; modes are numbered in this order
  std::vector<std::size_t> bands;  // the place of each mode's slot
  std::size_t first_mode{0};       // in force until a mode is announced
  Policy late{Policy::wait};       // for messages behind their mode's slot
  std::size_t depth{schema::depth};

  bool may_move(std::int64_t by_ns) const {
    if (by_ns < -cycle_ns || by_ns > cycle_ns) return false;  // also what a sum could not hold
    return slots.front().start + by_ns >= 0 && slots.back().end + by_ns <= cycle_ns;
  }

  Policy policy() const { return modes.empty() || late == Policy::next_slot ? overrun : late; }

  bool lets_out(const Slot & slot, std::int64_t cycle_start_ns, std::int64_t arrival_ns,
                std::int64_t ready_ns) const {
    const bool in_time =
        into_open_slot == Entry::at_once || arrival_ns <= cycle_start_ns + slot.start;
    return in_time && ready_ns < cycle_start_ns + slot.end;
  }

  bool counts_from(Maybe stamp_ns, std::int64_t arrival_ns) const {
    if (!stamp_ns || anchor != Anchor::stamp) return false;
    const auto age_ns = arrival_ns - *stamp_ns;
    const auto oldest_ns = (schema::max_age_cycles + due_cycles) * cycle_ns;
    return -schema::max_future_ns <= age_ns && age_ns <= oldest_ns;
  }
};

// Throws std::invalid_argument for a gate that makes no sense.
inline void check(const Gate & gate) {
  const auto & slots = gate.slots;
  bool sound = gate.cycle_ns > 0 && !slots.empty() && gate.due_cycles >= 0 && gate.depth > 0 &&
               gate.bands.size() == gate.modes.size();
  // Sums of a time and some cycles must not overflow.
  constexpr auto longest_ns = std::numeric_limits<std::int64_t>::max() / 4;
  sound = sound && gate.due_cycles <= longest_ns / gate.cycle_ns - schema::max_age_cycles - 1;
  sound = sound && (gate.modes.empty() || gate.first_mode < gate.modes.size());
  std::int64_t previous_end = 0;
  for (const auto & [start, end] : slots) {
    sound = sound && previous_end <= start && start < end && end <= gate.cycle_ns;
    previous_end = end;
  }
  for (const auto band : gate.bands) sound = sound && band < slots.size();
  if (!sound) {
    throw std::invalid_argument(
        "a gate needs a cycle, slots in it that ascend and do not overlap, one of them for each "
        "mode, no negative delay, and room for a message");
  }
}

// From when on which mode is in force.
using Change = std::pair<std::int64_t, std::size_t>;

// From when on slots are moved, and by how much from where the gate has them.
using Move = std::pair<std::int64_t, std::int64_t>;

// Adds a change or a move behind those before it, of which only the last ones are of use.
template <typename Known>
void remember(std::deque<Known> & known, Known newest) {
  known.push_back(newest);
  if (known.size() > static_cast<std::size_t>(schema::changes)) known.pop_front();
}

inline std::int64_t moved_at(const std::deque<Move> & moves, std::int64_t cycle_start_ns) {
  const auto before = [&](const Move & move) { return move.first <= cycle_start_ns; };
  const auto found = std::find_if(moves.rbegin(), moves.rend(), before);
  return found == moves.rend() ? 0 : found->second;
}

// The decision for one message. No `at_ns`: never, it is `dropped`; no `slot`: in none; no
// `overrun`: in time.
struct Release {
  Maybe at_ns;
  std::int64_t origin_ns;
  std::optional<std::size_t> slot;
  std::int64_t cycles_waited;
  Anchor anchor;
  std::optional<Policy> overrun;
  std::optional<std::size_t> mode;
  std::int64_t moved_ns{0};          // the slots of the cycle in which it leaves
  std::optional<Dropped> dropped{};  // NOLINT(readability-redundant-member-init): of an aggregate

  std::int64_t start_ns(std::int64_t cycle_ns) const {
    return origin_ns + cycles_waited * cycle_ns;
  }

  void drop(Dropped reason) {
    at_ns.reset();
    slot.reset();
    dropped = reason;
  }
};

inline std::int64_t modulo(std::int64_t value, std::int64_t cycle_ns) {
  const std::int64_t rest = value % cycle_ns;
  return rest < 0 ? rest + cycle_ns : rest;
}

// Decides when a message may leave, at `ready_ns` at the earliest. `phase_ns` is where cycles begin
// for a message whose stamp is of no use.
inline Release release_of(const Gate & gate, std::int64_t arrival_ns, Maybe stamp_ns,
                          const std::deque<Change> & changes, std::int64_t ready_ns,
                          std::int64_t phase_ns, const std::deque<Move> & moves = {}) {
  const std::int64_t cycle_ns = gate.cycle_ns;
  std::int64_t origin = arrival_ns - modulo(arrival_ns - phase_ns, cycle_ns);
  std::int64_t due = std::min<std::int64_t>(gate.due_cycles, 1);
  Anchor anchor = Anchor::cycle;
  if (gate.counts_from(stamp_ns, arrival_ns)) {
    origin = *stamp_ns;
    due = gate.due_cycles;
    anchor = Anchor::stamp;
  }
  std::optional<std::size_t> mode;
  std::size_t first = 0;
  std::size_t last = gate.slots.size();
  if (!gate.modes.empty()) {
    const auto before = [origin](const Change & change) { return change.first <= origin; };
    const auto announced = std::find_if(changes.rbegin(), changes.rend(), before);
    mode = announced == changes.rend() ? gate.first_mode : announced->second;
    first = gate.bands[*mode];
    if (gate.late != Policy::next_slot) last = first + 1;
  }
  const std::int64_t ready = std::max(arrival_ns, ready_ns);
  // A stamp slightly from the future puts the arrival before its own cycle: cycle 0 still.
  std::int64_t cycle = std::max(due, (ready - origin) / cycle_ns);
  const std::int64_t due_from = origin + due * cycle_ns;
  std::int64_t moved = moved_at(moves, due_from);
  const Policy policy = gate.policy();
  if (policy != Policy::wait &&
      !gate.lets_out(gate.slots[last - 1], due_from + moved, arrival_ns, ready)) {
    Release late{ready, origin, std::nullopt, cycle, anchor, policy, mode, moved};
    if (policy == Policy::discard) late.drop(Dropped::discarded);
    return late;
  }
  for (;; ++cycle) {
    moved = moved_at(moves, origin + cycle * cycle_ns);
    const std::int64_t cycle_start = origin + cycle * cycle_ns + moved;
    for (std::size_t slot = first; slot < last; ++slot) {
      if (!gate.lets_out(gate.slots[slot], cycle_start, arrival_ns, ready)) continue;
      std::optional<Policy> treated;
      if (mode && slot > first) treated = Policy::next_slot;
      if (cycle > due) treated = Policy::wait;
      const std::int64_t at = std::max(ready, cycle_start + gate.slots[slot].start);
      return {at, origin, slot, cycle, anchor, treated, mode, moved};
    }
  }
}

// Whether the slot that a message was to leave in is over.
inline bool missed(const Gate & gate, const Release & release, std::int64_t now_ns) {
  return release.slot && now_ns >= release.start_ns(gate.cycle_ns) + release.moved_ns +
                                       gate.slots[*release.slot].end;
}

}  // namespace chainshaper
