// Tries random inputs on a fuzz target where there is no libFuzzer: `PROGRAM [HOW_MANY [SEED]]`.
// (clang++ -fsanitize=fuzzer,address,undefined takes the target without this file.)

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <random>
#include <vector>

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t * bytes, std::size_t size);

int main(int count, char ** words) {
  const auto inputs = count > 1 ? std::strtoul(words[1], nullptr, 10) : 10'000;
  std::mt19937 random(count > 2 ? static_cast<unsigned>(std::strtoul(words[2], nullptr, 10)) : 1);
  for (unsigned long number = 0; number < inputs; ++number) {
    std::vector<std::uint8_t> bytes(random() % 600);
    for (auto & byte : bytes) byte = static_cast<std::uint8_t>(random());
    LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
  }
}
