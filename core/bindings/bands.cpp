#include <algorithm>
#include <stdexcept>

#include "bands/placement.hpp"
#include "bindings/arrays.hpp"

namespace chainshaper::bindings {
namespace {

using Numbers = Array<const std::int64_t>;

// Windows come from Python: a wrong one must be an error, not an access to other memory.
void check_windows(const bands::Grid & grid) {
  const auto places = static_cast<std::int64_t>(grid.ends_ns.size());
  const bool ascend = std::is_sorted(grid.nearest.begin(), grid.nearest.end()) &&
                      std::is_sorted(grid.farthest.begin(), grid.farthest.end());
  const bool inside =
      grid.nearest.empty() ||
      (grid.nearest.front() >= 0 && grid.farthest.back() < places && grid.farthest.front() >= -1);
  if (!ascend || !inside) throw std::invalid_argument("windows of places ascend, in the grid");
  for (std::size_t place = 1; place < grid.ends_ns.size(); ++place)
    if (grid.ends_ns[place - 1] >= grid.ends_ns[place] ||
        grid.counts[place - 1] > grid.counts[place])
      throw std::invalid_argument("places of bands and counts of latencies ascend");
}

void add_band(Numbers ends_ns, Numbers counts, Numbers nearest, Numbers farthest, Numbers behind,
              Array<std::int64_t> costs, Array<std::int32_t> successors) {
  const bands::Grid grid{span_of(ends_ns), span_of(counts), span_of(nearest), span_of(farthest)};
  const auto places = ends_ns.size();
  check_length("counts", counts.size(), places);
  check_length("nearest", nearest.size(), places);
  check_length("farthest", farthest.size(), places);
  check_length("behind", behind.size(), places);
  check_length("costs", costs.size(), places);
  check_length("successors", successors.size(), places);
  const nb::gil_scoped_release released;
  check_windows(grid);
  bands::add_band(grid, span_of(behind), {span_of(costs), span_of(successors)});
}

}  // namespace

void bind_bands(nb::module_ & module) {
  module.attr("UNREACHABLE") = bands::unreachable;
  module.def(
      "add_band", &add_band, nb::kw_only(), nb::arg("ends_ns"), nb::arg("counts"),
      nb::arg("nearest"), nb::arg("farthest"), nb::arg("behind"), nb::arg("costs"),
      nb::arg("successors"),
      "Add one band to a placement: fill `costs` and `successors` for every place.\n\n"
      "See `chainshaper.planning.bands`. Raises ValueError for arrays of different lengths,\n"
      "and for places or windows that do not ascend.");
}

}  // namespace chainshaper::bindings
