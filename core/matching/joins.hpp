// Matching rows of two tables by key and time. chainshaper/analysis/matching.py uses it.

#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "matching/keys.hpp"

namespace chainshaper::matching {

// The number of a row that matches nothing.
inline constexpr std::uint32_t no_row = 0xFFFFFFFF;

// A table whose rows are sorted by time. Has fewer rows than `no_row`.
struct Events {
  Keys keys;
  std::span<const std::int64_t> times_ns;
};

enum class Direction { latest_before, first_after };

// Returns, for each row of `left`, a row of `right` with the same key: the latest row at or before
// its time (of equal times the last), or the first row at or after it (of equal times the first).
// With `strictly`, rows at exactly that time are left out.
std::vector<std::uint32_t> nearest_rows(const Events & left, const Events & right,
                                        Direction direction, bool strictly);

// Returns, for each start, its end: the next event of the same key, if that is an end.
//
// Where a start and an end of a key have the same time, the end comes first if an instance was open
// before (it ends, and the next one begins), else the start (an instance that takes no time).
std::vector<std::uint32_t> ends_of_starts(const Events & starts, const Events & ends);

}  // namespace chainshaper::matching
