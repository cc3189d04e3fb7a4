// Keeps a library of chainshaper a good guest in a robot's process: whatever fails in the library,
// the process goes on as without it. No ROS 2 here.

#pragma once

#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include <cerrno>
#include <cstddef>
#include <string>
#include <utility>

namespace chainshaper {

// Blocks SIGXFSZ in the calling thread while it lives, and at its end discards such a signal that
// has come: the kernel sends it where a file would get larger than `ulimit -f` allows, and by
// default it ends the process.
class FileSizeSignalBlocked {
public:
  FileSizeSignalBlocked() {
    sigemptyset(&signal_);
    sigaddset(&signal_, SIGXFSZ);
    sigset_t pending;
    sigpending(&pending);
    was_pending_ = sigismember(&pending, SIGXFSZ) == 1;
    pthread_sigmask(SIG_BLOCK, &signal_, &before_);
  }

  FileSizeSignalBlocked(const FileSizeSignalBlocked &) = delete;
  FileSizeSignalBlocked & operator=(const FileSizeSignalBlocked &) = delete;

  ~FileSizeSignalBlocked() {
    const int error = errno;
    const timespec at_once{0, 0};
    if (!was_pending_)
      while (sigtimedwait(&signal_, nullptr, &at_once) < 0 && errno == EINTR) continue;
    pthread_sigmask(SIG_SETMASK, &before_, nullptr);
    errno = error;
  }

private:
  sigset_t signal_;
  sigset_t before_;
  bool was_pending_;
};

// Blocks all signals in the calling thread while it lives. Threads that are started meanwhile
// inherit that: threads of the robot handle the signals of the robot's process.
class SignalsBlocked {
public:
  SignalsBlocked() {
    sigset_t all;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &before_);
  }

  SignalsBlocked(const SignalsBlocked &) = delete;
  SignalsBlocked & operator=(const SignalsBlocked &) = delete;

  ~SignalsBlocked() { pthread_sigmask(SIG_SETMASK, &before_, nullptr); }

private:
  sigset_t before_;
};

// An open file. A process may close all descriptors by their numbers and use the numbers again, as
// daemons do: call `is_open` before each use, which checks that the number is still this file's.
class File {
public:
  File() = default;

  explicit File(int number) : number_(number) {
    if (number_ >= 0 && fstat(number_, &identity_) != 0) number_ = -1;
  }

  File(File && moved) noexcept
      : number_(std::exchange(moved.number_, -1)), identity_(moved.identity_) {}

  File & operator=(File && moved) noexcept {
    std::swap(number_, moved.number_);
    std::swap(identity_, moved.identity_);
    return *this;
  }

  ~File() {
    if (is_open()) close(number_);
  }

  bool is_open() const {
    struct stat state{};
    return number_ >= 0 && fstat(number_, &state) == 0 && is_same(state, identity_);
  }

  // Returns whether that path still names this file, and it has at least so many bytes.
  bool is_at(const std::string & path, off_t bytes) const {
    struct stat state{};
    return stat(path.c_str(), &state) == 0 && is_same(state, identity_) && state.st_size >= bytes;
  }

  const struct stat & identity() const { return identity_; }

  int number() const { return number_; }

private:
  static bool is_same(const struct stat & left, const struct stat & right) {
    return left.st_dev == right.st_dev && left.st_ino == right.st_ino;
  }

  int number_{-1};
  struct stat identity_{};
};

}  // namespace chainshaper
