#include "ctf/sorting.hpp"

#include <algorithm>
#include <limits>
#include <memory>
#include <stdexcept>
#include <vector>

namespace chainshaper::ctf {
namespace {

using Times = std::span<const std::int64_t>;
using RowNumber = std::uint32_t;
using Order = std::span<RowNumber>;

// Rows that are merged together, so that their stamps stay in the processor's cache.
constexpr std::size_t block_rows = 8192;

// What is merged: the time beside its row, so that a comparison waits for one load only.
struct Stamp {
  std::int64_t time_ns;
  RowNumber row;
};

// Memory that sorting works in. A thread keeps it from table to table, for as long as it lives: to
// get it from the kernel anew, which zeroes it, would cost as much as a third of the sorting.
struct Room {
  std::size_t rows{0};
  std::unique_ptr<RowNumber[]> order;
  std::unique_ptr<std::uint8_t[]> values;  // 8 bytes a row
  std::vector<Stamp> stamps;               // of a block
  std::vector<Stamp> merged;

  void make_for(std::size_t needed) {
    if (needed <= rows) return;
    order = std::make_unique_for_overwrite<RowNumber[]>(needed);
    values = std::make_unique_for_overwrite<std::uint8_t[]>(8 * needed);
    rows = needed;
  }

  void make_for_block(std::size_t needed) {
    if (needed <= stamps.size()) return;
    stamps.resize(std::max(needed, 2 * block_rows));
    merged.resize(stamps.size());
  }
};

// Where runs of ascending times begin, and where the last one ends.
std::vector<std::size_t> run_bounds(Times times) {
  std::vector<std::size_t> bounds{0};
  for (std::size_t row = 1; row < times.size(); ++row)
    if (times[row] < times[row - 1]) bounds.push_back(row);
  bounds.push_back(times.size());
  return bounds;
}

// Times that cut a table into blocks: a block's are less than its own, and not less than the one
// before. They are times of the longest run. Each block looks at all runs, so short runs, as in a
// damaged file, have few blocks.
std::vector<std::int64_t> block_ends(Times times, std::span<const std::size_t> bounds) {
  const auto runs = bounds.size() - 1;
  std::size_t longest = 0;
  for (std::size_t run = 1; run < runs; ++run)
    if (bounds[run + 1] - bounds[run] > bounds[longest + 1] - bounds[longest]) longest = run;
  const auto run = times.subspan(bounds[longest], bounds[longest + 1] - bounds[longest]);
  const auto blocks = std::min({times.size() / block_rows, times.size() / (16 * runs), run.size()});
  std::vector<std::int64_t> ends;
  for (std::size_t block = 1; block < blocks; ++block)
    ends.push_back(run[block * run.size() / blocks]);
  return ends;
}

// Merges two runs of stamps that follow each other, `left` and from `middle` to `end`; of equal
// times the left one's come first. It goes on from both ends at once: each step waits for the one
// before, so that a processor does two of them in the time of one. Which side is next cannot be
// guessed: without a branch, none is guessed wrongly.
void merge(const Stamp * left, const Stamp * middle, const Stamp * end, Stamp * to) {
  const auto * right = middle;
  const auto * last_left = middle - 1;
  const auto * last_right = end - 1;
  std::ptrdiff_t first = 0, behind_last = end - left;  // of `to`, what is not filled yet
  // So many steps from either end cannot come to the end of a run.
  for (auto steps = std::min(middle - left, end - middle); steps > 0; --steps) {
    const bool takes_right = right->time_ns < left->time_ns;
    to[first++] = takes_right ? *right : *left;
    right += static_cast<std::ptrdiff_t>(takes_right);
    left += static_cast<std::ptrdiff_t>(!takes_right);
    const bool takes_left = last_right->time_ns < last_left->time_ns;
    to[--behind_last] = takes_left ? *last_left : *last_right;
    last_left -= static_cast<std::ptrdiff_t>(takes_left);
    last_right -= static_cast<std::ptrdiff_t>(!takes_left);
  }
  while (left <= last_left && right <= last_right)
    to[first++] = right->time_ns < left->time_ns ? *right++ : *left++;
  std::copy(right, last_right + 1, std::copy(left, last_left + 1, to + first));
}

// Merges runs of stamps, two by two, until there is one; `bounds` are where they begin and end.
void merge_runs(std::vector<Stamp> & stamps, std::vector<Stamp> & merged,
                std::vector<std::size_t> bounds) {
  while (bounds.size() > 2) {
    std::vector<std::size_t> fewer{0};
    for (std::size_t run = 0; run + 1 < bounds.size(); run += 2) {
      const auto left = bounds[run], middle = bounds[run + 1];
      const auto end = run + 2 < bounds.size() ? bounds[run + 2] : middle;
      const auto * from = stamps.data();
      merge(from + left, from + middle, from + end, merged.data() + left);
      fewer.push_back(end);
    }
    std::swap(stamps, merged);
    bounds = std::move(fewer);
  }
}

// Puts rows in order of time, in the room: their numbers, and their times as its values.
void merge_blocks(Times times, std::span<const std::size_t> run_bounds, Room & room) {
  const auto last_times = block_ends(times, run_bounds);
  std::vector<std::size_t> next(run_bounds.begin(), run_bounds.end() - 1);  // row of each run
  std::size_t done = 0;                                                     // rows
  for (std::size_t block = 0; block <= last_times.size(); ++block) {
    std::vector<std::size_t> bounds{0};  // of runs in the block
    for (std::size_t run = 0; run < next.size(); ++run) {
      const auto first = times.begin() + static_cast<std::ptrdiff_t>(next[run]);
      const auto run_end = times.begin() + static_cast<std::ptrdiff_t>(run_bounds[run + 1]);
      const auto end =
          block < last_times.size() ? std::lower_bound(first, run_end, last_times[block]) : run_end;
      if (first == end) continue;
      const auto count = static_cast<std::size_t>(end - first);
      room.make_for_block(bounds.back() + count);
      auto * stamps = room.stamps.data() + bounds.back();
      for (std::size_t index = 0; index < count; ++index)
        stamps[index] = {first[static_cast<std::ptrdiff_t>(index)],
                         static_cast<RowNumber>(next[run] + index)};
      next[run] += count;
      bounds.push_back(bounds.back() + count);
    }
    const auto count = bounds.back();
    merge_runs(room.stamps, room.merged, std::move(bounds));
    auto * order = room.order.get() + done;
    auto * values = room.values.get() + 8 * done;
    for (std::size_t index = 0; index < count; ++index) {
      order[index] = room.stamps[index].row;
      std::memcpy(values + 8 * index, &room.stamps[index].time_ns, 8);
    }
    done += count;
  }
}

template <typename Value>
void reorder(std::uint8_t * values, Order order, std::uint8_t * room) {
  constexpr auto width = sizeof(Value);
  for (std::size_t row = 0; row < order.size(); ++row)
    std::memcpy(room + row * width, values + order[row] * width, width);
  std::memcpy(values, room, order.size() * width);
}

}  // namespace

void sort_by_time(const TableColumns & table) {
  const auto rows = table.times_ns.size();
  if (rows > std::numeric_limits<std::uint32_t>::max())
    throw std::invalid_argument("a table has at most 2^32 - 1 rows");
  for (const Column & column : table.columns)
    if (column.rows != rows) throw std::invalid_argument("columns of different lengths");
  const auto bounds = run_bounds(table.times_ns);
  if (bounds.size() == 2) return;
  thread_local Room room_of_thread;
  room_of_thread.make_for(rows);
  merge_blocks(table.times_ns, bounds, room_of_thread);
  const Order order(room_of_thread.order.get(), rows);
  auto * const room = room_of_thread.values.get();  // of one column after the other
  std::memcpy(table.times_ns.data(), room, rows * sizeof(std::int64_t));
  if (table.cpus.size() == rows)
    reorder<std::uint32_t>(reinterpret_cast<std::uint8_t *>(table.cpus.data()), order, room);
  for (const Column & column : table.columns) {
    switch (column.width) {
      case 8:
        reorder<std::uint64_t>(column.values, order, room);
        break;
      case 4:
        reorder<std::uint32_t>(column.values, order, room);
        break;
      case 2:
        reorder<std::uint16_t>(column.values, order, room);
        break;
      default:
        reorder<std::uint8_t>(column.values, order, room);
        break;
    }
  }
}

}  // namespace chainshaper::ctf
