// What the gates in C++ and in Python share: printed by scripts/gate-words from
// chainshaper/robot/gate.py and those beside it, which explain it. Do not edit.
// clang-format off

#pragma once

#include <array>
#include <cstdint>

namespace chainshaper {

// Words, in their order.
enum class Anchor { stamp, cycle };
inline constexpr std::array<const char *, 2> anchor_names{
    "stamp", "cycle"};
enum class Policy { wait, discard, publish, next_slot };
inline constexpr std::array<const char *, 4> policy_names{
    "wait", "discard", "publish", "next-slot"};
enum class Entry { at_once, next_slot };
inline constexpr std::array<const char *, 2> entry_names{
    "at-once", "next-slot"};
enum class Messages { all_in_order, newest };
inline constexpr std::array<const char *, 2> messages_names{
    "all-in-order", "newest"};
enum class Dropped { replaced, overflowed, discarded };
inline constexpr std::array<const char *, 3> dropped_names{
    "replaced", "overflowed", "discarded"};

namespace schema {

inline constexpr std::int64_t depth = 10;
inline constexpr std::int64_t max_future_ns = 1000000;
inline constexpr std::int64_t max_age_cycles = 10;
inline constexpr std::int64_t reader_depth = 1000;
inline constexpr std::int64_t stall_ns = 100000;
inline constexpr std::int64_t step_ns = 500000;
inline constexpr std::int64_t look_ns = 50000000;
inline constexpr std::int64_t others_ns = 2000000;
inline constexpr std::int64_t changes = 64;
inline constexpr std::int64_t early_divisor = 5;

}  // namespace schema
}  // namespace chainshaper
