#include "matching/joins.hpp"

#include <algorithm>

namespace chainshaper::matching {
namespace {

// The state of a key while the walk goes over starts and ends in order of time.
struct Instance {
  std::uint32_t start{no_row};  // the latest start, as long as it has no end
  std::uint32_t depth{0};       // how many starts have no end yet
  std::int64_t seen_ns{0};      // the time of the key's latest event
  bool seen{false};             // whether the key had an event
  bool was_open{false};         // whether an instance was open before that time
};

class PairWalk {
public:
  PairWalk(const Events & starts, const Events & ends)
      : starts_(starts), ends_(ends), rows_(starts.times_ns.size(), no_row) {}

  std::vector<std::uint32_t> run() {
    std::size_t start = 0, end = 0;
    while (start < starts_.times_ns.size() || end < ends_.times_ns.size()) {
      const auto now_ns = earlier(start, end);
      const auto next_start = behind(starts_.times_ns, start, now_ns);
      const auto next_end = behind(ends_.times_ns, end, now_ns);
      if (start == next_start) {
        for (auto row = end; row < next_end; ++row)
          close(instance_of(ends_.keys, row, now_ns), row);
      } else {
        // First ends of instances that were open before this time, then starts, then other ends.
        close(end, next_end, now_ns, true);
        for (auto row = start; row < next_start; ++row) open(row, now_ns);
        close(end, next_end, now_ns, false);
      }
      start = next_start;
      end = next_end;
    }
    return std::move(rows_);
  }

private:
  // Returns the time of the next event, be it a start or an end.
  std::int64_t earlier(std::size_t start, std::size_t end) const {
    if (start == starts_.times_ns.size()) return ends_.times_ns[end];
    if (end == ends_.times_ns.size()) return starts_.times_ns[start];
    return std::min(starts_.times_ns[start], ends_.times_ns[end]);
  }

  // Returns the first row, from `row` on, whose time is not `now_ns`.
  static std::size_t behind(std::span<const std::int64_t> times_ns, std::size_t row,
                            std::int64_t now_ns) {
    while (row < times_ns.size() && times_ns[row] == now_ns) ++row;
    return row;
  }

  Instance & instance_of(const Keys & keys, std::size_t row, std::int64_t now_ns) {
    Instance & instance = instances_[keys.at(row)];
    if (!instance.seen || instance.seen_ns != now_ns) {
      instance.seen = true;
      instance.seen_ns = now_ns;
      instance.was_open = instance.depth > 0;
    }
    return instance;
  }

  void open(std::size_t row, std::int64_t now_ns) {
    Instance & instance = instance_of(starts_.keys, row, now_ns);
    instance.start = static_cast<std::uint32_t>(row);
    ++instance.depth;
  }

  // Ends instances of rows [row, behind_last): only those that were open before this time, or only
  // the others.
  void close(std::size_t row, std::size_t behind_last, std::int64_t now_ns, bool open_before) {
    for (; row < behind_last; ++row) {
      Instance & instance = instance_of(ends_.keys, row, now_ns);
      if (instance.was_open == open_before) close(instance, row);
    }
  }

  void close(Instance & instance, std::size_t row) {
    if (instance.start != no_row) rows_[instance.start] = static_cast<std::uint32_t>(row);
    instance.start = no_row;
    if (instance.depth > 0) --instance.depth;  // 0: the start was not recorded
  }

  const Events & starts_;
  const Events & ends_;
  std::vector<std::uint32_t> rows_;
  KeyTable<Instance> instances_;
};

}  // namespace

std::vector<std::uint32_t> nearest_rows(const Events & left, const Events & right,
                                        Direction direction, bool strictly) {
  const auto lefts = left.times_ns.size(), rights = right.times_ns.size();
  const bool forward = direction == Direction::latest_before;
  std::vector<std::uint32_t> rows(lefts, no_row);
  KeyTable<std::uint32_t> latest;  // by key, the row of `right` that was passed last
  std::size_t passed = 0;          // how many rows of `right`, from its beginning or its end
  for (std::size_t step = 0; step < lefts; ++step) {
    const auto row = forward ? step : lefts - 1 - step;
    const auto now_ns = left.times_ns[row];
    for (; passed < rights; ++passed) {
      const auto candidate = forward ? passed : rights - 1 - passed;
      const auto then_ns = right.times_ns[candidate];
      const bool beyond = forward ? then_ns > now_ns : then_ns < now_ns;
      if (beyond || (strictly && then_ns == now_ns)) break;
      latest[right.keys.at(candidate)] = static_cast<std::uint32_t>(candidate);
    }
    if (const auto * match = latest.find(left.keys.at(row))) rows[row] = *match;
  }
  return rows;
}

std::vector<std::uint32_t> ends_of_starts(const Events & starts, const Events & ends) {
  return PairWalk(starts, ends).run();
}

}  // namespace chainshaper::matching
