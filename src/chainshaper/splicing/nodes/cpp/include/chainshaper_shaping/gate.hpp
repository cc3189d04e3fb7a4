// The gate: when may a message of the chain's output leave, and which of those that wait? The same
// as chainshaper/gate/decision.py, which explains it. No ROS 2 here. All times are nanoseconds.

#pragma once

#include <errno.h>
#include <fcntl.h>
#include <sched.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <deque>
#include <functional>
#include <limits>
#include <optional>
#include <stdexcept>
#include <utility>

#include "guest.hpp"
#include "schema.hpp"

namespace chainshaper {

using Maybe = std::optional<std::int64_t>;

// A half-open interval, counted from the anchor.
struct Slot {
  std::int64_t start;
  std::int64_t end;
};

template <typename Words, typename Word>
std::optional<std::size_t> place_of(const Words & words, const Word & word) {
  const auto found = std::find(words.begin(), words.end(), word);
  if (found == words.end()) return std::nullopt;
  return static_cast<std::size_t>(found - words.begin());
}

// Modes are numbered in their order; `bands` has the place of each one's slot.
struct Gate {
  std::vector<Slot> slots;
  std::int64_t cycle_ns{0};
  Anchor anchor{Anchor::stamp};
  std::int64_t phase_ns{0};
  Policy overrun{Policy::wait};
  std::int64_t due_cycles{0};
  std::vector<std::string> modes;
  std::vector<std::size_t> bands;
  std::size_t first_mode{0};
  Policy late{Policy::wait};
  Messages messages{Messages::all_in_order};
  std::size_t depth{schema::depth};
  Entry into_open_slot{Entry::at_once};

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

using Change = std::pair<std::int64_t, std::size_t>;

// From when on slots are moved, and by how much from where the gate has them.
using Move = std::pair<std::int64_t, std::int64_t>;

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
  std::int64_t moved_ns{0};  // the slots of the cycle in which it leaves
  std::optional<Dropped> dropped{};

  std::int64_t start_ns(std::int64_t cycle_ns) const {
    return origin_ns + cycles_waited * cycle_ns;
  }

  void drop(Dropped reason) {
    at_ns.reset();
    slot.reset();
    dropped = reason;
  }
};

inline void check(const Gate & gate) {
  const auto & slots = gate.slots;
  bool sound = gate.cycle_ns > 0 && !slots.empty() && gate.due_cycles >= 0 && gate.depth > 0 &&
               gate.bands.size() == gate.modes.size();
  std::int64_t previous_end = 0;
  for (const auto & [start, end] : slots) {
    sound = sound && previous_end <= start && start < end && end <= gate.cycle_ns;
    previous_end = end;
  }
  for (const auto band : gate.bands) sound = sound && band < slots.size();
  if (!sound)
    throw std::invalid_argument(
        "a gate needs a cycle, slots in it that ascend and do not overlap, one of them for each "
        "mode, no negative delay, and room for a message");
}

// The gate that a node's parameters describe, with room for so many messages. Throws
// std::invalid_argument for a word that there is not.
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
  gate.into_open_slot = static_cast<Entry>(one_of(entry_names, parameters.into_open_slot));
  if (!parameters.mode_topic.empty()) {
    gate.modes = parameters.mode_names;
    gate.bands.assign(parameters.mode_slots.begin(), parameters.mode_slots.end());
    gate.first_mode = one_of(gate.modes, parameters.mode_default);
    gate.late = static_cast<Policy>(one_of(policy_names, parameters.mode_late));
  }
  return gate;
}

// How many messages may wait: by default as many as in the publisher's history.
inline std::size_t depth_of(const Parameters & parameters, std::size_t history) {
  if (parameters.depth > 0) return static_cast<std::size_t>(parameters.depth);
  return std::max<std::size_t>(schema::depth, history);
}

inline std::int64_t modulo(std::int64_t value, std::int64_t cycle_ns) {
  const std::int64_t rest = value % cycle_ns;
  return rest < 0 ? rest + cycle_ns : rest;
}

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

inline bool missed(const Gate & gate, const Release & release, std::int64_t now_ns) {
  return release.slot && now_ns >= release.start_ns(gate.cycle_ns) + release.moved_ns +
                                       gate.slots[*release.slot].end;
}

// Four bytes of a serialized message, in the byte order that its encapsulation header names.
inline std::uint32_t word_at(const std::uint8_t * payload, std::size_t at) {
  const bool little = payload[1] & 1;
  std::uint32_t value = 0;
  for (std::size_t i = 0; i < 4; ++i)
    value |= std::uint32_t{payload[at + i]} << (8 * (little ? i : 3 - i));
  return value;
}

