#include "ctf/sorting.hpp"

#include <algorithm>
#include <limits>
#include <memory>
#include <numeric>
#include <stdexcept>

namespace chainshaper::ctf {
namespace {

using Times = std::span<const std::int64_t>;
using RowNumber = std::uint32_t;
using Order = std::span<RowNumber>;

// Memory that sorting works in. A thread keeps it from table to table, for as long as it lives: to
// get it from the kernel anew, which zeroes it, would cost as much as a third of the sorting.
struct Room {
  std::size_t rows{0};
  std::unique_ptr<RowNumber[]> order;
  std::unique_ptr<RowNumber[]> merged;
  std::unique_ptr<std::uint8_t[]> values;  // 8 bytes a row

  void make_for(std::size_t needed) {
    if (needed <= rows) return;
    order = std::make_unique_for_overwrite<RowNumber[]>(needed);
    merged = std::make_unique_for_overwrite<RowNumber[]>(needed);
    values = std::make_unique_for_overwrite<std::uint8_t[]>(8 * needed);
    rows = needed;
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

// Merges two runs of rows that follow each other; of equal times the left one's come first.
void merge(Times times, Order from, Order to, std::size_t left, std::size_t middle,
           std::size_t end) {
  auto right = middle, place = left;
  while (left < middle && right < end) {
    // Which side is next cannot be guessed: without a branch, none is guessed wrongly.
    const auto row_left = from[left], row_right = from[right];
    const bool takes_right = times[row_right] < times[row_left];
    to[place++] = takes_right ? row_right : row_left;
    right += static_cast<std::size_t>(takes_right);
    left += static_cast<std::size_t>(!takes_right);
  }
  while (left < middle) to[place++] = from[left++];
  while (right < end) to[place++] = from[right++];
}

// The rows in order of time; it is somewhere in the room.
Order order_of(Times times, std::vector<std::size_t> bounds, const Room & room) {
  Order order(room.order.get(), times.size()), merged(room.merged.get(), times.size());
  std::iota(order.begin(), order.end(), 0U);
  while (bounds.size() > 2) {
    std::vector<std::size_t> fewer{0};
    for (std::size_t run = 0; run + 1 < bounds.size(); run += 2) {
      const auto middle = bounds[run + 1];
      const auto end = run + 2 < bounds.size() ? bounds[run + 2] : middle;
      merge(times, order, merged, bounds[run], middle, end);
      fewer.push_back(end);
    }
    std::swap(order, merged);
    bounds = std::move(fewer);
  }
  return order;
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
  auto bounds = run_bounds(table.times_ns);
  if (bounds.size() == 2) return;
  thread_local Room room_of_thread;
  room_of_thread.make_for(rows);
  const auto order = order_of(table.times_ns, std::move(bounds), room_of_thread);
  auto * const room = room_of_thread.values.get();  // of one column after the other
  reorder<std::uint64_t>(reinterpret_cast<std::uint8_t *>(table.times_ns.data()), order, room);
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
