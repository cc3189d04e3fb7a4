// The gate's decision for one message: when it may leave, or why it never does. The shaping nodes
// in C++, the gate in a publisher's process and the simulator run this file;
// chainshaper/robot/decision.py is the same in Python, and explains it. It reads no clock and calls
// no operating system.
//
// All times are nanoseconds of one clock. C++17, since that is what ROS 2 builds nodes with.

#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <optional>

#include "gate/gate.hpp"
#include "gate/schedules.hpp"
#include "gate/words.hpp"

namespace chainshaper {

// The decision for one message. No `at_ns`: it never leaves, it is `dropped`. No `slot`: it leaves
// in no slot. No `overrun`: it came in time.
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

// Decides when a message may leave, at `ready_ns` at the earliest. `phase_ns` is where cycles
// started when a message came whose stamp is of no use.
inline Release release_of(const Gate & gate, std::int64_t arrival_ns, Maybe stamp_ns,
                          const Schedules & schedules, std::int64_t ready_ns,
                          std::int64_t phase_ns) {
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
    mode = schedules.in_force(origin).mode.value_or(gate.first_mode);
    first = gate.mode_slots[*mode];
    if (gate.late != Policy::next_slot) last = first + 1;
  }
  const std::int64_t ready = std::max(arrival_ns, ready_ns);
  // A stamp slightly from the future puts the arrival before its own cycle: cycle 0 still.
  std::int64_t cycle = std::max(due, (ready - origin) / cycle_ns);
  const std::int64_t due_from = origin + due * cycle_ns;
  std::int64_t moved = schedules.in_force(due_from).moved_ns;
  const Policy policy = gate.policy();
  if (policy != Policy::wait &&
      !gate.lets_out(gate.slots[last - 1], due_from + moved, arrival_ns, ready)) {
    Release late{ready, origin, std::nullopt, cycle, anchor, policy, mode, moved};
    if (policy == Policy::discard) late.drop(Dropped::discarded);
    return late;
  }
  for (;; ++cycle) {
    moved = schedules.in_force(origin + cycle * cycle_ns).moved_ns;
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

// Returns whether the slot that a message was to leave in is over.
inline bool missed(const Gate & gate, const Release & release, std::int64_t now_ns) {
  return release.slot && now_ns >= release.start_ns(gate.cycle_ns) + release.moved_ns +
                                       gate.slots[*release.slot].end;
}

}  // namespace chainshaper
