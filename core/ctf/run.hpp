// Runs the steps of a layout over the bits of a packet.
//
// Every step checks the end of the packet's content before it reads, and every load checks the end
// of the file. A hostile packet may say that it has very many fields of no bits, which would keep a
// core busy for hours. So when a packet is read for the first time, each step is paid from a
// budget.

#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "ctf/bits.hpp"
#include "ctf/layout.hpp"
#include "ctf/texts.hpp"

namespace chainshaper::ctf {

// Why an event or a header cannot be read.
enum class Failure : std::uint8_t {
  truncated = 1,  // it reaches past the end of its packet's content
  no_option,      // a variant's tag names none of its options
  bad_length,     // an array or sequence is longer than the rest of its packet
  unterminated,   // a string does not end within its packet
  unknown_event,  // an event id that is not declared
  over_budget,    // far more work than its size warrants
  other_time,     // an event outside the time that its packet says it was open
  no_process,     // an event of process or thread 0
  all_zeros,      // zeros instead of events
  table_full,     // more events than were counted
};

// How far reading came, in bits from the packet's start; or why it failed.
class Reached {
public:
  // NOLINTNEXTLINE(google-explicit-constructor): a position is the usual case
  constexpr Reached(std::int64_t bits) : bits_(bits) {}
  constexpr Reached(Failure failure) : bits_(-static_cast<std::int64_t>(failure)) {}

  constexpr bool failed() const { return bits_ < 0; }
  constexpr std::int64_t bits() const { return bits_; }
  constexpr Failure failure() const { return static_cast<Failure>(-bits_); }

private:
  std::int64_t bits_;  // the negative of a Failure
};

inline std::int64_t align_up(std::int64_t position, std::int64_t align) {
  return (position + align - 1) & -align;
}

// The part of a file that begins with a packet, and where in it the packet's content ends.
struct Content {
  Bytes bytes;
  std::int64_t end;  // bits, not more than there are bytes
};

// A column that values go to, of as many rows as its table.
struct Column {
  std::uint8_t * values;
  std::int64_t width;  // bytes of a value: 1, 2, 4 or 8
  std::size_t rows;

  void store(std::size_t row, std::uint64_t value) const {
    switch (width) {
      case 8:
        return store_as<std::uint64_t>(row, value);
      case 4:
        return store_as<std::uint32_t>(row, value);
      case 2:
        return store_as<std::uint16_t>(row, value);
      default:
        return store_as<std::uint8_t>(row, value);
    }
  }

private:
  template <typename Number>
  void store_as(std::size_t row, std::uint64_t value) const {
    const auto number = static_cast<Number>(value);
    std::memcpy(values + row * sizeof number, &number, sizeof number);
  }
};

// The row that an event is written to.
struct Row {
  const Column * columns;
  std::size_t number;
  Texts * texts;
};

// The budget for each byte of a packet; when packets are searched, for each byte of the file. A
// step costs 1. A byte of a column costs 1, too: otherwise fields of no bits could fill the memory.
inline constexpr std::int64_t budget_per_byte = 64;

// Reads packet after packet, with a clock, variables and a budget that go on from one to the next.
class Run {
public:
  explicit Run(const Layout & layout)
      : layout_(layout), variables_(static_cast<std::size_t>(layout.variables)) {}

  // Runs steps from `position`. Values go to `row`, or nowhere.
  Reached steps(Steps steps, const Content & content, std::int64_t position,
                const Row * row = nullptr);

  // Sets the low `size` bits of the clock. If they have become smaller, they have wrapped: the
  // clock only goes forward (section 8).
  void set_clock(std::uint64_t value, std::int64_t size) {
    const auto before = clock_;
    clock_ = size >= 64 ? value : (before - low_bits(before, size)) | value;
    if (size < 64 && value < low_bits(before, size)) clock_ += std::uint64_t{1} << size;
  }

  // Takes a cost from the budget; returns whether there was enough.
  bool afford(std::int64_t cost) {
    if (__builtin_sub_overflow(budget_, cost, &budget_)) budget_ = -1;
    return budget_ >= 0;
  }

  // Sets all variables to 0. Every packet begins with this: a length or tag in an option that was
  // not chosen must not have its value from another packet, which may not be read every time.
  void forget_variables() { std::fill(variables_.begin(), variables_.end(), 0); }

  std::uint64_t clock() const { return clock_; }
  void set_whole_clock(std::uint64_t clock) { clock_ = clock; }
  void set_budget(std::int64_t budget) { budget_ = budget; }
  std::int64_t variable(std::int32_t number) const {
    return variables_[static_cast<std::size_t>(number)];
  }
  void set_variable(std::int32_t number, std::int64_t value) {
    variables_[static_cast<std::size_t>(number)] = value;
  }

private:
  void read_number(const Step & step, Bytes bytes, std::int64_t position, const Row * row);
  Reached read_text(const Step & step, const Content & content, std::int64_t position,
                    const Row * row);
  Reached repeat(const Step & step, std::int64_t end, std::int64_t position);
  const TagRange * chosen(const Step & step) const;

  const Layout & layout_;
  std::vector<std::int64_t> variables_;
  std::vector<std::int64_t> turns_;  // that remain of each open loop, the innermost last
  std::uint64_t clock_{0};
  std::int64_t budget_{std::numeric_limits<std::int64_t>::max()};
};

}  // namespace chainshaper::ctf
