// Runs a fuzz target without libFuzzer, which finds far more where clang is:
//
//     TARGET --seconds 30     on random inputs for so long
//     TARGET --inputs 20000   on so many random inputs
//     TARGET FILE…            on what is in these files

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <iterator>
#include <random>
#include <string>
#include <vector>

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t * data, std::size_t size);

namespace {

using Bytes = std::vector<std::uint8_t>;

Bytes random_input(std::mt19937 & chance) {
  Bytes input(chance() % 600);
  for (auto & byte : input)
    byte = static_cast<std::uint8_t>(chance() % 3 == 0 ? chance() : chance() % 8);
  // A packet of a trace somewhere, so that not all ends at the magic number.
  const std::uint8_t magic[] = {0xC1, 0x1F, 0xFC, 0xC1};
  if (input.size() > 80)
    std::copy(std::begin(magic), std::end(magic), input.begin() + 40 + chance() % 32);
  return input;
}

template <typename GoesOn>
void run_on_random_inputs(GoesOn goes_on) {
  std::mt19937 chance(1);
  unsigned long inputs = 0;
  for (; goes_on(inputs); ++inputs) {
    const auto input = random_input(chance);
    LLVMFuzzerTestOneInput(input.data(), input.size());
  }
  std::printf("%lu inputs\n", inputs);
}

}  // namespace

int main(int count, char ** arguments) {
  using Clock = std::chrono::steady_clock;
  const std::vector<std::string> words(arguments + 1, arguments + count);
  if (words.size() == 2 && words[0] == "--seconds") {
    const auto end = Clock::now() + std::chrono::seconds(std::stol(words[1]));
    run_on_random_inputs([&](unsigned long) { return Clock::now() < end; });
  } else if (words.size() == 2 && words[0] == "--inputs") {
    const auto most = std::stoul(words[1]);
    run_on_random_inputs([&](unsigned long inputs) { return inputs < most; });
  } else {
    for (const auto & name : words) {
      std::ifstream file(name, std::ios::binary);
      const Bytes input(std::istreambuf_iterator<char>(file), {});
      LLVMFuzzerTestOneInput(input.data(), input.size());
    }
  }
  return 0;
}
