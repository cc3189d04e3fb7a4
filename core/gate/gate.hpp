// The gate: the publish slots of a chain's output, and what happens to messages that miss them.
// chainshaper/robot/gate.py is the same in Python, and explains it.
//
// All times are nanoseconds of one clock. C++17, since that is what ROS 2 builds nodes with.

#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "gate/words.hpp"

namespace chainshaper {

using Maybe = std::optional<std::int64_t>;

// A half-open interval, counted from the anchor.
struct Slot {
  std::int64_t start;
  std::int64_t end;
};

// Returns the place of a word in a list; none: it is not there.
template <typename Words, typename Word>
std::optional<std::size_t> place_of(const Words & words, const Word & word) {
  const auto found = std::find(words.begin(), words.end(), word);
  if (found == words.end()) return std::nullopt;
  return static_cast<std::size_t>(found - words.begin());
}

// The publish slots of one output. Its numbers and words are declared in chainshaper/robot/gate.py.
struct Gate : GateValues {
  std::vector<Slot> slots;
  std::vector<std::string> modes;       // their names; modes are numbered in this order
  std::vector<std::size_t> mode_slots;  // the place of each mode's slot
  std::size_t first_mode{0};            // in force until a mode is announced
  Policy late{Policy::wait};            // for messages behind their mode's slot
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
               gate.mode_slots.size() == gate.modes.size();
  // Sums of a time and some cycles must not overflow.
  constexpr auto longest_ns = std::numeric_limits<std::int64_t>::max() / 4;
  sound = sound && gate.due_cycles <= longest_ns / gate.cycle_ns - schema::max_age_cycles - 1;
  sound = sound && (gate.modes.empty() || gate.first_mode < gate.modes.size());
  std::int64_t previous_end = 0;
  for (const auto & [start, end] : slots) {
    sound = sound && previous_end <= start && start < end && end <= gate.cycle_ns;
    previous_end = end;
  }
  for (const auto place : gate.mode_slots) sound = sound && place < slots.size();
  if (!sound) {
    throw std::invalid_argument(
        "a gate needs a cycle, slots in it that ascend and do not overlap, one of them for each "
        "mode, no negative delay, and room for a message");
  }
}

inline std::int64_t modulo(std::int64_t value, std::int64_t cycle_ns) {
  const std::int64_t rest = value % cycle_ns;
  return rest < 0 ? rest + cycle_ns : rest;
}

}  // namespace chainshaper
