// What a gate did, one line per message: comma-separated values that chainshaper reads.
//
// A thread of its own writes them to the file, so that neither a slow disk nor a full one can hold
// up the gate: that puts a line into a ring, and goes on without it where the ring is full. Lines
// are numbered, so that those that are missing can be counted. No ROS 2 here.

#ifndef CHAINSHAPER_SHAPING__GATE_LOG_HPP_
#define CHAINSHAPER_SHAPING__GATE_LOG_HPP_

#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <sched.h>
#include <semaphore.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <memory>
#include <optional>
#include <string>
#include <thread>

#include "gate.hpp"
#include "shaper.hpp"

namespace chainshaper
{

inline constexpr const char * log_header =
  "time,pid,tid,cpu,source_timestamp,arrival,origin,release,slot,cycles_waited,anchor,overrun,"
  "mode,published,stalled,dropped,lost,row\n";

// Adds lines to a file, whole ones only. A file that would have more than half of `most_bytes`
// becomes `….1`, in place of the one before it; one that has been removed is made anew. What cannot
// be written is missing.
class RowWriter
{
public:
  RowWriter(std::string path, std::int64_t most_bytes)
  : path_(std::move(path)), most_bytes_(most_bytes), ring_(std::make_unique<Ring>())
  {
    sem_init(&more_, 0, 0);
    writer_ = std::thread([this] {write();});
  }

  RowWriter(const RowWriter &) = delete;
  RowWriter & operator=(const RowWriter &) = delete;

  ~RowWriter()
  {
    over_ = true;
    sem_post(&more_);
    writer_.join();
    sem_destroy(&more_);
  }

  // False: there is no room. Never waits.
  bool put(const char * text, std::size_t size)
  {
    const std::size_t end = end_.load(std::memory_order_relaxed);
    if (end - begin_.load(std::memory_order_acquire) == ring_->size() || size > line_bytes) {
      return false;
    }
    auto & line = (*ring_)[end % ring_->size()];
    std::memcpy(line.text, text, size);
    line.size = size;
    end_.store(end + 1, std::memory_order_release);
    sem_post(&more_);
    return true;
  }

private:
  static constexpr std::size_t line_bytes = 512;
  struct Line
  {
    char text[line_bytes];
    std::size_t size;
  };
  using Ring = std::array<Line, 4096>;

  void write()
  {
    pthread_setname_np(pthread_self(), "gate_log");
    for (;;) {
      while (sem_wait(&more_) != 0) {
        // A signal ended the wait early.
      }
      const std::size_t begin = begin_.load(std::memory_order_relaxed);
      if (begin == end_.load(std::memory_order_acquire)) {
        if (over_) {
          return;
        }
        continue;
      }
      const auto & line = (*ring_)[begin % ring_->size()];
      append(line.text, line.size);
      begin_.store(begin + 1, std::memory_order_release);
    }
  }

  int opened() const
  {
    return open(path_.c_str(), O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
  }

  void append(const char * text, std::size_t size)
  {
    int file = opened();
    std::int64_t before = file < 0 ? 0 : lseek(file, 0, SEEK_END);
    const auto header = static_cast<std::int64_t>(std::strlen(log_header));
    if (before > header && before + static_cast<std::int64_t>(size) > most_bytes_ / 2 &&
      std::rename(path_.c_str(), (path_ + ".1").c_str()) == 0)
    {
      close(file);
      file = opened();
      before = 0;
    }
    if (file < 0) {
      return;
    }
    std::string whole = before == 0 ? log_header : "";
    whole.append(text, size);
    if (::write(file, whole.data(), whole.size()) != static_cast<ssize_t>(whole.size())) {
      [[maybe_unused]] const int cut = ftruncate(file, before);
    }
    close(file);
  }

  std::string path_;
  std::int64_t most_bytes_;
  std::unique_ptr<Ring> ring_;
  std::atomic<std::size_t> begin_{0};
  std::atomic<std::size_t> end_{0};
  std::atomic<bool> over_{false};
  sem_t more_;
  std::thread writer_;
};

class GateLog
{
public:
  // Lines are added to a file that is there; false (and errno): it cannot be written now.
  bool open_file(const std::string & path, std::int64_t most_bytes)
  {
    const int flags = O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC | O_NONBLOCK;
    const int file = open(path.c_str(), flags, 0644);
    const int because = errno;
    if (file >= 0) {
      if (lseek(file, 0, SEEK_END) == 0) {
        [[maybe_unused]] const auto size = ::write(file, log_header, std::strlen(log_header));
      }
      close(file);
    }
    writer_ = std::make_unique<RowWriter>(path, most_bytes);
    errno = because;
    return file >= 0;
  }

