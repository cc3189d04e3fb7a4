#include <nanobind/stl/tuple.h>

#include <cmath>
#include <stdexcept>
#include <tuple>

#include "bindings/arrays.hpp"
#include "control/propagation.hpp"

namespace chainshaper::bindings {
namespace {

using Numbers = Array<const double>;
constexpr std::size_t largest_part = 64;  // more states, inputs or slots are no loop of ours

auto propagate(std::tuple<std::size_t, std::size_t, std::size_t, std::size_t> sizes,
               double longest_s, Numbers flows, Numbers rows, Numbers noise, Numbers waits_s,
               Array<const std::int32_t> slots, Numbers covariance) {
  const auto [inputs, plant, controller, outputs_waiting] = sizes;
  for (const std::size_t part : {inputs, plant, controller, outputs_waiting})
    if (part > largest_part) throw std::invalid_argument("a part of the state is too large");
  const control::Sizes state{inputs, plant, controller, outputs_waiting};
  const std::size_t computed = controller + inputs;
  const std::size_t whole = 4 * state.values();
  if (inputs == 0 || outputs_waiting == 0 || !(longest_s > 0) || flows.size() == 0 ||
      flows.size() % whole != 0)
    throw std::invalid_argument("flows have no interval, or the state no input");
  check_length("rows", rows.size(), computed * (plant + controller));
  check_length("noise", noise.size(), computed * computed);
  check_length("slots", slots.size(), waits_s.size());
  check_length("covariance", covariance.size(), state.state() * state.state());
  auto result = without_lock([&] {
    for (const double wait_s : span_of(waits_s))
      if (!(wait_s >= 0) || wait_s > longest_s * 1e9)
        throw std::invalid_argument("events are in the order of time");
    for (const std::int32_t slot : span_of(slots))
      if (slot != control::nothing &&
          static_cast<std::size_t>(slot < 0 ? ~slot : slot) >= outputs_waiting)
        throw std::invalid_argument("a slot is not in the state");
    return control::propagate(state, {longest_s, flows.size() / whole, span_of(flows)},
                              {span_of(rows), span_of(noise)}, span_of(waits_s), span_of(slots),
                              span_of(covariance));
  });
  return std::tuple(array_of(std::move(result.costs)), array_of(std::move(result.durations)),
                    array_of(std::move(result.covariance)));
}

}  // namespace

void bind_control(nb::module_ & module) {
  module.attr("NO_EVENT") = control::nothing;
  module.def("propagate_covariance", &propagate, nb::kw_only(), nb::arg("sizes"),
             nb::arg("longest_s"), nb::arg("flows"), nb::arg("rows"), nb::arg("noise"),
             nb::arg("waits_s"), nb::arg("slots"), nb::arg("covariance"),
             "Carry the covariance of a control loop over events.\n\n"
             "See `chainshaper.control.costs`. Returns the cost and the duration (s) from each\n"
             "sample to the next, and the covariance behind the last event. Raises ValueError for\n"
             "arrays of wrong lengths, and for events that do not follow each other.");
}

}  // namespace chainshaper::bindings
