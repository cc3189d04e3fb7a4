// The covariance of a control loop, carried from event to event: exact, nothing is drawn.
//
// The state is s = [applied; x; controller; slot 0 … slot m]: the input that is applied, the
// plant's state, the controller's, and outputs of the controller that have not arrived yet, one a
// slot. Between events x follows the plant's differential equation under the applied input and
// white noise. When the plant is sampled, the controller computes an output into a slot; when that
// arrives, it becomes the applied input. P = cov(s) is symmetric, and each event replaces some of
// its rows and columns.

#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace chainshaper::control {

// How many entries each part of the state has, and how many slots there are.
struct Sizes {
  std::size_t inputs, plant, controller, slots;
  [[nodiscard]] std::size_t applied() const { return inputs; }
  [[nodiscard]] std::size_t flowing() const { return inputs + plant; }
  [[nodiscard]] std::size_t state() const { return inputs * (1 + slots) + plant + controller; }
  // Of the flow over one duration: [gain, transition] of the plant's rows, the noise that they
  // gain, the cost of [applied; x], and the cost of the noise. Symmetric ones are whole.
  [[nodiscard]] std::size_t values() const {
    return plant * flowing() + plant * plant + flowing() * flowing() + 1;
  }
};

// What happens over durations from 0 to `longest_s`: for each of equal intervals a polynomial of
// degree three, its four coefficients one behind the other, each with all Sizes::values().
struct Flows {
  double longest_s;
  std::size_t intervals;
  std::span<const double> coefficients;
};

// What the controller does when the plant is sampled: its state's rows, then its output's, over
// [x; controller]; and the covariance that the noise of the measurement gives these rows.
struct Sampling {
  std::span<const double> rows;
  std::span<const double> noise;
};

struct Propagated {
  std::vector<double> costs;       // from each sample to the next; of the last until the last event
  std::vector<double> durations;   // s, of the same
  std::vector<double> covariance;  // of the state behind the last event
};

// Carries a covariance over events: `waits_s` before each, `slots` of each: ~slot for a sample that
// computes into it, slot for an output that arrives from it, and `nothing` where time passes only.
constexpr std::int32_t nothing = 1 << 30;
Propagated propagate(const Sizes & sizes, const Flows & flows, const Sampling & sampling,
                     std::span<const double> waits_s, std::span<const std::int32_t> slots,
                     std::span<const double> covariance);

}  // namespace chainshaper::control