  // `published_ns` is when publishing returned, `stalled_ns` for how long the machine stood still
  // behind the release; none for a message that was dropped.
  template<typename Message>
  void write(
    const Gate & gate, const Held<Message> & held,
    std::optional<std::int64_t> published_ns = {}, std::optional<std::int64_t> stalled_ns = {})
  {
    const Release & release = held.release;
    const auto & waiting = held.waiting;
    ++rows;
    if (held.dropped) {
      ++dropped[static_cast<std::size_t>(*held.dropped)];
    }
    lost_by_dds += static_cast<std::uint64_t>(waiting.lost.value_or(0));
    if (!writer_) {
      return;
    }
    std::optional<std::int64_t> slot;
    if (release.slot) {
      slot = static_cast<std::int64_t>(*release.slot);
    }
    size_ = 0;
    number(held.awake_ns);
    number(getpid());
    number(syscall(SYS_gettid));
    number(sched_getcpu());
    number(waiting.source_timestamp);
    number(waiting.arrival_ns);
    number(release.origin_ns);
    number(release.at_ns);
    number(slot);
    number(release.cycles_waited);
    text(anchor_names[static_cast<std::size_t>(release.anchor)]);
    text(release.overrun ? policy_names[static_cast<std::size_t>(*release.overrun)] : "");
    text(release.mode ? gate.modes->names[*release.mode].c_str() : "");
    number(published_ns);
    number(stalled_ns);
    text(held.dropped ? dropped_names[static_cast<std::size_t>(*held.dropped)] : "");
    number(waiting.lost);
    number(static_cast<std::int64_t>(rows));
    line_[size_ - 1] = '\n';  // in place of the last comma
    if (!writer_->put(line_.data(), size_)) {
      ++unlogged;
    }
  }

  // What is lost so far, in words; empty: nothing.
  std::string losses() const
  {
    std::string said;
    const auto add = [&](std::uint64_t count, const char * why) {
        if (count > 0) {
          said += (said.empty() ? "" : ", ") + std::to_string(count) + " " + why;
        }
      };
    for (std::size_t i = 0; i < dropped.size(); ++i) {
      add(dropped[i], dropped_names[i]);
    }
    add(lost_by_dds, "lost by DDS");
    add(unlogged, "not in the log");
    return said;
  }

  std::uint64_t rows{0};
  std::array<std::uint64_t, dropped_names.size()> dropped{};
  std::uint64_t lost_by_dds{0};
  std::uint64_t unlogged{0};

private:
  void number(std::optional<std::int64_t> value)
  {
    if (value) {
      append(
        std::snprintf(
          line_.data() + size_, line_.size() - size_, "%lld", static_cast<long long>(*value)));  // NOLINT
    }
    append(std::snprintf(line_.data() + size_, line_.size() - size_, ","));
  }

  void text(const char * value)
  {
    append(std::snprintf(line_.data() + size_, line_.size() - size_, "%s,", value));
  }

  void append(int written)
  {
    size_ = std::min(line_.size() - 1, size_ + static_cast<std::size_t>(written));
  }

  std::unique_ptr<RowWriter> writer_;
  std::array<char, 512> line_{};
  std::size_t size_{0};
};

}  // namespace chainshaper

#endif  // CHAINSHAPER_SHAPING__GATE_LOG_HPP_
