// Reads integers that begin at any bit (CTF 1.8, section 4.1.5). Nothing behind the end of the
// bytes is read: bits there count as 0.

#pragma once

#include <bit>
#include <cstdint>
#include <cstring>
#include <span>

namespace chainshaper::ctf {

static_assert(std::endian::native == std::endian::little, "packets are read on little-endian CPUs");

using Bytes = std::span<const std::uint8_t>;

// Returns the number at an address, where all of its bytes must be.
template <typename Number>
Number load(const std::uint8_t * place) {
  Number number;
  std::memcpy(&number, place, sizeof number);
  return number;
}

// Returns the low `count` bits, 0 to 64.
inline std::uint64_t low_bits(std::uint64_t word, std::int64_t count) {
  return count >= 64 ? word : word & ((std::uint64_t{1} << count) - 1);
}

// Returns the little-endian 8 bytes at byte `at`, which is not negative.
inline std::uint64_t word_at(Bytes bytes, std::int64_t at) {
  const auto place = static_cast<std::size_t>(at);
  if (place + 8 <= bytes.size()) [[likely]]
    return load<std::uint64_t>(bytes.data() + place);
  std::uint64_t word = 0;
  for (auto index = place; index < bytes.size(); ++index)
    word |= std::uint64_t{bytes[index]} << (8 * (index - place));
  return word;
}

inline std::uint64_t byte_at(Bytes bytes, std::int64_t at) {
  const auto place = static_cast<std::size_t>(at);
  return place < bytes.size() ? bytes[place] : 0;
}

// Returns the unsigned integer of 1 to 64 bits that begins at a bit.
inline std::uint64_t bits_at(Bytes bytes, std::int64_t position, std::int64_t size,
                             bool big_endian) {
  const auto at = position >> 3;
  const auto shift = position & 7;
  const bool across = shift + size > 64;  // it reaches into a ninth byte
  auto word = word_at(bytes, at);
  if (big_endian) {
    word = __builtin_bswap64(word) << shift;
    if (across) word |= byte_at(bytes, at + 8) >> (8 - shift);
    return word >> (64 - size);
  }
  word >>= shift;
  if (across) word |= byte_at(bytes, at + 8) << (64 - shift);
  return low_bits(word, size);
}

// Returns the signed integer that has these `size` bits.
inline std::int64_t with_sign(std::uint64_t bits, std::int64_t size) {
  return static_cast<std::int64_t>(bits << (64 - size)) >> (64 - size);
}

}  // namespace chainshaper::ctf
