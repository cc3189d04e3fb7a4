#include "ctf/run.hpp"

#include <algorithm>

namespace chainshaper::ctf {
namespace {

// More elements than any packet has, even of no bits.
constexpr std::int64_t most_elements = std::int64_t{1} << 40;

}  // namespace

Reached Run::steps(Steps steps, const Content & content, std::int64_t position, const Row * row) {
  using Does = Step::Does;
  turns_.clear();
  auto index = steps.first;
  while (index < steps.end) {
    const Step & step = layout_.steps[index++];
    position = align_up(position, step.align);
    switch (step.does) {
      case Does::skip:
      case Does::number:
      case Does::move: {
        const auto start = position;
        position += step.size;
        if (position > content.end) return Failure::truncated;
        const bool wanted = row != nullptr && step.column != none;
        if (step.does == Does::number || (step.does == Does::move && wanted))
          read_number(step, content.bytes, start, row);
        break;
      }
      case Does::text:
      case Does::characters: {
        const auto behind = read_text(step, content, position, row);
        if (behind.failed()) return behind;
        position = behind.bits();
        break;
      }
      case Does::skip_many:
      case Does::loop: {
        const auto behind = repeat(step, content.end, position);
        if (behind.failed()) return behind;
        position = behind.bits();
        if (step.does == Does::loop && turns_.back() == 0) {
          turns_.pop_back();
          index = step.target;
        }
        break;
      }
      case Does::again:
        if (--turns_.back() > 0)
          index = step.target;
        else
          turns_.pop_back();
        break;
      case Does::choose: {
        const auto * range = chosen(step);
        if (range == nullptr) return Failure::no_option;
        index = range->target;
        break;
      }
      case Does::jump:
        index = step.target;
        break;
    }
  }
  return position;
}

// Reads an integer, or the bits of a float. The caller has checked that they end in the content.
void Run::read_number(const Step & step, Bytes bytes, std::int64_t position, const Row * row) {
  const auto bits = bits_at(bytes, position, step.size, step.big_endian);
  const auto value = step.is_signed ? with_sign(bits, step.size) : static_cast<std::int64_t>(bits);
  if (step.variable != none) set_variable(step.variable, value);
  if (row != nullptr && step.column != none)
    row->columns[step.column].store(row->number, static_cast<std::uint64_t>(value));
  if (step.sets_clock) set_clock(bits, step.size);
}

// Reads a string, or an array of characters or bytes; returns where it ends.
Reached Run::read_text(const Step & step, const Content & content, std::int64_t position,
                       const Row * row) {
  const bool is_open = step.does == Step::Does::text;
  const auto at = position >> 3;
  auto limit = content.end >> 3;
  if (!is_open) {
    const auto count = step.variable == none ? step.count : variable(step.variable);
    if (count < 0 || count > (content.end - position) >> 3) return Failure::bad_length;
    limit = at + count;
  } else if (at >= limit) {
    return Failure::unterminated;
  }
  const bool wanted = row != nullptr && step.column != none;
  if (!is_open && !wanted) return limit << 3;
  const auto text = text_at(content.bytes, at, limit, step.is_text);
  if (is_open) {
    if (at + text.length >= limit) return Failure::unterminated;
    limit = at + text.length + 1;
  }
  if (wanted) row->columns[step.column].store(row->number, row->texts->code(text));
  return limit << 3;
}

// Skips many elements, or begins the turns of a loop; returns the position after that.
Reached Run::repeat(const Step & step, std::int64_t end, std::int64_t position) {
  const bool is_loop = step.does == Step::Does::loop;
  const auto count = step.variable == none ? step.count : variable(step.variable);
  const auto least = is_loop ? step.least : step.size;
  if (count < 0 || count >= most_elements || position > end) return Failure::bad_length;
  if (least > 0 && count > (end - position) / least) return Failure::bad_length;
  std::int64_t cost = 0;
  if (__builtin_mul_overflow(count, step.cost, &cost) || !afford(cost)) return Failure::over_budget;
  if (!is_loop) return position + count * step.size;
  turns_.push_back(count);
  return position;
}

// Returns the range that the tag of a variant is in; nullptr: it is in none.
const TagRange * Run::chosen(const Step & step) const {
  const auto bits = static_cast<std::uint64_t>(variable(step.variable));
  const auto tag = step.is_signed ? bits ^ (std::uint64_t{1} << 63) : bits;
  const auto first = layout_.ranges.begin() + static_cast<std::ptrdiff_t>(step.first_range);
  const auto last = first + static_cast<std::ptrdiff_t>(step.ranges);
  const auto range =
      std::find_if(first, last, [tag](auto & each) { return each.low <= tag && tag <= each.high; });
  return range == last ? nullptr : &*range;
}

}  // namespace chainshaper::ctf
