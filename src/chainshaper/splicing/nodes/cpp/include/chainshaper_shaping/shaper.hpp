// A gate at work: holds each message until its release, and minds the clocks. The same as Shaper in
// chainshaper/gate/decision.py, which explains it. No ROS 2 here.

#pragma once

#include <errno.h>
#include <fcntl.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include <functional>
#include <limits>

#include "gate.hpp"

namespace chainshaper {

inline std::int64_t clock_ns(clockid_t clock) {
  timespec now{};
  clock_gettime(clock, &now);
  return now.tv_sec * std::int64_t{1'000'000'000} + now.tv_nsec;
}

inline std::int64_t monotonic_ns() { return clock_ns(CLOCK_MONOTONIC); }

// Sleep until an instant of CLOCK_MONOTONIC; returns at once when it has passed.
inline void sleep_until(std::int64_t deadline_ns) {
  deadline_ns = std::max<std::int64_t>(0, deadline_ns);
  timespec request{};
  request.tv_sec = static_cast<time_t>(deadline_ns / 1'000'000'000);
  request.tv_nsec = static_cast<long>(deadline_ns % 1'000'000'000);  // NOLINT(runtime/int)
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &request, nullptr) == EINTR) {
    // A signal ends the sleep early; the deadline stays the same.
  }
}

// Watch the clock until an instant has come; the time then. Waking from a sleep takes some tens
// of microseconds, and not always the same.
inline std::int64_t watch_until(std::int64_t deadline_ns) {
  std::int64_t now = monotonic_ns();
  while (now < deadline_ns) now = monotonic_ns();
  return now;
}

// CLOCK_REALTIME minus CLOCK_MONOTONIC, to a fraction of a microsecond.
inline std::int64_t clock_offset() {
  std::int64_t best_width = std::numeric_limits<std::int64_t>::max();
  std::int64_t best = 0;
  for (int attempt = 0; attempt < 5 && best_width >= 2'000; ++attempt) {
    const std::int64_t before = monotonic_ns();
    const std::int64_t realtime = clock_ns(CLOCK_REALTIME);
    const std::int64_t after = monotonic_ns();
    if (after - before < best_width) {  // a longer bracket means that something came between
      best_width = after - before;
      best = realtime - (before + after) / 2;
    }
  }
  return best;
}

// For how long the calling thread has been ready while others ran, by the kernel's account: the
// second number of /proc/thread-self/schedstat (Documentation/scheduler/sched-stats.rst). Where the
// kernel has none, all delay is taken to be other threads', and none the machine's.
class WaitingTime {
public:
  WaitingTime() = default;
  WaitingTime(const WaitingTime &) = delete;
  WaitingTime & operator=(const WaitingTime &) = delete;

  ~WaitingTime() {
    if (file_ >= 0) close(file_);
  }

  std::int64_t so_far() {
    const auto thread = static_cast<pid_t>(syscall(SYS_gettid));
    if (thread != thread_) {  // the file is bound to who opened it
      if (file_ >= 0) close(file_);
      file_ = open("/proc/thread-self/schedstat", O_RDONLY | O_CLOEXEC);
      thread_ = thread;
    }
    char text[128];
    const auto size = file_ < 0 ? -1 : pread(file_, text, sizeof(text) - 1, 0);
    if (size <= 0) return monotonic_ns();
    text[size] = '\0';
    char * second = nullptr;
    std::strtoll(text, &second, 10);
    return std::strtoll(second, nullptr, 10);
  }

private:
  int file_{-1};
  pid_t thread_{-1};
};

// `Message` is what the queue holds. `look` takes what has come and has it arrive: it is called
// while others wait, before each release and behind it.
template <typename Message>
class Shaper {
public:
  // `on_waking` is called with the time of a release when it wakes `spin_ns` before that, to watch
  // the clock from there; what it does there should be over in time. `on_decision` is called with
  // each decision, before it is waited for, and where cycles begin.
  Shaper(
      Gate gate, std::int64_t spin_ns,
      std::function<void(std::int64_t)> on_waking = [](std::int64_t) {},
      std::function<void()> look = [] {},
      std::function<void(const Release &, std::int64_t)> on_decision = [](const Release &,
                                                                          std::int64_t) {})
      : queue(std::move(gate)),
        look(std::move(look)),
        spin_ns_(spin_ns),
        on_waking_(std::move(on_waking)),
        on_decision_(std::move(on_decision)),
        offset_(clock_offset()) {}

  // Cycles begin elsewhere, from the first such beginning after `now_ns` on.
  void set_phase(std::int64_t phase_ns, std::int64_t now_ns) {
    next_phase_ = {now_ns + modulo(phase_ns - now_ns, queue.gate.cycle_ns), phase_ns};
  }

  // A mode is announced, in force from the next cycle on; false: there is none like it.
  bool announce(const std::string & name, std::int64_t now_ns) {
    const auto & modes = queue.gate.modes;
    const auto mode = modes ? place_of(modes->names, name) : std::nullopt;
    if (!mode) return false;
    auto & changes = queue.changes;
    if (*mode != (changes.empty() ? modes->initial : changes.back().second)) {
      changes.emplace_back(now_ns, *mode);
      if (changes.size() > max_changes) changes.pop_front();
    }
    return true;
  }

  // A message with this stamp (CLOCK_REALTIME) was taken now. One that `waited` in the reader
  // counts as having come at its source timestamp, if that is after the last look.
  void arrive(Message message, Maybe stamp_ns, Maybe source_timestamp = {}, bool waited = false,
              Maybe lost = {}) {
    const std::int64_t offset = clock_offset();
    const bool stepped = std::abs(offset - offset_) > step_ns;
    offset_ = offset;
    Maybe origin;
    if (stamp_ns && !stepped) origin = *stamp_ns - offset;
    std::int64_t arrival_ns = monotonic_ns();
    if (waited && source_timestamp && !stepped)
      arrival_ns = std::min(arrival_ns, std::max(looked_ns_, *source_timestamp - offset));
    if (next_phase_ && arrival_ns >= next_phase_->first) {
      queue.phase_ns = next_phase_->second;
      next_phase_.reset();
    }
    auto full = queue.arrive(std::move(message), arrival_ns, origin, source_timestamp, lost);
    if (full) overflowed.push_back(std::move(*full));
  }

  // Wait until the oldest message leaves, or is dropped; none: it was overflowed meanwhile. One
  // that is to be discarded is not waited for; where overruns are discarded, so is a message whose
  // slot is over when this thread wakes.
  std::optional<Outcome<Message>> hold() {
    const std::uint64_t number = queue.waiting.front().number;
    std::int64_t now = monotonic_ns();
    auto [release, dropped] = queue.decide();
    on_decision_(release, queue.phase_ns);
    bool slept = false;
    if (release.at_ns) {
      waited_ns_ = waiting_.so_far();
      slept = *release.at_ns > now;
      while (*release.at_ns - spin_ns_ > now) {
        sleep_until(std::min(*release.at_ns - spin_ns_, now + look_ns));
        look_again();
        now = monotonic_ns();
      }
      if (!slept && queue.gate.messages == Messages::newest) look_again();
      if (queue.waiting.front().number != number) return std::nullopt;
      if (queue.replaced(release, now)) {
        release = withheld(release);
        dropped = Dropped::replaced;
      }
    }
    if (!release.at_ns) return Outcome<Message>{queue.leave(release, now), release, now, dropped};
    if (slept) {
      on_waking_(*release.at_ns);
      if (monotonic_ns() < *release.at_ns) {
        // Awake in time: what other threads took before is of no consequence.
        waited_ns_ = waiting_.so_far();
      }
    }
    const std::int64_t awake = watch_until(*release.at_ns);
    if (policy_of(queue.gate) == Policy::discard && missed(queue.gate, release, awake)) {
      release = withheld(release);
      release.overrun = Policy::discard;
      dropped = Dropped::discarded;
    }
    return Outcome<Message>{queue.leave(release, awake), release, awake, dropped};
  }

  // Whether there is time for something else before the next release.
  bool nothing_due() {
    if (queue.waiting.empty()) return true;
    const Release release = queue.decide().first;
    return release.at_ns && *release.at_ns > monotonic_ns() + spin_ns_ + others_ns;
  }

  // Pause behind a publication, unless another message has to leave meanwhile.
  void rest(std::int64_t published_ns, std::int64_t pause_ns) {
    queue.free_ns = published_ns;
    look_again();
    const std::int64_t until = published_ns + pause_ns;
    if (!queue.waiting.empty()) {
      const Release release = queue.decide().first;
      if (!release.at_ns || *release.at_ns - spin_ns_ <= until) return;
    }
    sleep_until(until);
    queue.free_ns = monotonic_ns();
  }

  // How much of the delay between a release and the time when the thread was awake the machine
  // itself took: what the kernel does not say that other threads ran. To be called right after
  // publishing.
  std::int64_t time_lost(const Outcome<Message> & outcome) {
    if (!outcome.release.at_ns) return 0;
    const std::int64_t others = waiting_.so_far() - waited_ns_;
    return std::max<std::int64_t>(0, outcome.awake_ns - *outcome.release.at_ns - others);
  }

  Queue<Message> queue;
  std::vector<Outcome<Message>> overflowed;  // since the owner has emptied it
  std::function<void()> look;

private:
  void look_again() {
    const std::int64_t now = monotonic_ns();
    look();
    looked_ns_ = now;
  }

  std::int64_t spin_ns_;
  std::function<void(std::int64_t)> on_waking_;
  std::function<void(const Release &, std::int64_t)> on_decision_;
  std::int64_t offset_;
  std::int64_t looked_ns_{0};
  WaitingTime waiting_;
  std::int64_t waited_ns_{0};
  std::optional<std::pair<std::int64_t, std::int64_t>> next_phase_;  // from when on, and which
};

}  // namespace chainshaper
