// Packed columns, read back.

#include <cstddef>
#include <cstdint>
#include <limits>
#include <random>
#include <vector>

#include "columns/delta_packing.hpp"
#include "delta_unpacking.hpp"
#include "expect.hpp"

namespace {

template <typename Number>
void expect_same(const std::vector<Number> & numbers) {
  const auto bytes = chainshaper::columns::delta_packed(std::span<const Number>(numbers));
  EXPECT(chainshaper::columns::delta_unpacked<Number>(bytes) == numbers);
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
