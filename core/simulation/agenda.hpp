// The agenda of the simulation: what will happen, in order of time.

#pragma once

#include <cstdint>
#include <queue>
#include <variant>
#include <vector>

#include "simulation/messages.hpp"

namespace chainshaper::simulation {

struct Thread;

// A timer expires.
struct Expiry {
  Entity * timer;
};
// A message reaches its reader's process.
struct Delivery {
  Message * message;
};
// A sleep of a thread is over.
struct SleepOver {
  Thread * thread;
};
using Happening = std::variant<Expiry, Delivery, SleepOver>;

// Gives happenings in order of time; those of the same time in the order in which they were
// planned.
class Agenda {
public:
  void plan(Nanoseconds time, Happening happening) { coming_.push({time, planned_++, happening}); }

  Nanoseconds next_time() const { return coming_.empty() ? forever : coming_.top().time; }

  // Takes the earliest happening; the agenda must not be empty.
  Happening take_next() {
    const Happening happening = coming_.top().happening;
    coming_.pop();
    return happening;
  }

private:
  struct Planned {
    Nanoseconds time;
    std::uint64_t number;
    Happening happening;
  };

  struct Later {
    bool operator()(const Planned & left, const Planned & right) const {
      return left.time != right.time ? left.time > right.time : left.number > right.number;
    }
  };

  std::priority_queue<Planned, std::vector<Planned>, Later> coming_;
  std::uint64_t planned_{0};
};

}  // namespace chainshaper::simulation
