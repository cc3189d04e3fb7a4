#include "control/propagation.hpp"

#include <algorithm>
#include <cmath>

namespace chainshaper::control {
namespace {

// A symmetric matrix, whole, whose rows are replaced by combinations of others.
class Covariance {
public:
  Covariance(std::size_t size, std::span<const double> values)
      : size_(size), entries_(values.begin(), values.end()), fresh_(size * size) {}

  // Replaces rows (and columns) from `first` on: new row r is the sum of weights[r, c] times the
  // old row `from` + c; their covariance gains `noise`, which may be null.
  void replace(std::size_t first, std::size_t rows, std::size_t from, std::size_t columns,
               const double * weights, const double * noise, std::size_t noise_stride) {
    for (std::size_t row = 0; row < rows; ++row) {
      double * fresh = fresh_.data() + row * size_;
      std::fill(fresh, fresh + size_, 0.0);
      for (std::size_t column = 0; column < columns; ++column) {
        const double weight = weights[row * columns + column];
        const double * old = entries_.data() + (from + column) * size_;
        for (std::size_t place = 0; place < size_; ++place) fresh[place] += weight * old[place];
      }
    }
    for (std::size_t row = 0; row < rows; ++row) {
      const double * fresh = fresh_.data() + row * size_;
      for (std::size_t place = 0; place < size_; ++place) {
        if (place >= first && place < first + rows) continue;
        entries_[(first + row) * size_ + place] = fresh[place];
        entries_[place * size_ + first + row] = fresh[place];
      }
    }
    for (std::size_t row = 0; row < rows; ++row) {
      const double * fresh = fresh_.data() + row * size_ + from;
      for (std::size_t second = 0; second <= row; ++second) {
        double sum = noise == nullptr ? 0.0 : noise[row * noise_stride + second];
        for (std::size_t column = 0; column < columns; ++column)
          sum += fresh[column] * weights[second * columns + column];
        entries_[(first + row) * size_ + first + second] = sum;
        entries_[(first + second) * size_ + first + row] = sum;
      }
    }
  }

  void copy(std::size_t first, std::size_t rows, std::size_t from) {
    for (std::size_t row = 0; row < rows; ++row)
      std::copy_n(entries_.data() + (from + row) * size_, size_,
                  entries_.data() + (first + row) * size_);
    for (std::size_t place = 0; place < size_; ++place)
      for (std::size_t row = 0; row < rows; ++row)
        entries_[place * size_ + first + row] = entries_[place * size_ + from + row];
  }

  // Adds noise that two blocks of rows have in common to their covariance.
  void join(std::size_t first, std::size_t rows, std::size_t second, std::size_t columns,
            const double * noise, std::size_t noise_stride) {
    for (std::size_t row = 0; row < rows; ++row)
      for (std::size_t column = 0; column < columns; ++column) {
        entries_[(first + row) * size_ + second + column] += noise[row * noise_stride + column];
        entries_[(second + column) * size_ + first + row] += noise[row * noise_stride + column];
      }
  }

  // The trace of weights times the block of the first `rows` rows and columns.
  [[nodiscard]] double weighed(const double * weights, std::size_t rows) const {
    double sum = 0.0;
    for (std::size_t row = 0; row < rows; ++row)
      for (std::size_t place = 0; place < rows; ++place)
        sum += weights[row * rows + place] * entries_[row * size_ + place];
    return sum;
  }

  [[nodiscard]] const std::vector<double> & entries() const { return entries_; }

private:
  std::size_t size_;
  std::vector<double> entries_, fresh_;
};

// The values of a flow over one duration, from the polynomials.
class FlowValues {
public:
  FlowValues(const Sizes & sizes, const Flows & flows) : flows_(flows), values_(sizes.values()) {}

  const double * over(double duration_s) {
    const double place = duration_s / flows_.longest_s * static_cast<double>(flows_.intervals);
    const auto interval =
        std::min(static_cast<std::size_t>(std::max(0.0, place)), flows_.intervals - 1);
    const double inside = place - static_cast<double>(interval);
    const std::size_t count = values_.size();
    const double * terms = flows_.coefficients.data() + interval * 4 * count;
    for (std::size_t value = 0; value < count; ++value)
      values_[value] =
          terms[value] +
          inside * (terms[count + value] +
                    inside * (terms[2 * count + value] + inside * terms[3 * count + value]));
    return values_.data();
  }

private:
  const Flows & flows_;
  std::vector<double> values_;
};

}  // namespace

Propagated propagate(const Sizes & sizes, const Flows & flows, const Sampling & sampling,
                     std::span<const double> waits_s, std::span<const std::int32_t> slots,
                     std::span<const double> covariance) {
  Covariance state(sizes.state(), covariance);
  FlowValues values(sizes, flows);
  Propagated result;
  const std::size_t flowing = sizes.flowing(), plant = sizes.plant, inputs = sizes.inputs;
  const std::size_t controller_at = flowing, slots_at = flowing + sizes.controller;
  const std::size_t seen = plant + sizes.controller, computed = sizes.controller + inputs;
  const double * output_rows = sampling.rows.data() + sizes.controller * seen;
  double cost = 0.0, duration_s = 0.0;
  bool sampled = false;
  const auto close = [&] {
    if (sampled) {
      result.costs.push_back(cost);
      result.durations.push_back(duration_s);
    }
    cost = duration_s = 0.0;
  };
  const auto flow = [&](double wait_s) {
    const double * over = values.over(wait_s);
    const double * noise = over + plant * flowing;
    const double * weights = noise + plant * plant;
    cost += state.weighed(weights, flowing) + weights[flowing * flowing];
    state.replace(inputs, plant, 0, flowing, over, noise, plant);
    duration_s += wait_s;
  };
  for (std::size_t event = 0; event < waits_s.size(); ++event) {
    double left_s = waits_s[event];
    while (left_s > flows.longest_s) {
      flow(flows.longest_s);
      left_s -= flows.longest_s;
    }
    if (left_s > 0.0) flow(left_s);
    const std::int32_t slot = slots[event];
    if (slot == nothing) continue;
    if (slot >= 0) {
      state.copy(0, inputs, slots_at + static_cast<std::size_t>(slot) * inputs);
      continue;
    }
    close();
    sampled = true;
    const std::size_t place = slots_at + static_cast<std::size_t>(~slot) * inputs;
    // The noise of the output and of the controller's state is one: first the output's rows with
    // their own noise, then the controller's, whose covariance with the output gains the noise.
    state.replace(place, inputs, inputs, seen, output_rows,
                  sampling.noise.data() + sizes.controller * computed + sizes.controller, computed);
    state.replace(controller_at, sizes.controller, inputs, seen, sampling.rows.data(),
                  sampling.noise.data(), computed);
    state.join(place, inputs, controller_at, sizes.controller,
               sampling.noise.data() + sizes.controller * computed, computed);
  }
  close();
  result.covariance = state.entries();
  return result;
}

}  // namespace chainshaper::control
