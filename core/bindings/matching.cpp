#include <nanobind/stl/vector.h>

#include <stdexcept>

#include "bindings/arrays.hpp"
#include "matching/joins.hpp"

namespace chainshaper::bindings {
namespace {

using AnyArray = nb::ndarray<nb::ro, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Times = Array<const std::int64_t>;

template <typename Number>
bool add_if(matching::Keys & keys, const AnyArray & array) {
  if (array.dtype() != nb::dtype<Number>()) return false;
  keys.add(std::span(static_cast<const Number *>(array.data()), array.size()));
  return true;
}

void add_column(matching::Keys & keys, const AnyArray & array) {
  if (!add_if<std::int64_t>(keys, array) && !add_if<std::uint64_t>(keys, array) &&
      !add_if<std::int32_t>(keys, array) && !add_if<std::uint32_t>(keys, array))
    throw std::invalid_argument("keys are integers of 32 or 64 bits");
}

matching::Events events_of(const std::vector<AnyArray> & keys, const Times & times_ns) {
  if (keys.size() > matching::most_key_columns)
    throw std::invalid_argument("keys have three columns at most");
  if (times_ns.size() >= matching::no_row)
    throw std::invalid_argument("a table has fewer than 2^32 - 1 rows");
  matching::Events events{{}, span_of(times_ns)};
  for (const AnyArray & column : keys) {
    check_length("a column of keys", column.size(), times_ns.size());
    add_column(events.keys, column);
  }
  return events;
}

auto nearest_rows(matching::Direction direction) {
  return [direction](const std::vector<AnyArray> & left_keys, const Times & left_times_ns,
                     const std::vector<AnyArray> & right_keys, const Times & right_times_ns,
                     bool strictly) {
    const auto left = events_of(left_keys, left_times_ns);
    const auto right = events_of(right_keys, right_times_ns);
    return array_of(
        without_lock([&] { return matching::nearest_rows(left, right, direction, strictly); }));
  };
}

auto ends_of_starts(const std::vector<AnyArray> & start_keys, const Times & start_times_ns,
                    const std::vector<AnyArray> & end_keys, const Times & end_times_ns) {
  const auto starts = events_of(start_keys, start_times_ns);
  const auto ends = events_of(end_keys, end_times_ns);
  return array_of(without_lock([&] { return matching::ends_of_starts(starts, ends); }));
}

}  // namespace

void bind_matching(nb::module_ & module) {
  module.attr("NO_ROW") = matching::no_row;
  module.def("latest_before", nearest_rows(matching::Direction::latest_before), nb::kw_only(),
             nb::arg("left_keys"), nb::arg("left_times_ns"), nb::arg("right_keys"),
             nb::arg("right_times_ns"), nb::arg("strictly") = false,
             "Return, for each left row, the latest right row of its key that is not later.");
  module.def("first_after", nearest_rows(matching::Direction::first_after), nb::kw_only(),
             nb::arg("left_keys"), nb::arg("left_times_ns"), nb::arg("right_keys"),
             nb::arg("right_times_ns"), nb::arg("strictly") = false,
             "Return, for each left row, the first right row of its key that is not earlier.");
  module.def("ends_of_starts", &ends_of_starts, nb::kw_only(), nb::arg("start_keys"),
             nb::arg("start_times_ns"), nb::arg("end_keys"), nb::arg("end_times_ns"),
             "Return, for each start, the row of its end, or NO_ROW.");
}

}  // namespace chainshaper::bindings
