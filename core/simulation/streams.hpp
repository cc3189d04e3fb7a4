// Sequences of CPU times and delays. Python draws the numbers, in blocks, when the engine needs
// them.

#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

#include "simulation/description.hpp"

namespace chainshaper::simulation {

// Returns the next block of numbers of the stream at a place. An exception ends the simulation.
using Source = std::function<std::vector<Nanoseconds>(Place)>;

class Stream {
public:
  Stream(const StreamDescription & described, Place place)
      : constant_ns_(described.constant_ns), place_(place) {}

  Nanoseconds next(const Source & source) {
    if (constant_ns_) return *constant_ns_;
    if (used_ == drawn_.size()) refill(source);
    return drawn_[used_++];
  }

private:
  void refill(const Source & source) {
    drawn_ = source(place_);
    used_ = 0;
    if (drawn_.empty()) throw std::invalid_argument("a stream of numbers has ended");
    for (const auto value : drawn_)
      if (value < 0 || value > forever) throw std::invalid_argument("a time must not be negative");
  }

  std::optional<Nanoseconds> constant_ns_;
  Place place_;
  std::vector<Nanoseconds> drawn_;
  std::size_t used_{0};
};

}  // namespace chainshaper::simulation
