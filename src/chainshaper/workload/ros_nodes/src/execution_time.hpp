// CPU time of the instances of a callback: drawn as described, and spent.
#pragma once

#include <cstddef>
#include <cstdint>
#include <ctime>
#include <random>
#include <utility>
#include <vector>

enum class Distribution { constant, uniform, normal, samples, sequence };

struct Execution {
  Distribution distribution;
  std::vector<std::int64_t> values;  // (ns) of a normal one: mean, deviation, low, high
  std::size_t block;                 // samples are drawn in stretches of so many
};

// Seed, node and callback determine the sequence; of stretches of samples the seed alone, so that
// callbacks that were measured together draw together.
class ExecutionTimes {
public:
  ExecutionTimes(Execution execution, std::uint64_t seed, std::uint32_t node,
                 std::uint32_t callback)
      : execution_{std::move(execution)} {
    const auto low = static_cast<std::uint32_t>(seed),
               high = static_cast<std::uint32_t>(seed >> 32);
    std::seed_seq together{low, high}, own{low, high, node, callback};
    random_.seed(execution_.block > 1 ? together : own);
  }

  std::int64_t next() {
    const auto & values = execution_.values;
    if (values.empty()) return 0;
    switch (execution_.distribution) {
      case Distribution::uniform:
        return std::uniform_int_distribution<std::int64_t>{values[0], values[1]}(random_);
      case Distribution::normal:
        while (true) {  // what is outside of the limits is drawn again
          std::normal_distribution<double> normal(values[0], values[1]);
          const double drawn = normal(random_);
          if (values[2] <= drawn && drawn <= values[3]) return static_cast<std::int64_t>(drawn);
        }
      case Distribution::samples:
        if (drawn_++ % execution_.block == 0)
          place_ = std::uniform_int_distribution<std::size_t>{0, values.size() - 1}(random_);
        return values[place_++ % values.size()];
      case Distribution::sequence:
        return values[place_++ % values.size()];
      default:
        return values[0];
    }
  }

private:
  Execution execution_;
  std::mt19937_64 random_;
  std::size_t drawn_{0}, place_{0};
};

inline std::int64_t clock_ns(clockid_t clock) {
  timespec now;
  clock_gettime(clock, &now);
  return now.tv_sec * std::int64_t{1'000'000'000} + now.tv_nsec;
}

// Compute until this thread has used `cpu_ns` since its CPU clock showed `since_ns`.
inline void spend(std::int64_t cpu_ns, std::int64_t since_ns) {
  while (clock_ns(CLOCK_THREAD_CPUTIME_ID) < since_ns + cpu_ns) {
  }
}