inline Maybe origin_of(const std::uint8_t * payload, std::size_t size) {
  if (size < 12) return std::nullopt;
  const std::int64_t seconds = static_cast<std::int32_t>(word_at(payload, 4));
  const std::int64_t nanoseconds = word_at(payload, 8);
  if ((seconds == 0 && nanoseconds == 0) || nanoseconds >= 1'000'000'000) return std::nullopt;
  return seconds * 1'000'000'000 + nanoseconds;
}

inline std::optional<std::string> text_of(const std::uint8_t * payload, std::size_t size) {
  if (size < 8) return std::nullopt;
  const std::size_t length = word_at(payload, 4);  // with the final NUL
  if (length < 1 || length > size - 8) return std::nullopt;
  return std::string(reinterpret_cast<const char *>(payload + 8), length - 1);
}

// A message that has come and not left; `number` tells it from the others.
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

template <typename Message>
struct Outcome {
  Waiting<Message> waiting;
  Release release;
  std::int64_t awake_ns;
};

template <typename Message>
class Queue {
public:
  explicit Queue(Gate gate) : gate(std::move(gate)), phase_ns(this->gate.phase_ns) {
    check(this->gate);
  }

  void doubt_stamps(std::int64_t now_ns) {
    unsure_until_ns_ = now_ns + (gate.due_cycles + 1) * gate.cycle_ns;
  }

  std::optional<Outcome<Message>> arrive(Message message, std::int64_t arrival_ns, Maybe stamp_ns,
                                         Maybe source_timestamp = {}, Maybe lost = {}) {
    if (arrival_ns < unsure_until_ns_) stamp_ns.reset();
    waiting.push_back(
        {std::move(message), arrival_ns, stamp_ns, phase_ns, source_timestamp, lost, number_++});
    if (gate.counts_from(stamp_ns, arrival_ns)) phase_ns = *stamp_ns % gate.cycle_ns;
    if (waiting.size() <= gate.depth) return std::nullopt;
    Release release = release_at(waiting.front(), arrival_ns);
    release.drop(Dropped::overflowed);
    return Outcome<Message>{take_oldest(), release, arrival_ns};
  }

  Release decide() {
    const auto & oldest = waiting.front();
    const std::int64_t ready_ns = std::max(oldest.arrival_ns, free_ns);
    Release release = release_at(oldest, ready_ns);
    if (!release.slot || gate.messages == Messages::all_in_order) return release;
    if (same_cycle(release, left_)) {
      if (gate.messages == Messages::first) {
        release.drop(Dropped::surplus);
        return release;
      }
      const std::int64_t last_end = *left_ + moved_at(moves, *left_) + gate.slots.back().end;
      release = release_at(oldest, std::max(ready_ns, last_end));
      if (release.at_ns && !release.slot) release.at_ns = ready_ns;
      if (!release.slot) return release;
    }
    if (!same_cycle(release, leaving_)) leaving_ = release.start_ns(gate.cycle_ns);
    return release;
  }

  bool replaced(const Release & release, std::int64_t now_ns) const {
    if (gate.messages != Messages::newest || !release.slot) return false;
    return std::any_of(waiting.begin() + 1, waiting.end(), [&](const Waiting<Message> & newer) {
      const Release other = release_at(newer, now_ns);
      return other.slot && same_cycle(other, leaving_);
    });
  }

  // The oldest message leaves, or is dropped; no release: it is not this gate's to decide.
  Waiting<Message> leave(const std::optional<Release> & release, std::int64_t now_ns) {
    free_ns = now_ns;
    if (release && release->slot) left_ = leaving_;
    return take_oldest();
  }

  const Gate gate;
  std::int64_t phase_ns;
  std::deque<Waiting<Message>> waiting;
  std::deque<Change> changes;
  std::deque<Move> moves;
  std::int64_t free_ns{0};  // when it is the turn of the oldest message, if it is there then

private:
  Waiting<Message> take_oldest() {
    Waiting<Message> oldest = std::move(waiting.front());
    waiting.pop_front();
    return oldest;
  }

  Release release_at(const Waiting<Message> & one, std::int64_t ready_ns) const {
    return release_of(gate, one.arrival_ns, one.stamp_ns, changes, ready_ns, one.phase_ns, moves);
  }

  bool same_cycle(const Release & release, Maybe start_ns) const {
    return start_ns && 2 * std::abs(release.start_ns(gate.cycle_ns) - *start_ns) < gate.cycle_ns;
  }

  Maybe leaving_;
  Maybe left_;
  std::int64_t unsure_until_ns_{0};
  std::uint64_t number_{0};
};

// The throttler's rule `first`: the same as chainshaper/gate/decision.py, which explains it.
struct FirstOfPeriod {
  std::int64_t period_ns;
  std::int64_t early_ns{period_ns / schema::early_divisor};
  std::int64_t due_ns{-2 * period_ns};
  std::int64_t passed_ns{due_ns};

  bool passes(std::int64_t now_ns) {
    if (now_ns < std::max(due_ns, passed_ns + period_ns) - early_ns) return false;
    const bool none_came = now_ns >= due_ns + period_ns - early_ns;
    due_ns = (none_came ? now_ns : due_ns) + period_ns;
    passed_ns = now_ns;
    return true;
  }
};

inline std::int64_t clock_ns(clockid_t clock) {
  timespec now{};
  clock_gettime(clock, &now);
  return now.tv_sec * std::int64_t{1'000'000'000} + now.tv_nsec;
}

inline std::int64_t monotonic_ns() { return clock_ns(CLOCK_MONOTONIC); }

inline void sleep_until(std::int64_t deadline_ns) {
  const auto [seconds, rest] = std::lldiv(std::max<std::int64_t>(0, deadline_ns), 1'000'000'000);
  const timespec request{static_cast<time_t>(seconds), static_cast<long>(rest)};  // NOLINT
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &request, nullptr) == EINTR) continue;
}

inline std::int64_t watch_until(std::int64_t deadline_ns) {
  std::int64_t now = monotonic_ns();
  while (now < deadline_ns) now = monotonic_ns();
  return now;
}

// Give the calling thread SCHED_FIFO with a priority, or a core; false (and errno): it is refused.
inline bool set_fifo(std::int64_t priority) {
  sched_param wanted{};
  wanted.sched_priority = static_cast<int>(priority);
  return sched_setscheduler(0, SCHED_FIFO | SCHED_RESET_ON_FORK, &wanted) == 0;
}

inline bool set_core(std::int64_t core) {
  cpu_set_t cores;
  CPU_ZERO(&cores);
  CPU_SET(static_cast<std::size_t>(core), &cores);
  return sched_setaffinity(0, sizeof(cores), &cores) == 0;
}

// Both, as the parameters say; `warn` gets what is refused, and the remedy.
template <typename Warn>
void schedule(const Parameters & parameters, Warn warn) {
  if (parameters.fifo_priority > 0 && !set_fifo(parameters.fifo_priority))
    warn("SCHED_FIFO is refused",
         "give the user an rtprio limit of 98, or the container cpu.rt_runtime_us");
  if (parameters.core >= 0 && !set_core(parameters.core))
    warn("core " + std::to_string(parameters.core) + " is refused", "name another in the plan");
}

inline std::int64_t clock_offset() {
  // How long it took, and what was found; a longer bracket means that something came between.
  std::pair<std::int64_t, std::int64_t> best{std::numeric_limits<std::int64_t>::max(), 0};
  for (int attempt = 0; attempt < 5 && best.first >= 2'000; ++attempt) {
    const std::int64_t before = monotonic_ns();
    const std::int64_t realtime = clock_ns(CLOCK_REALTIME);
    const std::int64_t after = monotonic_ns();
    best = std::min(best, {after - before, realtime - (before + after) / 2});
  }
  return best.second;
}

// A gate at work; `Message` is what the queue holds. Its owner sets the functions that it calls.
template <typename Message>
class Shaper {
public:
  Shaper(Gate gate, std::int64_t spin_ns)
      : queue(std::move(gate)), spin_ns_(spin_ns), offset_(clock_offset()) {}

  Shaper(const Shaper &) = delete;
  Shaper & operator=(const Shaper &) = delete;

  void set_phase(std::int64_t phase_ns, std::int64_t now_ns) {
    next_phase_ = {now_ns + modulo(phase_ns - now_ns, queue.gate.cycle_ns), phase_ns};
  }

  void move_slots(std::int64_t by_ns, std::int64_t from_ns) {
    const auto & moves = queue.moves;
    if (by_ns != (moves.empty() ? 0 : moves.back().second) && queue.gate.may_move(by_ns))
      remember(queue.moves, {from_ns, by_ns});
  }

  void follow_moves() {
    if (const auto move = moved()) move_slots(move->second, move->first);
  }

  bool announce(const std::string & name, std::int64_t now_ns) {
    const auto mode = place_of(queue.gate.modes, name);
    if (!mode) return false;
    const auto & changes = queue.changes;
    if (*mode != (changes.empty() ? queue.gate.first_mode : changes.back().second))
      remember(queue.changes, {now_ns, *mode});
    return true;
  }

  // A message with this stamp (CLOCK_REALTIME) was taken now. One that `waited` in the reader
  // counts as having come at its source timestamp, if that is after the last look.
  void arrive(Message message, Maybe stamp_ns, Maybe source_timestamp = {}, bool waited = false,
              Maybe lost = {}) {
    const std::int64_t offset = clock_offset();
    const bool stepped = std::abs(offset - std::exchange(offset_, offset)) > schema::step_ns;
    if (stamp_ns) *stamp_ns -= offset;
    std::int64_t arrival_ns = monotonic_ns();
    if (stepped) queue.doubt_stamps(arrival_ns);
    if (waited && source_timestamp && !stepped)
      arrival_ns = std::min(arrival_ns, std::max(looked_ns_, *source_timestamp - offset));
    if (next_phase_ && arrival_ns >= next_phase_->first) {
      queue.phase_ns = next_phase_->second;
      next_phase_.reset();
    }
    follow_moves();
    auto full = queue.arrive(std::move(message), arrival_ns, stamp_ns, source_timestamp, lost);
    if (full) overflowed.push_back(std::move(*full));
  }

  // Wait until the oldest message leaves, or is dropped; none: it was overflowed meanwhile.
  std::optional<Outcome<Message>> hold() {
    const std::uint64_t number = queue.waiting.front().number;
    std::int64_t now = monotonic_ns();
    turn_ns_ = now;  // before, this thread was busy with the message before it
    Release release = queue.decide();
    on_decision(release, queue.phase_ns);
    bool slept = false;
    if (release.at_ns) {
      waited_ns_ = others_ran_ns();
      slept = *release.at_ns > now;
      while (*release.at_ns - spin_ns_ > now) {
        sleep_until(std::min(*release.at_ns - spin_ns_, now + schema::look_ns));
        look_again();
        now = monotonic_ns();
      }
      if (!slept && queue.gate.messages == Messages::newest) look_again();
      if (queue.waiting.front().number != number) return std::nullopt;
      if (queue.replaced(release, now)) release.drop(Dropped::replaced);
    }
    if (release.at_ns) {
      if (slept) on_waking(*release.at_ns);
      // Awake in time: what other threads took before is of no consequence.
      if (slept && monotonic_ns() < *release.at_ns) waited_ns_ = others_ran_ns();
      now = watch_until(*release.at_ns);
      if (queue.gate.policy() == Policy::discard && missed(queue.gate, release, now)) {
        release.drop(Dropped::discarded);
        release.overrun = Policy::discard;
      }
    }
    return Outcome<Message>{queue.leave(release, now), release, now};
  }

  bool nothing_due() { return nothing_due(monotonic_ns() + schema::others_ns); }

  void rest(std::int64_t published_ns, std::int64_t pause_ns) {
    queue.free_ns = published_ns;
    look_again();
    if (!nothing_due(published_ns + pause_ns)) return;
    sleep_until(published_ns + pause_ns);
    queue.free_ns = monotonic_ns();
  }

  std::int64_t time_lost(const Outcome<Message> & outcome) {
    const std::int64_t others = others_ran_ns() - waited_ns_;
    const std::int64_t since_ns = std::max(*outcome.release.at_ns, turn_ns_);
    return std::max<std::int64_t>(0, outcome.awake_ns - since_ns - others);
  }

  Queue<Message> queue;
  std::vector<Outcome<Message>> overflowed;  // since the owner has emptied it
  std::function<void()> look = [] {};
  std::function<std::optional<Move>()> moved = [] { return std::nullopt; };
  std::function<void(std::int64_t)> on_waking = [](std::int64_t) {};
  std::function<void(const Release &, std::int64_t)> on_decision = [](const auto &...) {};

private:
  bool nothing_due(std::int64_t until_ns) {
    if (queue.waiting.empty()) return true;
    const auto at_ns = queue.decide().at_ns;
    return at_ns && *at_ns > until_ns + spin_ns_;
  }

  template <typename Known>
  static void remember(std::deque<Known> & all, Known one) {
    all.push_back(one);
    if (all.size() > schema::changes) all.pop_front();
  }

  void look_again() {
    const std::int64_t now = monotonic_ns();
    look();
    looked_ns_ = now;
  }

  std::int64_t others_ran_ns() {
    const auto thread = static_cast<pid_t>(syscall(SYS_gettid));
    if (thread != thread_) {  // the file is bound to who opened it
      schedstat_ = File(open("/proc/thread-self/schedstat", O_RDONLY | O_CLOEXEC));
      thread_ = thread;
    }
    char text[128];
    const auto size =
        schedstat_.is_open() ? pread(schedstat_.number(), text, sizeof(text) - 1, 0) : -1;
    if (size <= 0) return monotonic_ns();
    text[size] = '\0';
    char * second = nullptr;
    std::strtoll(text, &second, 10);
    return std::strtoll(second, nullptr, 10);
  }

  std::int64_t spin_ns_;
  std::int64_t offset_;
  std::int64_t looked_ns_{0};
  std::int64_t waited_ns_{0};
  std::int64_t turn_ns_{0};
  File schedstat_;
  pid_t thread_{-1};
  std::optional<std::pair<std::int64_t, std::int64_t>> next_phase_;  // from when on, and which
};

}  // namespace chainshaper
