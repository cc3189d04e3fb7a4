#include "columns/delta_packing.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cstddef>
#include <type_traits>

namespace chainshaper::columns {
namespace {

constexpr std::size_t block_size = 128;
constexpr std::size_t miniblocks = 4;
constexpr std::size_t miniblock_size = block_size / miniblocks;

void add_varint(std::string & bytes, std::uint64_t value) {
  for (; value >= 128; value >>= 7) bytes.push_back(static_cast<char>(value | 128U));
  bytes.push_back(static_cast<char>(value));
}

// Signed numbers with small ones first: 0, -1, 1, -2, …
void add_zigzag(std::string & bytes, std::int64_t value) {
  const auto doubled = static_cast<std::uint64_t>(value) << 1;
  add_varint(bytes, value < 0 ? ~doubled : doubled);
}

// Numbers of `width` bits each, the lowest bits first: a miniblock fills whole bytes.
void add_packed(std::string & bytes, std::span<const std::uint64_t> numbers, unsigned width) {
  static_assert(std::endian::native == std::endian::little);
  std::array<std::uint64_t, miniblock_size + 1> words;
  std::size_t full = 0;
  std::uint64_t word = 0;
  unsigned used = 0;  // bits of the word
  for (const auto number : numbers) {
    word |= number << used;
    used += width;
    if (used < 64) continue;
    words[full++] = word;
    used -= 64;
    // A shift by all 64 bits would have no meaning.
    word = used > 0 ? number >> (width - used) : 0;
  }
  words[full] = word;
  bytes.append(reinterpret_cast<const char *>(words.data()), numbers.size() * width / 8);
}

// A block of differences, of which there may be fewer than it has room for.
template <typename Number>
void add_block(std::string & bytes, std::span<const std::make_unsigned_t<Number>> differences) {
  // What is taken as signed is nearer to zero.
  Number least = static_cast<Number>(differences.front());
  for (const auto difference : differences)
    least = std::min(least, static_cast<Number>(difference));
  std::array<std::uint64_t, block_size> above{};  // each difference's distance from the least
  for (std::size_t place = 0; place < differences.size(); ++place) {
    above[place] = static_cast<std::make_unsigned_t<Number>>(
        differences[place] - static_cast<std::make_unsigned_t<Number>>(least));
  }
  add_zigzag(bytes, least);
  std::array<unsigned, miniblocks> widths{};
  for (std::size_t part = 0; part < miniblocks; ++part) {
    std::uint64_t all = 0;
    for (std::size_t place = 0; place < miniblock_size; ++place)
      all |= above[part * miniblock_size + place];
    widths[part] = static_cast<unsigned>(std::bit_width(all));
    bytes.push_back(static_cast<char>(widths[part]));
  }
  // Behind the last difference, whole parts are left out.
  for (std::size_t part = 0; part * miniblock_size < differences.size(); ++part) {
    if (widths[part] > 0) {
      add_packed(bytes, std::span(above).subspan(part * miniblock_size, miniblock_size),
                 widths[part]);
    }
  }
}

}  // namespace

template <typename Number>
std::string delta_packed(std::span<const Number> numbers) {
  using Unsigned = std::make_unsigned_t<Number>;  // differences wrap around, as their sums do
  std::string bytes;
  bytes.reserve(numbers.size() * sizeof(Number) / 2 + 64);
  add_varint(bytes, block_size);
  add_varint(bytes, miniblocks);
  add_varint(bytes, numbers.size());
  add_zigzag(bytes, numbers.empty() ? 0 : numbers.front());
  std::array<Unsigned, block_size> differences{};
  for (std::size_t first = 1; first < numbers.size(); first += block_size) {
    const auto count = std::min(block_size, numbers.size() - first);
    for (std::size_t place = 0; place < count; ++place) {
      differences[place] = static_cast<Unsigned>(static_cast<Unsigned>(numbers[first + place]) -
                                                 static_cast<Unsigned>(numbers[first + place - 1]));
    }
    add_block<Number>(bytes, std::span<const Unsigned>(differences).first(count));
  }
  return bytes;
}

template std::string delta_packed(std::span<const std::int32_t> numbers);
template std::string delta_packed(std::span<const std::int64_t> numbers);

}  // namespace chainshaper::columns
