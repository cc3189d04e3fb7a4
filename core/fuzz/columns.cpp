// Fuzzes the packing of columns: any numbers have to be the same when they are read back.

#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "columns/delta_packing.hpp"
#include "tests/delta_unpacking.hpp"

namespace chainshaper::fuzz {
namespace {

// Makes numbers of the bytes, as many as there are whole ones, packs them and reads them back.
template <typename Number>
void pack(const std::uint8_t * bytes, std::size_t size) {
  std::vector<Number> numbers(size / sizeof(Number));
  if (!numbers.empty()) std::memcpy(numbers.data(), bytes, numbers.size() * sizeof(Number));
  const auto packed = columns::delta_packed(std::span<const Number>(numbers));
  if (columns::delta_unpacked<Number>(packed) == numbers) return;
  std::fprintf(stderr, "other numbers are read than were packed\n");
  std::abort();
}

}  // namespace
}  // namespace chainshaper::fuzz

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t * data, std::size_t size) {
  chainshaper::fuzz::pack<std::int32_t>(data, size);
  chainshaper::fuzz::pack<std::int64_t>(data, size);
  return 0;
}
