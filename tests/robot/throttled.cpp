// Which messages pass by the throttler's rule `first`: a line for each case on standard input, which
// has its period and then when messages come; as many digits, 1 for one that passes.

#include <iostream>
#include <sstream>

#include "gate/throttling.hpp"

int main() {
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream words(line);
    std::int64_t number{};
    words >> number;
    chainshaper::FirstOfPeriod rule{number};
    while (words >> number) std::cout << rule.passes(number);
    std::cout << '\n';
  }
}
