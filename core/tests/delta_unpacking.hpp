// Packed columns read by a decoder that follows Parquet's description step by step, for tests.

#pragma once

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

namespace chainshaper::columns {

// Reads what `delta_packed` wrote (apache/parquet-format, Encodings.md), plainly: bit by bit.
class DeltaReader {
public:
  explicit DeltaReader(const std::string & bytes) : bytes_(bytes) {}

  std::uint64_t varint() {
    std::uint64_t value = 0;
    for (unsigned shift = 0;; shift += 7) {
      const auto byte = next();
      value |= std::uint64_t{byte & 127U} << shift;
      if (byte < 128) return value;
    }
  }

  std::uint64_t zigzag() {
    const auto value = varint();
    return (value >> 1) ^ (0 - (value & 1));
  }

  std::uint8_t next() { return static_cast<std::uint8_t>(bytes_.at(place_++)); }

  // Numbers of so many bits each.
  std::vector<std::uint64_t> packed(std::size_t count, unsigned width) {
    std::vector<std::uint64_t> numbers(count);
    for (std::size_t bit = 0; bit < count * width; ++bit) {
      const auto byte = static_cast<std::uint8_t>(bytes_.at(place_ + bit / 8));
      numbers[bit / width] |= std::uint64_t{(byte >> (bit % 8)) & 1U} << (bit % width);
    }
    place_ += count * width / 8;
    return numbers;
  }

  bool at_end() const { return place_ == bytes_.size(); }

private:
  const std::string & bytes_;
  std::size_t place_{0};
};

// The numbers of a packed column. Throws std::out_of_range where it has more or fewer bytes than
// they need.
template <typename Number>
std::vector<Number> delta_unpacked(const std::string & bytes) {
  DeltaReader reader(bytes);
  const auto block = reader.varint(), parts = reader.varint(), count = reader.varint();
  auto value = reader.zigzag();
  std::vector<Number> numbers;
  if (count > 0) numbers.push_back(static_cast<Number>(value));
  while (numbers.size() < count) {
    const auto least = reader.zigzag();
    std::vector<unsigned> widths;
    for (std::uint64_t part = 0; part < parts; ++part) widths.push_back(reader.next());
    for (const auto width : widths) {
      if (numbers.size() == count) break;  // further parts are left out
      for (const auto above : reader.packed(block / parts, width)) {
        value += least + above;
        if (numbers.size() < count) numbers.push_back(static_cast<Number>(value));
      }
    }
  }
  if (!reader.at_end()) throw std::out_of_range("bytes behind the last number");
  return numbers;
}

}  // namespace chainshaper::columns
