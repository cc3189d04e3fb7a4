// A gate at work in a thread: clocks, sleeping and serialized messages around the decisions of
// gate/. chainshaper/robot/shaper.py is the same in Python, and explains it. No ROS 2 here. All
// times are nanoseconds.

#pragma once

#include <errno.h>
#include <fcntl.h>
#include <sched.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <functional>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "gate/decision.hpp"
#include "gate/queue.hpp"
#include "guest.hpp"
#include "schema.hpp"

namespace chainshaper {

// Returns the gate that a node's parameters describe, with room for so many messages. Throws
// std::invalid_argument for an unknown word.
inline Gate gate_of(const Parameters & parameters, std::size_t depth) {
  Gate gate;
  static_cast<GateValues &>(gate) = parameters.gate_values();
  const auto & bounds = parameters.slots_ns;
  for (std::size_t i = 0; i + 1 < bounds.size(); i += 2)
    gate.slots.push_back({bounds[i], bounds[i + 1]});
  gate.depth = depth;
  if (!parameters.mode_topic.empty()) {
    gate.modes = parameters.mode_names;
    for (const auto number : parameters.mode_slots)  // from 1, as bands of a plan
      gate.mode_slots.push_back(static_cast<std::size_t>(number - 1));
    gate.first_mode = word_named<std::size_t>(gate.modes, parameters.mode_default);
    gate.late = word_named<Policy>(policy_names, parameters.mode_late);
  }
  return gate;
}

// Returns how many messages may wait: by default as many as in the publisher's history.
inline std::size_t depth_of(const Parameters & parameters, std::size_t history) {
  if (parameters.depth > 0) return static_cast<std::size_t>(parameters.depth);
  return std::max<std::size_t>(schema::depth, history);
}

// Returns four bytes of a serialized message, in the byte order that its encapsulation header
// names.
inline std::uint32_t word_at(const std::uint8_t * payload, std::size_t at) {
  const bool little = (payload[1] & 1) != 0;
  std::uint32_t value = 0;
  for (std::size_t i = 0; i < 4; ++i)
    value |= std::uint32_t{payload[at + i]} << (8 * (little ? i : 3 - i));
  return value;
}

// Returns the stamp of a serialized message whose first field is a header; none if it is zero or no
// stamp at all.
inline Maybe origin_of(const std::uint8_t * payload, std::size_t size) {
  if (size < 12) return std::nullopt;
  const std::int64_t seconds = static_cast<std::int32_t>(word_at(payload, 4));
  const std::int64_t nanoseconds = word_at(payload, 8);
  if ((seconds == 0 && nanoseconds == 0) || nanoseconds >= 1'000'000'000) return std::nullopt;
  return seconds * 1'000'000'000 + nanoseconds;
}

// Returns the text of a serialized std_msgs/String; none: it is damaged.
inline std::optional<std::string> text_of(const std::uint8_t * payload, std::size_t size) {
  if (size < 8) return std::nullopt;
  const std::size_t length = word_at(payload, 4);  // with the final NUL
  if (length < 1 || length > size - 8) return std::nullopt;
  return std::string(reinterpret_cast<const char *>(payload + 8), length - 1);
}

inline std::int64_t clock_ns(clockid_t clock) {
  timespec now{};
  clock_gettime(clock, &now);
  return now.tv_sec * std::int64_t{1'000'000'000} + now.tv_nsec;
}

inline std::int64_t monotonic_ns() { return clock_ns(CLOCK_MONOTONIC); }

// Sleeps until an instant of CLOCK_MONOTONIC; a signal does not end the sleep.
inline void sleep_until(std::int64_t deadline_ns) {
  const auto [seconds, rest] = std::lldiv(std::max<std::int64_t>(0, deadline_ns), 1'000'000'000);
  const timespec request{static_cast<time_t>(seconds), static_cast<long>(rest)};  // NOLINT
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &request, nullptr) == EINTR) continue;
}

// Watches the clock until an instant of CLOCK_MONOTONIC; returns the time.
inline std::int64_t watch_until(std::int64_t deadline_ns) {
  std::int64_t now = monotonic_ns();
  while (now < deadline_ns) now = monotonic_ns();
  return now;
}

// Gives the calling thread SCHED_FIFO with a priority. Returns false (and errno) if it is refused.
inline bool set_fifo(std::int64_t priority) {
  sched_param wanted{};
  wanted.sched_priority = static_cast<int>(priority);
  return sched_setscheduler(0, SCHED_FIFO | SCHED_RESET_ON_FORK, &wanted) == 0;
}

// Binds the calling thread to a core. Returns false (and errno) if it is refused.
inline bool set_core(std::int64_t core) {
  cpu_set_t cores;
  CPU_ZERO(&cores);
  CPU_SET(static_cast<std::size_t>(core), &cores);
  return sched_setaffinity(0, sizeof(cores), &cores) == 0;
}

// Gives the calling thread the priority and the core of the parameters; `warn` gets the text of
// what is refused, and the remedy.
template <typename Warn>
void schedule(const Parameters & parameters, Warn warn) {
  if (parameters.fifo_priority > 0 && !set_fifo(parameters.fifo_priority))
    warn("SCHED_FIFO is refused",
         "give the user an rtprio limit of 98, or the container cpu.rt_runtime_us");
  if (parameters.core >= 0 && !set_core(parameters.core))
    warn("core " + std::to_string(parameters.core) + " is refused", "name another in the plan");
}

// Returns CLOCK_REALTIME minus CLOCK_MONOTONIC.
inline std::int64_t clock_offset() {
  // How long the shortest measurement took, and the offset: in a longer one another thread ran.
  std::pair<std::int64_t, std::int64_t> best{std::numeric_limits<std::int64_t>::max(), 0};
  for (int attempt = 0; attempt < 5 && best.first >= 2'000; ++attempt) {
    const std::int64_t before = monotonic_ns();
    const std::int64_t realtime = clock_ns(CLOCK_REALTIME);
    const std::int64_t after = monotonic_ns();
    best = std::min(best, {after - before, realtime - (before + after) / 2});
  }
  return best.second;
}

// A gate at work, with `Message`s in its queue. The owner sets the functions that it calls: `look`,
// `follow`, `on_waking` and `on_decision`.
template <typename Message>
class Shaper {
public:
  Shaper(Gate gate, std::int64_t spin_ns)
      : queue(std::move(gate)), spin_ns_(spin_ns), offset_(clock_offset()) {}

  Shaper(const Shaper &) = delete;
  Shaper & operator=(const Shaper &) = delete;

  // Puts a mode in force from the next cycle on; returns whether there is one of that name.
  bool announce(const std::string & name, std::int64_t now_ns) {
    const auto mode = place_of(queue.gate.modes, name);
    if (!mode) return false;
    queue.switch_mode(*mode, now_ns);
    return true;
  }

  // Queues a message that was taken now, with this stamp (CLOCK_REALTIME). One that `waited` in the
  // reader counts as having come at its source timestamp, if that is after the last look.
  void arrive(Message message, Maybe stamp_ns, Maybe source_timestamp = {}, bool waited = false,
              Maybe lost = {}) {
    const std::int64_t offset = clock_offset();
    const bool stepped = std::abs(offset - std::exchange(offset_, offset)) > schema::step_ns;
    if (stamp_ns) *stamp_ns -= offset;
    std::int64_t arrival_ns = monotonic_ns();
    if (stepped) queue.doubt_stamps(arrival_ns);
    if (waited && source_timestamp && !stepped)
      arrival_ns = std::min(arrival_ns, std::max(looked_ns_, *source_timestamp - offset));
    follow();
    auto full = queue.arrive(std::move(message), arrival_ns, stamp_ns, source_timestamp, lost);
    if (full) overflowed.push_back(std::move(*full));
  }

  // Waits until the oldest message leaves or is dropped; none: it overflowed meanwhile.
  std::optional<Outcome<Message>> hold() {
    const std::uint64_t number = queue.waiting.front().number;
    std::int64_t now = monotonic_ns();
    turn_ns_ = now;  // until now, this thread was busy with the message before it
    Release release = queue.decide();
    on_decision(release);
    bool slept = false;
    if (release.at_ns) {
      waited_ns_ = others_ran_ns();
      slept = *release.at_ns > now;
      while (*release.at_ns - spin_ns_ > now) {
        sleep_until(std::min(*release.at_ns - spin_ns_, now + schema::look_ns));
        look_again();
        now = monotonic_ns();
      }
      // At the first look, the message may have come long ago, and newer ones since.
      if (!slept && (queue.gate.messages == Messages::newest || looked_ns_ == 0)) look_again();
      if (queue.waiting.front().number != number) return std::nullopt;
      if (queue.replaced(release, now)) release.drop(Dropped::replaced);
    }
    if (release.at_ns) {
      if (slept) on_waking(*release.at_ns);
      // This thread is awake in time: other threads that ran before have delayed nothing.
      if (slept && monotonic_ns() < *release.at_ns) waited_ns_ = others_ran_ns();
      now = watch_until(*release.at_ns);
      if (queue.gate.policy() == Policy::discard && missed(queue.gate, release, now)) {
        release.drop(Dropped::discarded);
        release.overrun = Policy::discard;
      }
    }
    return Outcome<Message>{queue.leave(release, now), release, now};
  }

  // Returns whether the node has time for its other callbacks before the oldest message is due.
  bool nothing_due() { return nothing_due(monotonic_ns() + schema::others_ns); }

  // Sleeps for `pause_ns` behind a publication, so that it is delivered first; not at all if the
  // next message is due in that time.
  void rest(std::int64_t published_ns, std::int64_t pause_ns) {
    queue.free_ns = published_ns;
    look_again();
    if (!nothing_due(published_ns + pause_ns)) return;
    sleep_until(published_ns + pause_ns);
    queue.free_ns = monotonic_ns();
  }

  // Returns how much of the delay from a message's release until the thread was awake no thread
  // used: interrupts took that, or the whole system lost the core. To be called right after
  // publishing.
  std::int64_t time_lost(const Outcome<Message> & outcome) {
    const std::int64_t others = others_ran_ns() - waited_ns_;
    const std::int64_t since_ns = std::max(*outcome.release.at_ns, turn_ns_);
    return std::max<std::int64_t>(0, outcome.awake_ns - since_ns - others);
  }

  Queue<Message> queue;
  std::vector<Outcome<Message>> overflowed;  // since the owner emptied this list
  std::function<void()> look = [] {};
  std::function<void()> follow = [] {};
  std::function<void(std::int64_t)> on_waking = [](std::int64_t) {};
  std::function<void(const Release &)> on_decision = [](const Release &) {};

private:
  bool nothing_due(std::int64_t until_ns) {
    if (queue.waiting.empty()) return true;
    const auto at_ns = queue.decide().at_ns;
    return at_ns && *at_ns > until_ns + spin_ns_;
  }

  // Has the owner take what has come, and notes when.
  void look_again() {
    const std::int64_t now = monotonic_ns();
    look();
    looked_ns_ = now;
  }

  // Returns how long this thread has been ready while other threads ran, as the kernel counts it.
  std::int64_t others_ran_ns() {
    const auto thread = static_cast<pid_t>(syscall(SYS_gettid));
    if (thread != thread_) {  // the file belongs to the thread that opened it
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
};

}  // namespace chainshaper
