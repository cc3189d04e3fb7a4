// A core that is kept clear of other work while an output is delivered there.
//
// DDS threads that receive outrank everything else on their core, but that does not help them at
// once: unless the kernel is fully preemptible, an ordinary thread that is inside a system call
// goes on until it is through with it, and a core that idles has to wake up first. So a thread of
// the lowest real-time priority watches the clock there, from somewhat before a release until the
// output is delivered. Ordinary threads do not run meanwhile, and receiving ones preempt it within
// microseconds.

#ifndef CHAINSHAPER_SHAPING__KEPT_CORE_HPP_
#define CHAINSHAPER_SHAPING__KEPT_CORE_HPP_

#include <pthread.h>
#include <sched.h>
#include <semaphore.h>

#include <atomic>
#include <cstdint>
#include <optional>
#include <thread>

#include "shaper.hpp"

namespace chainshaper
{

// Where SCHED_FIFO or the core is refused, nothing is kept.
class KeptCore
{
public:
  explicit KeptCore(std::size_t core)
  {
    sem_init(&told_, 0, 0);
    keeper_ = std::thread([this, core] {keep(core);});
  }

  KeptCore(const KeptCore &) = delete;
  KeptCore & operator=(const KeptCore &) = delete;

  ~KeptCore()
  {
    keep_until(over);
    keeper_.join();
    sem_destroy(&told_);
  }

  // Keep the core from now until that time of CLOCK_MONOTONIC.
  void keep_until(std::int64_t time_ns)
  {
    until_ns_ = time_ns;
    sem_post(&told_);
  }

private:
  static constexpr std::int64_t over = -1;

  void keep(std::size_t core)
  {
    pthread_setname_np(pthread_self(), "keeper");
    sched_param lowest{};
    lowest.sched_priority = 1;
    cpu_set_t cores;
    CPU_ZERO(&cores);
    CPU_SET(core, &cores);
    if (sched_setscheduler(0, SCHED_FIFO | SCHED_RESET_ON_FORK, &lowest) != 0 ||
      sched_setaffinity(0, sizeof(cores), &cores) != 0)
    {
      return;
    }
    for (;;) {
      while (sem_wait(&told_) != 0) {
        // A signal ended the wait early.
      }
      if (until_ns_ == over) {
        return;
      }
      watch_until(until_ns_);
    }
  }

  sem_t told_;
  std::atomic<std::int64_t> until_ns_{0};
  std::thread keeper_;
};

}  // namespace chainshaper

#endif  // CHAINSHAPER_SHAPING__KEPT_CORE_HPP_
