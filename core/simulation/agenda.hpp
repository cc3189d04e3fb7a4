// What is going to happen, in the order in which it will.

#pragma once

#include <cstdint>
#include <queue>
#include <variant>
#include <vector>

#include "simulation/messages.hpp"

namespace chainshaper::simulation {

struct Thread;

// A timer expires, a message reaches its reader's process, or a sleep is over.
struct Expiry {
  Entity * timer;
};
struct Delivery {
  Message * message;
};
struct SleepOver {
  Thread * thread;
};
using Happening = std::variant<Expiry, Delivery, SleepOver>;

// Of what happens at the same time, the first that was planned comes first.
class Agenda {
public:
  void plan(Nanoseconds time, Happening what) { coming_.push({time, planned_++, what}); }

  Nanoseconds next_time() const { return coming_.empty() ? forever : coming_.top().time; }

  // Only where `next_time` is not forever.
  Happening take_next() {
    const Happening what = coming_.top().what;
    coming_.pop();
    return what;
  }

private:
  struct Planned {
    Nanoseconds time;
    std::uint64_t number;
    Happening what;
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
