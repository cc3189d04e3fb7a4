// What a gate did, one line of comma-separated values per message, written by a thread of its own:
// as GateLog of chainshaper's Python node, which says why. No ROS 2 here.

#pragma once

#include <pthread.h>
#include <sched.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cstdio>
#include <cstring>
#include <thread>

#include "gate.hpp"

namespace chainshaper {

class GateLog {
public:
  ~GateLog() {
    if (!writer_.joinable()) return;
    close(ends_[1]);
    writer_.join();
    close(ends_[0]);
  }

  // Lines are added to a file that is there; false (and errno): it cannot be written now. The file
  // and the one before it, `….1`, have no more than `most_bytes`.
  bool open_file(const std::string & path, std::int64_t most_bytes) {
    path_ = path;
    most_bytes_ = most_bytes;
    const bool opened = append("");
    const int because = errno;
    if (pipe2(ends_, O_CLOEXEC) == 0) {
      fcntl(ends_[1], F_SETFL, O_NONBLOCK);
      fcntl(ends_[1], F_SETPIPE_SZ, 1 << 20);  // more than a user may have is refused
      writer_ = std::thread([this] { write_lines(); });
    }
    errno = because;
    return opened;
  }

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
    if (::write(ends_[1], line_.data(), line_.size()) != static_cast<ssize_t>(line_.size()))
      ++unlogged;
  }

  std::string losses() const {
    std::string said;
    const auto add = [&](std::size_t count, const char * why) {
      if (count > 0) said += (said.empty() ? "" : ", ") + std::to_string(count) + " " + why;
    };
    for (std::size_t i = 0; i < dropped.size(); ++i) add(dropped[i], dropped_names[i]);
    add(lost_by_dds, "lost by DDS");
    add(unlogged, "not in the log");
    return said;
  }

  std::size_t rows{0};
  std::array<std::size_t, dropped_names.size()> dropped{};
  std::size_t lost_by_dds{0};
  std::size_t unlogged{0};

private:
  void write_lines() {
    pthread_setname_np(pthread_self(), "gate_log");
    std::string lines;
    std::array<char, 4096> received;
    for (;;) {
      const auto size = read(ends_[0], received.data(), received.size());
      if (size == 0 || (size < 0 && errno != EINTR)) return;
      lines.append(received.data(), static_cast<std::size_t>(std::max<ssize_t>(0, size)));
      const auto whole = lines.rfind('\n') + 1;
      append(lines.substr(0, whole));
      lines.erase(0, whole);
    }
  }

  // Adds whole lines only; what cannot be written is missing. A file that would have more than half
  // of `most_bytes_` becomes `….1`; one that has been removed is made anew. Whether it is there.
  bool append(const std::string & lines) {
    const int flags = O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC | O_NONBLOCK | O_NOFOLLOW;
    const int file = open(path_.c_str(), flags, 0644);
    if (file < 0) return false;
    struct stat state{};
    if (fstat(file, &state) != 0 || state.st_nlink > 1 || state.st_uid != geteuid()) {
      close(file);  // somebody else's was put in its place
      errno = EPERM;
      return false;
    }
    const std::int64_t before = lseek(file, 0, SEEK_END);
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
  static const char * word(const Words & words, const std::optional<Word> & one) {
    return one ? words[static_cast<std::size_t>(*one)] : "";
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
  int ends_[2]{-1, -1};
  std::thread writer_;
  std::string line_;
};

}  // namespace chainshaper
