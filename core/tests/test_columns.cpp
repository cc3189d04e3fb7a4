// Packed columns, read back by a decoder that follows Parquet's description step by step.

#include <cstddef>
#include <cstdint>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "columns/delta_packing.hpp"
#include "expect.hpp"

namespace {

// Reads what `delta_packed` wrote (apache/parquet-format, Encodings.md), plainly: bit by bit.
class Reader {
public:
  explicit Reader(const std::string & bytes) : bytes_(bytes) {}

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

template <typename Number>
std::vector<Number> unpacked(const std::string & bytes) {
  Reader reader(bytes);
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
  EXPECT(reader.at_end());
  return numbers;
}

template <typename Number>
void expect_same(const std::vector<Number> & numbers) {
  const auto bytes = chainshaper::columns::delta_packed(std::span<const Number>(numbers));
  EXPECT(unpacked<Number>(bytes) == numbers);
}

template <typename Number>
void test_numbers_of_all_sizes() {
  std::mt19937_64 draw(1);
  for (const std::size_t count : {0, 1, 2, 32, 33, 34, 128, 129, 130, 257, 1000}) {
    for (unsigned shift = 0; shift < 8 * sizeof(Number); ++shift) {
      std::vector<Number> numbers(count);
      for (auto & number : numbers)
        number = static_cast<Number>(static_cast<Number>(draw()) >> shift);
      expect_same(numbers);
    }
  }
}

// Differences of these do not fit into the type: they wrap around, as their sums do.
template <typename Number>
void test_limits() {
  constexpr auto low = std::numeric_limits<Number>::min(),
                 high = std::numeric_limits<Number>::max();
  expect_same<Number>({low, high, low, high, 0, low, -1, high, 1});
  expect_same<Number>(std::vector<Number>(300, low));
}

}  // namespace

int main() {
  test_numbers_of_all_sizes<std::int32_t>();
  test_numbers_of_all_sizes<std::int64_t>();
  test_limits<std::int32_t>();
  test_limits<std::int64_t>();
}
