// What the gates in C++ and in Python share: printed by scripts/gate-words from
// chainshaper/robot/gate.py and those beside it, which explain it. Do not edit.
// clang-format off

#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>

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

// The value that a word stands for. Throws std::invalid_argument for an unknown word.
template <typename Value, typename Words>
Value word_named(const Words & words, const std::string & name) {
  for (std::size_t place = 0; place < words.size(); ++place)
    if (words[place] == name) return static_cast<Value>(place);
  throw std::invalid_argument("'" + name + "' is no word for a gate");
}

// The numbers and words of a gate, as `Gate` in Python declares them.
struct GateValues {
  std::int64_t cycle_ns{0};
  Anchor anchor{Anchor::stamp};
  std::int64_t phase_ns{0};
  Policy overrun{Policy::wait};
  std::int64_t due_cycles{0};
  Messages messages{Messages::all_in_order};
  Entry into_open_slot{Entry::at_once};
};

// Calls `visit` with the name and the member of each, and with the words that a word may be.
template <typename Visit>
void each_gate_value(Visit && visit) {
  visit("cycle_ns", &GateValues::cycle_ns);
  visit("anchor", &GateValues::anchor, anchor_names);
  visit("phase_ns", &GateValues::phase_ns);
  visit("overrun", &GateValues::overrun, policy_names);
  visit("due_cycles", &GateValues::due_cycles);
  visit("messages", &GateValues::messages, messages_names);
  visit("into_open_slot", &GateValues::into_open_slot, entry_names);
}

namespace schema {

inline constexpr std::int64_t depth = 10;
inline constexpr std::int64_t max_future_ns = 1000000;
inline constexpr std::int64_t max_age_cycles = 10;
inline constexpr std::int64_t reader_depth = 1000;
inline constexpr std::int64_t stall_ns = 100000;
inline constexpr std::int64_t step_ns = 500000;
inline constexpr std::int64_t look_ns = 50000000;
inline constexpr std::int64_t others_ns = 2000000;
inline constexpr std::int64_t schedules = 64;
inline constexpr std::int64_t early_divisor = 5;

}  // namespace schema
}  // namespace chainshaper
