// Exact placement of latency bands (paper, section 4.1, eq. 5): the step of the dynamic programme
// that adds one band. chainshaper/planning/bands.py has the equations, the constraints and the
// proof.

#pragma once

#include <cstddef>
#include <cstdint>
#include <limits>
#include <span>

namespace chainshaper::bands {

// The cost where no placement is allowed.
inline constexpr std::int64_t unreachable = std::numeric_limits<std::int64_t>::max();

// The places that a band's end may have. All spans have one entry for each place, ascending.
struct Grid {
  std::span<const std::int64_t> ends_ns;   // when a band at this place ends, after the anchor
  std::span<const std::int64_t> counts;    // how many latencies are not longer than that
  std::span<const std::int64_t> nearest;   // the next band's first place that is allowed
  std::span<const std::int64_t> farthest;  // the next band's last place that is allowed
};

// For each place, the best bands behind it, of which there is a given number.
struct Layer {
  std::span<std::int64_t> costs;       // the least sum of eq. 5 over these bands (ns)
  std::span<std::int32_t> successors;  // the place of the next band; unchanged if none is allowed
};

// Adds one band: for each place i the least cost over the next band's places j,
//
//     (counts[j] − counts[i]) · ends_ns[j] + behind[j],   nearest[i] ≤ j ≤ farthest[i],
//
// over all j for which behind[j] is not `unreachable`. Takes time linear in the number of places.
void add_band(const Grid & grid, std::span<const std::int64_t> behind, Layer layer);

}  // namespace chainshaper::bands
