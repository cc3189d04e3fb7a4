#include "bands/placement.hpp"

#include <vector>

namespace chainshaper::bands {
namespace {

// If c latencies are before it, the next band at place j costs base(j) − c · ends_ns[j]. As a
// function of c that is a line; the lowest of all lines at each c is their lower envelope.
struct Line {
  std::size_t place;
  std::int64_t base_ns;
  std::int64_t takes_over;  // the signed count from which it is below the line before it
};

// The lower envelope of lines. If lines are added in order of their slopes, and counts asked for in
// order, both take constant time on average.
class Envelope {
public:
  // `direction` is 1 if slopes grow from line to line, and −1 if they fall. Counts come in the
  // opposite order, so the signed counts −direction · c always fall.
  Envelope(const Grid & grid, int direction) : grid_(grid), direction_(direction) {}

  void clear() {
    lines_.clear();
    front_ = 0;
  }

  void add(std::size_t place, std::int64_t base_ns) {
    std::int64_t takes_over = 0;
    while (lines_.size() > front_) {
      const Line & last = lines_.back();
      const auto apart_ns = direction_ * (grid_.ends_ns[place] - grid_.ends_ns[last.place]);
      takes_over = floor_divide(last.base_ns - base_ns, apart_ns);
      // The last line is nowhere the lowest if the new one is below it before it takes over.
      if (lines_.size() - 1 == front_ || takes_over < last.takes_over) break;
      lines_.pop_back();
    }
    lines_.push_back({place, base_ns, takes_over});
  }

  // Returns the lowest line at this count; nullptr: no line was added.
  const Line * lowest_at(std::int64_t count) {
    while (front_ + 1 < lines_.size() && -direction_ * count <= lines_[front_ + 1].takes_over)
      ++front_;
    return front_ < lines_.size() ? &lines_[front_] : nullptr;
  }

private:
  static std::int64_t floor_divide(std::int64_t dividend, std::int64_t divisor) {
    const auto quotient = dividend / divisor;
    const bool rounded_up = dividend % divisor != 0 && (dividend < 0) != (divisor < 0);
    return rounded_up ? quotient - 1 : quotient;
  }

  const Grid & grid_;
  int direction_;
  std::vector<Line> lines_;
  std::size_t front_{0};
};

void lower_cost(const Grid & grid, Layer layer, std::size_t place, Envelope & envelope) {
  const Line * line = envelope.lowest_at(grid.counts[place]);
  if (line == nullptr) return;
  const auto cost_ns = line->base_ns - grid.counts[place] * grid.ends_ns[line->place];
  if (cost_ns < layer.costs[place]) {
    layer.costs[place] = cost_ns;
    layer.successors[place] = static_cast<std::int32_t>(line->place);
  }
}

}  // namespace

// The windows [nearest, farthest] move up with the place: they lose lines at one end and gain lines
// at the other. From an envelope lines cannot be removed. So places are taken in blocks whose
// windows all contain one column, the pivot. To the left of the pivot, windows only grow from the
// block's last place to its first; to the right of it, from its first place to its last.
void add_band(const Grid & grid, std::span<const std::int64_t> behind, Layer layer) {
  const auto places = static_cast<std::int64_t>(grid.ends_ns.size());
  const auto index = [](std::int64_t place) { return static_cast<std::size_t>(place); };
  const auto add = [&](Envelope & envelope, std::int64_t column) {
    const auto place = index(column);
    if (behind[place] != unreachable)
      envelope.add(place, behind[place] + grid.counts[place] * grid.ends_ns[place]);
  };
  Envelope leftwards(grid, -1), rightwards(grid, 1);
  for (std::int64_t first = 0; first < places;) {
    const auto pivot = grid.farthest[index(first)];
    auto stop = first;
    while (stop < places && grid.nearest[index(stop)] <= pivot) ++stop;

    leftwards.clear();
    auto column = pivot;
    for (auto place = stop - 1; place >= first; --place) {
      for (; column >= grid.nearest[index(place)]; --column) add(leftwards, column);
      lower_cost(grid, layer, index(place), leftwards);
    }
    rightwards.clear();
    column = pivot + 1;
    for (auto place = first; place < stop; ++place) {
      for (; column <= grid.farthest[index(place)]; ++column) add(rightwards, column);
      lower_cost(grid, layer, index(place), rightwards);
    }
    first = std::max(stop, first + 1);  // at least one further: a window may be empty
  }
}

}  // namespace chainshaper::bands
