// Matching rows to rows by key and time. chainshaper/analysis/matching.py says what for.

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

// For each row of `left` the row of `right` with the same key that is the latest one at or before
// it (of equal times the last), or the first one at or after it (of equal times the first).
// `strictly` leaves out rows at the very time of the left one.
std::vector<std::uint32_t> nearest_rows(const Events & left, const Events & right,
                                        Direction direction, bool strictly);

// For each start the end of the same key that is the next event of that key.
//
// An instance may begin in the nanosecond in which the one before ended (end first), or last no
// time at all (start first): the former when one was open before that moment.
std::vector<std::uint32_t> ends_of_starts(const Events & starts, const Events & ends);

}  // namespace chainshaper::matching
