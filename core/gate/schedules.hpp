// What changes a gate while it runs: from some cycle on, another schedule holds.
// chainshaper/robot/schedules.py is the same in Python, and explains it.

#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <iterator>
#include <optional>

#include "gate/gate.hpp"

namespace chainshaper {

// What holds at a gate in cycles that start at `from_ns` or later.
struct Schedule {
  std::int64_t from_ns{0};
  std::int64_t phase_ns{0};         // where a cycle starts, for messages whose stamp is of no use
  std::int64_t moved_ns{0};         // by how much the slots are moved from where the gate has them
  std::optional<std::size_t> mode;  // none: the gate's first
};

// The schedules of a gate, in the order of their beginnings; never empty.
class Schedules {
public:
  explicit Schedules(const Gate & gate) : Schedules(Schedule{0, gate.phase_ns, 0, std::nullopt}) {
    if (!gate.modes.empty()) remembered_.front().mode = gate.first_mode;
  }

  explicit Schedules(const Schedule & first) : remembered_{first} {}

  // Returns the schedule of the cycle that starts at this time. The first one that is remembered
  // holds in all cycles before it, too.
  const Schedule & in_force(std::int64_t start_ns) const {
    const auto begun = std::find_if(remembered_.rbegin(), remembered_.rend(),
                                    [=](const auto & each) { return each.from_ns <= start_ns; });
    return begun == remembered_.rend() ? remembered_.front() : *begun;
  }

  // Changes one thing from some cycle on: in the schedule that begins with it, and in those that
  // begin later, because they were announced ahead.
  template <typename Field, typename Value>
  void change(std::int64_t from_ns, Field Schedule::* changed, Value value) {
    const auto later = std::upper_bound(
        remembered_.begin(), remembered_.end(), from_ns,
        [](std::int64_t time, const Schedule & each) { return time < each.from_ns; });
    const auto in_force = later == remembered_.begin() ? later : std::prev(later);
    if (std::all_of(in_force, remembered_.end(),
                    [&](const Schedule & each) { return each.*changed == value; }))
      return;
    Schedule since = *in_force;
    since.from_ns = from_ns;
    for (auto each = remembered_.insert(later, since); each != remembered_.end(); ++each)
      (*each).*changed = value;
    if (remembered_.size() > static_cast<std::size_t>(schema::schedules)) remembered_.pop_front();
  }

  // Notes the phase that a good stamp shows. The schedule that is in force at the message's arrival
  // gets it, and with it those later ones that took their phase over from that one.
  void see_phase(std::int64_t phase_ns, std::int64_t arrival_ns) {
    const std::int64_t before_ns = in_force(arrival_ns).phase_ns;
    if (phase_ns == before_ns) return;
    bool reached = false;
    const Schedule * const first = &in_force(arrival_ns);
    for (Schedule & each : remembered_) {
      reached = reached || &each == first;
      if (reached && each.phase_ns == before_ns) each.phase_ns = phase_ns;
    }
  }

private:
  std::deque<Schedule> remembered_;
};

}  // namespace chainshaper
