// Runs a fuzz target without libFuzzer: on files that are named, or on random inputs for so many
// seconds (`TARGET --seconds 30`). Where clang is, libFuzzer finds far more.

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <random>
#include <string>
#include <vector>

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t * data, std::size_t size);

namespace {

std::vector<std::uint8_t> random_input(std::mt19937 & chance) {
  std::vector<std::uint8_t> input(chance() % 600);
  for (auto & byte : input)
    byte = static_cast<std::uint8_t>(chance() % 3 == 0 ? chance() : chance() % 8);
  // A packet somewhere, so that not all ends at the magic number.
  const std::uint8_t magic[] = {0xC1, 0x1F, 0xFC, 0xC1};
  if (input.size() > 80)
    std::copy(std::begin(magic), std::end(magic), input.begin() + 40 + chance() % 32);
  return input;
}

}  // namespace

int main(int count, char ** arguments) {
  const std::vector<std::string> names(arguments + 1, arguments + count);
  if (names.size() == 2 && names[0] == "--seconds") {
    const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(std::stol(names[1]));
    std::mt19937 chance(1);
    std::size_t runs = 0;
    for (; std::chrono::steady_clock::now() < end; ++runs) {
      const auto input = random_input(chance);
      LLVMFuzzerTestOneInput(input.data(), input.size());
    }
    std::printf("%zu inputs\n", runs);
    return 0;
  }
  for (const auto & name : names) {
    std::ifstream file(name, std::ios::binary);
    const std::vector<std::uint8_t> input(std::istreambuf_iterator<char>(file), {});
    LLVMFuzzerTestOneInput(input.data(), input.size());
  }
  return 0;
}
