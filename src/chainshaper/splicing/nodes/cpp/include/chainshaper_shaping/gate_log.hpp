// What a gate did, one line per message: comma-separated values that chainshaper reads.
//
// A line is put together in a buffer that is there already, and handed to the page cache with one
// write after the message has left; what was written stays when the process is killed. No ROS 2
// here.

#ifndef CHAINSHAPER_SHAPING__GATE_LOG_HPP_
#define CHAINSHAPER_SHAPING__GATE_LOG_HPP_

#include <fcntl.h>
#include <sched.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <array>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <optional>
#include <string>

#include "gate.hpp"
#include "shaper.hpp"

namespace chainshaper
{

inline constexpr const char * log_header =
  "time,pid,tid,cpu,source_timestamp,arrival,origin,release,slot,cycles_waited,anchor,overrun,"
  "mode,published,stalled\n";

class GateLog
{
public:
  // Lines are added to a file that is there; false (and errno): it cannot be written.
  bool open_file(const std::string & path)
  {
    file_ = open(path.c_str(), O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
    if (file_ >= 0 && lseek(file_, 0, SEEK_END) == 0) {
      put(log_header, std::strlen(log_header));
    }
    return file_ >= 0;
  }

  GateLog() = default;

  GateLog(const GateLog &) = delete;
  GateLog & operator=(const GateLog &) = delete;

  ~GateLog()
  {
    if (file_ >= 0) {
      close(file_);
    }
  }

  // `published_ns` is when publishing returned, `stalled_ns` for how long the machine stood still
  // behind the release; none for a message that was discarded.
  void write(
    const Gate & gate, const Held & held, std::optional<std::int64_t> source_timestamp,
    std::optional<std::int64_t> published_ns, std::optional<std::int64_t> stalled_ns)
  {
    if (file_ < 0) {
      return;
    }
    const Release & release = held.release;
    std::optional<std::int64_t> slot;
    if (release.slot) {
      slot = static_cast<std::int64_t>(*release.slot);
    }
    size_ = 0;
    number(held.awake_ns);
    number(getpid());
    number(syscall(SYS_gettid));
    number(sched_getcpu());
    number(source_timestamp);
    number(held.arrival_ns);
    number(release.origin_ns);
    number(release.at_ns);
    number(slot);
    number(release.cycles_waited);
    text(anchor_names[static_cast<std::size_t>(release.anchor)]);
    text(release.overrun ? policy_names[static_cast<std::size_t>(*release.overrun)] : "");
    text(release.mode ? gate.modes->names[*release.mode].c_str() : "");
    number(published_ns);
    number(stalled_ns);
    line_[size_ - 1] = '\n';  // in place of the last comma
    put(line_.data(), size_);
  }

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

  void put(const char * bytes, std::size_t count)
  {
    // A full disk must not stop the output: a line that cannot be written is missing.
    [[maybe_unused]] const auto written = ::write(file_, bytes, count);
  }

  int file_{-1};
  std::array<char, 1024> line_{};
  std::size_t size_{0};
};

}  // namespace chainshaper

#endif  // CHAINSHAPER_SHAPING__GATE_LOG_HPP_
