// The throttler's rule `first`; chainshaper/robot/throttling.py explains it.

#pragma once

#include <algorithm>
#include <cstdint>

#include "gate/words.hpp"

namespace chainshaper {

// Lets the first message of each period pass. Times are nanoseconds.
struct FirstOfPeriod {
  std::int64_t period_ns;
  std::int64_t early_ns{period_ns / schema::early_divisor};
  std::int64_t due_ns{-2 * period_ns};
  std::int64_t passed_ns{due_ns};

  bool passes(std::int64_t now_ns) {
    if (now_ns < std::max(due_ns, passed_ns + period_ns) - early_ns) return false;
    const bool none_came = now_ns >= due_ns + period_ns - early_ns;
    due_ns = (none_came ? now_ns : due_ns) + period_ns;
    passed_ns = now_ns;
    return true;
  }
};

}  // namespace chainshaper
