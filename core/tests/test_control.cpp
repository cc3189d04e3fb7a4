// The covariance of a scalar plant between events, by hand.

#include <cmath>
#include <vector>

#include "control/propagation.hpp"
#include "expect.hpp"

namespace {

using namespace chainshaper::control;

bool near(double value, double expected) {
  return std::abs(value - expected) < 1e-12 * (1 + std::abs(expected));
}

// dx = u·dt + dw, cost x²: over t seconds x gains t·u and the variance t, and its square costs
// t·x² + t²·x·u + t³·u²/3, and t²/2 for the noise. All are polynomials, so the table is exact.
constexpr Sizes integrator{.inputs = 1, .plant = 1, .controller = 0, .slots = 1};

std::vector<double> integrator_flows() {
  //   gain, transition, noise, cost of u², u·x, x·u, x², cost of the noise
  return {
      0, 1, 0, 0,       0,   0,   0, 0,    // constant
      1, 0, 1, 0,       0,   0,   1, 0,    // times t
      0, 0, 0, 0,       0.5, 0.5, 0, 0.5,  // times t²
      0, 0, 0, 1.0 / 3, 0,   0,   0, 0,    // times t³
  };
}

void an_integrator_that_is_left_alone() {
  const std::vector<double> flows = integrator_flows();
  const std::vector<double> rows{-0.5}, noise{0.0}, nothing_known(9, 0.0);
  const std::vector<double> waits{0.0, 1.0, 1.0};
  const std::vector<std::int32_t> slots{~0, ~0, nothing};
  const Propagated result =
      propagate(integrator, {1.0, 1, flows}, {rows, noise}, waits, slots, nothing_known);
  EXPECT(result.costs.size() == 2);
  EXPECT(near(result.costs[0], 0.5));  // ∫ t dt
  EXPECT(near(result.costs[1], 1.5));
  EXPECT(near(result.durations[1], 1.0));
  EXPECT(near(result.covariance[4], 2.0));   // [applied; x; slot]
  EXPECT(near(result.covariance[8], 0.25));  // −x/2, of the second sample
}

void an_output_that_arrives() {
  const std::vector<double> flows = integrator_flows();
  const std::vector<double> rows{-1.0}, noise{0.0};
  const std::vector<double> known{0, 0, 0, 0, 4, 0, 0, 0, 0};  // E x² = 4
  const std::vector<double> waits{0.0, 0.25, 0.75};
  const std::vector<std::int32_t> slots{~0, 0, nothing};
  const Propagated result =
      propagate(integrator, {1.0, 1, flows}, {rows, noise}, waits, slots, known);
  // x(1) = x − 0.75·x + w
  EXPECT(near(result.covariance[4], 4.0 / 16 + 1.0));
  EXPECT(near(result.covariance[0], 4.0));
  // ∫ over 0.25 s of 4 + t, then over 0.75 s of 4·(1 − t)² + 0.25 + t
  const double before = 1.0 + 0.25 * 0.25 / 2;
  const double behind = 4.0 / 3 * (1 - 0.25 * 0.25 * 0.25) + 0.25 * 0.75 + 0.75 * 0.75 / 2;
  EXPECT(result.costs.size() == 1);
  EXPECT(near(result.costs[0], before + behind));
}

void a_wait_that_is_longer_than_the_table() {
  const std::vector<double> flows = integrator_flows();
  const std::vector<double> rows{0.0}, noise{2.0}, known(9, 0.0);
  const std::vector<double> waits{0.0, 3.5};
  const std::vector<std::int32_t> slots{~0, nothing};
  const Propagated result =
      propagate(integrator, {1.0, 1, flows}, {rows, noise}, waits, slots, known);
  EXPECT(near(result.covariance[4], 3.5));
  EXPECT(near(result.costs[0], 3.5 * 3.5 / 2));
  EXPECT(near(result.covariance[8], 2.0));  // the slot has the noise of the measurement alone
}

}  // namespace

int main() {
  an_integrator_that_is_left_alone();
  an_output_that_arrives();
  a_wait_that_is_longer_than_the_table();
}
