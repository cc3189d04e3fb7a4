// Writes a gate's log: a line of comma-separated values for each message, written by a thread that
// does nothing else. GateLog of chainshaper's Python node is the same, and says why. No ROS 2 here.

#pragma once

#include <pthread.h>
#include <sched.h>
#include <semaphore.h>
#include <sys/stat.h>
#include <unistd.h>

#include <atomic>
#include <cstdio>
#include <cstring>
#include <memory>
#include <string_view>
#include <thread>

#include "guest.hpp"
#include "shaper.hpp"

namespace chainshaper {

// Lines on their way from the gate's thread, which never waits, to the thread that writes them. (A
// pipe would do as well, but where the robot's process closes all descriptors and uses their
// numbers again, the lines would end in files of the robot.)
class LineQueue {
public:
  LineQueue() { sem_init(&more_, 0, 0); }

  LineQueue(const LineQueue &) = delete;
  LineQueue & operator=(const LineQueue &) = delete;

  ~LineQueue() { sem_destroy(&more_); }

  // Adds a line; returns false if there is no room for it.
  bool put(std::string_view line) {
    const auto begin = put_.load(std::memory_order_relaxed);
    if (line.size() > room - (begin - taken_.load(std::memory_order_acquire))) return false;
    for (std::size_t place = 0; place < line.size(); ++place)
      (*bytes_)[(begin + place) % room] = line[place];
    put_.store(begin + line.size(), std::memory_order_release);
    sem_post(&more_);
    return true;
  }

  // Says that no line comes any more.
  void end() {
    ended_ = true;
    sem_post(&more_);
  }

  // Waits for lines and takes some of them, one at least; returns false if there are none, and none
  // come any more. `put` posts the semaphore for each line, so the next call takes those that are
  // left.
  bool take(std::string & lines) {
    while (sem_wait(&more_) != 0) continue;  // a signal ended the wait early
    const bool is_last = ended_;
    const auto begin = taken_.load(std::memory_order_relaxed);
    const auto end = put_.load(std::memory_order_acquire);
    auto place = begin;
    const auto is_enough = [&] { return lines.size() > at_once && lines.back() == '\n'; };
    while (place != end && !is_enough()) lines += (*bytes_)[place++ % room];
    taken_.store(place, std::memory_order_release);
    return begin != end || !is_last;
  }

private:
  static constexpr std::size_t room = 1 << 20;
  // Bytes that are taken at once: few, since what is added to a file counts for its bound.
  static constexpr std::size_t at_once = 4096;

  std::unique_ptr<std::array<char, room>> bytes_{std::make_unique<std::array<char, room>>()};
  std::atomic<std::size_t> put_{0};    // bytes that were put so far
  std::atomic<std::size_t> taken_{0};  // bytes of these that were taken
  std::atomic<bool> ended_{false};
  sem_t more_{};
};

// The log of a gate, and the sums of what it lost.
class GateLog {
public:
  ~GateLog() {
    if (!writer_.joinable()) return;
    waiting_.end();
    writer_.join();
  }

  // Starts the thread that writes the file; lines are added to one that is there. Returns false
  // (and errno) if the file cannot be written now. It and the one before it, `….1`, together have
  // no more than `most_bytes`.
  bool open_file(const std::string & path, std::int64_t most_bytes) {
    path_ = path;
    most_bytes_ = most_bytes;
    const FileSizeSignalBlocked blocked;
    const bool opened = append("");
    const int reason = errno;
    const SignalsBlocked inherited;
    writer_ = std::thread([this] { write_lines(); });
    errno = reason;
    return opened;
  }

