// The messages that wait at a gate, and which of them leave. It reads no clock. `Queue` in
// chainshaper/robot/waiting.py is the same in Python.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <deque>
#include <optional>
#include <utility>

#include "gate/decision.hpp"
#include "gate/schedules.hpp"

namespace chainshaper {

// The times of a message that a decision depends on.
struct Arrival {
  std::int64_t arrival_ns;
  Maybe stamp_ns;         // its origin; none: it has none that is of use
  std::int64_t phase_ns;  // where cycles began when it came
};

// A gate's decisions for one message after the other, and what it remembers between two of them.
// `Queue` has the messages as well; in a simulation they stay in the history of their reader.
class Decisions {
public:
  explicit Decisions(Gate served) : gate(std::move(served)), schedules(gate) { check(gate); }

  // Decides when a message would leave, without regard to those before it.
  Release release_at(const Arrival & message, std::int64_t ready_ns) const {
    return release_of(gate, message.arrival_ns, message.stamp_ns, schedules, ready_ns,
                      message.phase_ns);
  }

  // Decides when the oldest message may leave, or why it never does.
  Release decide(const Arrival & oldest) {
    const std::int64_t ready_ns = std::max(oldest.arrival_ns, free_ns);
    Release release = release_at(oldest, ready_ns);
    if (!release.slot || gate.messages == Messages::all_in_order) return release;
    if (same_cycle(release, left_)) {
      const std::int64_t moved_ns = schedules.in_force(*left_).moved_ns;
      const std::int64_t last_end = *left_ + moved_ns + gate.slots.back().end;
      release = release_at(oldest, std::max(ready_ns, last_end));
      if (release.at_ns && !release.slot) release.at_ns = ready_ns;
      if (!release.slot) return release;
    }
    if (!same_cycle(release, leaving_)) leaving_ = release.start_ns(gate.cycle_ns);
    return release;
  }

  // Returns whether a newer message leaves in place of the oldest, which was to leave so.
  bool is_replaced(const Release & release, const Arrival & newer, std::int64_t now_ns) const {
    if (gate.messages != Messages::newest || !release.slot) return false;
    const Release instead = release_at(newer, now_ns);
    return instead.slot && same_cycle(instead, leaving_);
  }

  // Notes that the oldest message leaves or is dropped, as decided.
  void left(const Release & release) {
    if (release.slot) left_ = leaving_;
  }

  // Starts cycles at another phase, from the first such start at `from_ns` or later on.
  void set_phase(std::int64_t phase_ns, std::int64_t from_ns) {
    const auto phase = modulo(phase_ns, gate.cycle_ns);
    const auto start_ns = from_ns + modulo(phase - from_ns, gate.cycle_ns);
    schedules.change(start_ns, &Schedule::phase_ns, phase);
  }

  // Moves the slots of cycles that start at `from_ns` or later from where the gate has them.
  // Nothing changes where they would leave the cycle.
  void move_slots(std::int64_t by_ns, std::int64_t from_ns) {
    if (gate.may_move(by_ns)) schedules.change(from_ns, &Schedule::moved_ns, by_ns);
  }

  // Puts a mode in force in cycles that start at `from_ns` or later.
  void switch_mode(std::size_t mode, std::int64_t from_ns) {
    schedules.change(from_ns, &Schedule::mode, std::optional<std::size_t>(mode));
  }

  // Notes where cycles start, if the stamp of a message shows it. Returns where they do at its
  // arrival.
  std::int64_t see_phase(std::int64_t arrival_ns, Maybe stamp_ns) {
    if (gate.counts_from(stamp_ns, arrival_ns))
      schedules.see_phase(modulo(*stamp_ns, gate.cycle_ns), arrival_ns);
    return schedules.in_force(arrival_ns).phase_ns;
  }

  const Gate gate;
  Schedules schedules;      // what holds from which cycle on
  std::int64_t free_ns{0};  // when the thread was done with the message before

private:
  // Returns whether a message leaves in the cycle that starts at this time. Stamps are not quite
  // periodic: starts less than half a cycle apart are of one cycle.
  bool same_cycle(const Release & release, Maybe start_ns) const {
    return start_ns && 2 * std::abs(release.start_ns(gate.cycle_ns) - *start_ns) < gate.cycle_ns;
  }

  // The start of the cycle that the oldest message leaves in, or a newer one in its place.
  Maybe leaving_;
  // The start of the cycle in which the last message left.
  Maybe left_;
};

// A message that waits at a gate; `number` tells it from the others.
template <typename Message>
struct Waiting : Arrival {
  Message message;
  Maybe source_timestamp;
  Maybe lost;
  std::uint64_t number;
};

template <typename Message>
struct Outcome {
  Waiting<Message> waiting;
  Release release;
  std::int64_t awake_ns;
};

// The messages that wait at a gate, and its decisions about them.
template <typename Message>
class Queue : public Decisions {
public:
  explicit Queue(Gate served) : Decisions(std::move(served)) {}

  // Uses no stamps until all messages under way have come: the wall clock was stepped.
  void doubt_stamps(std::int64_t now_ns) {
    unsure_until_ns_ = now_ns + (gate.due_cycles + 1) * gate.cycle_ns;
  }

  // Queues a message; returns the one that overflowed, if any.
  std::optional<Outcome<Message>> arrive(Message message, std::int64_t arrival_ns, Maybe stamp_ns,
                                         Maybe source_timestamp = {}, Maybe lost = {}) {
    if (arrival_ns < unsure_until_ns_) stamp_ns.reset();
    const std::int64_t phase_ns = see_phase(arrival_ns, stamp_ns);
    waiting.push_back(
        {{arrival_ns, stamp_ns, phase_ns}, std::move(message), source_timestamp, lost, number_++});
    if (waiting.size() <= gate.depth) return std::nullopt;
    Release release = release_at(waiting.front(), arrival_ns);
    release.drop(Dropped::overflowed);
    return Outcome<Message>{take_oldest(), release, arrival_ns};
  }

  Release decide() { return Decisions::decide(waiting.front()); }

  bool replaced(const Release & release, std::int64_t now_ns) const {
    return std::any_of(waiting.begin() + 1, waiting.end(),
                       [&](const Arrival & newer) { return is_replaced(release, newer, now_ns); });
  }

  // Takes the oldest message out, as decided; no release: another process decided.
  Waiting<Message> leave(const std::optional<Release> & release, std::int64_t now_ns) {
    free_ns = now_ns;
    if (release) left(*release);
    return take_oldest();
  }

  std::deque<Waiting<Message>> waiting;

private:
  Waiting<Message> take_oldest() {
    Waiting<Message> oldest = std::move(waiting.front());
    waiting.pop_front();
    return oldest;
  }

  std::int64_t unsure_until_ns_{0};
  std::uint64_t number_{0};
};

}  // namespace chainshaper