  // Writes what became of a message, and counts what was lost.
  template <typename Message>
  void write(const Gate & gate, const Outcome<Message> & outcome, Maybe published_ns = {},
             Maybe stalled_ns = {}) {
    const auto & [waiting, release, awake_ns] = outcome;
    ++rows;
    if (release.dropped) ++dropped[static_cast<std::size_t>(*release.dropped)];
    lost_by_dds += static_cast<std::size_t>(waiting.lost.value_or(0));
    if (!writer_.joinable()) return;
    line_.clear();
    row(awake_ns, getpid(), syscall(SYS_gettid), sched_getcpu(), waiting.source_timestamp,
        waiting.arrival_ns, release.origin_ns, release.at_ns, release.slot, release.cycles_waited,
        anchor_names[static_cast<std::size_t>(release.anchor)], word(policy_names, release.overrun),
        release.mode ? gate.modes[*release.mode].c_str() : "", published_ns, stalled_ns,
        word(dropped_names, release.dropped), waiting.lost, rows, release.moved_ns);
    line_.back() = '\n';  // in place of the last comma
    if (!waiting_.put(line_)) ++unlogged;
  }

  // Returns what was lost so far, in words; "": nothing.
  std::string losses() const {
    std::string text;
    const auto add = [&](std::size_t count, const char * reason) {
      if (count > 0) text += (text.empty() ? "" : ", ") + std::to_string(count) + " " + reason;
    };
    for (std::size_t i = 0; i < dropped.size(); ++i) add(dropped[i], dropped_names[i]);
    add(lost_by_dds, "lost by DDS");
    add(unlogged, "not in the log");
    return text;
  }

  std::size_t rows{0};
  std::array<std::size_t, dropped_names.size()> dropped{};
  std::size_t lost_by_dds{0};
  std::size_t unlogged{0};

private:
  void write_lines() {
    pthread_setname_np(pthread_self(), "gate_log");
    for (std::string lines; waiting_.take(lines); lines.clear())
      if (!lines.empty()) append(lines);
  }

  // Adds whole lines to the file; returns whether it could be opened. Lines that cannot be written
  // are missing. A file that would have more than half of `most_bytes_` becomes `….1`; one that has
  // been removed is made anew.
  bool append(const std::string & lines) {
    // A link that another user has put there is not followed, nor anything but a file written to.
    const int flags = O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC | O_NONBLOCK | O_NOFOLLOW;
    const int file = open(path_.c_str(), flags, 0644);
    if (file < 0) return false;
    struct stat state{};
    if (fstat(file, &state) != 0 || state.st_nlink > 1 || state.st_uid != geteuid()) {
      close(file);  // another user has put a file in its place
      errno = EPERM;
      return false;
    }
    const std::int64_t before = lseek(file, 0, SEEK_END);
    if (before < 0) {
      close(file);
      return false;
    }
    const auto header = static_cast<std::int64_t>(std::strlen(schema::log_header));
    if (before > header && before + static_cast<std::int64_t>(lines.size()) > most_bytes_ / 2 &&
        std::rename(path_.c_str(), (path_ + ".1").c_str()) == 0) {
      close(file);
      return append(lines);
    }
    const std::string whole = (before == 0 ? schema::log_header : "") + lines;
    if (::write(file, whole.data(), whole.size()) != static_cast<ssize_t>(whole.size()))
        [[maybe_unused]]
      const int cut = ftruncate(file, before);
    close(file);
    return true;
  }

  template <typename Words, typename Word>
  static const char * word(const Words & words, const std::optional<Word> & value) {
    return value ? words[static_cast<std::size_t>(*value)] : "";
  }

  template <typename... Values>
  void row(const Values &... values) {
    static_assert(sizeof...(values) == schema::log_columns);
    (add(values), ...);
  }

  template <typename Value>
  void add(const std::optional<Value> & value) {
    value ? add(*value) : add("");
  }

  template <typename Number>
  void add(const Number & number) {
    line_ += std::to_string(number) + ',';
  }

  void add(const char * text) { line_ += std::string(text) + ','; }

  std::string path_;
  std::int64_t most_bytes_{0};
  LineQueue waiting_;
  std::thread writer_;
  std::string line_;
};

}  // namespace chainshaper
