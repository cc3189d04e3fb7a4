// Joins by key and time, against looking at every pair of rows.

#include <algorithm>
#include <random>

#include "expect.hpp"
#include "matching/joins.hpp"

namespace {

using namespace chainshaper::matching;

struct Table {
  std::vector<std::int64_t> times_ns;
  std::vector<std::int32_t> processes;
  std::vector<std::uint64_t> addresses;

  Events events() const {
    Events events{{}, times_ns};
    events.keys.add(std::span(processes));
    events.keys.add(std::span(addresses));
    return events;
  }
};

Table random_table(std::mt19937 & chance, std::size_t rows, std::uint32_t keys) {
  Table table;
  for (std::size_t row = 0; row < rows; ++row) {
    table.times_ns.push_back(chance() % 50);
    table.processes.push_back(static_cast<std::int32_t>(chance() % 3) - 1);
    table.addresses.push_back(chance() % keys);
  }
  std::sort(table.times_ns.begin(), table.times_ns.end());
  return table;
}

std::uint32_t nearest(const Table & left, std::size_t row, const Table & right, bool before,
                      bool strictly) {
  auto nearest = no_row;
  for (std::size_t candidate = 0; candidate < right.times_ns.size(); ++candidate) {
    const auto apart_ns = (left.times_ns[row] - right.times_ns[candidate]) * (before ? 1 : -1);
    const bool alike = left.processes[row] == right.processes[candidate] &&
                       left.addresses[row] == right.addresses[candidate];
    if (!alike || apart_ns < 0 || (strictly && apart_ns == 0)) continue;
    if (before || nearest == no_row) nearest = static_cast<std::uint32_t>(candidate);
  }
  return nearest;
}

void nearest_rows_are_those_of_a_search() {
  std::mt19937 chance(1);
  for (int turn = 0; turn < 200; ++turn) {
    const auto left = random_table(chance, chance() % 60, 4);
    const auto right = random_table(chance, chance() % 60, 4);
    for (const bool before : {true, false})
      for (const bool strictly : {true, false}) {
        const auto direction = before ? Direction::latest_before : Direction::first_after;
        const auto rows = nearest_rows(left.events(), right.events(), direction, strictly);
        EXPECT(rows.size() == left.times_ns.size());
        for (std::size_t row = 0; row < rows.size(); ++row)
          EXPECT(rows[row] == nearest(left, row, right, before, strictly));
      }
  }
}

void the_table_of_keys_grows() {
  KeyTable<std::int64_t> table;
  for (std::int64_t number = 0; number < 10'000; ++number) table[{number, -number, 7}] = number;
  for (std::int64_t number = 0; number < 10'000; ++number)
    EXPECT(*table.find({number, -number, 7}) == number);
  EXPECT(table.find({1, 1, 7}) == nullptr);
}

// Start and end times of one callback, and the end that each start has.
void instances_end(std::vector<std::int64_t> starts_ns, std::vector<std::int64_t> ends_ns,
                   const std::vector<std::uint32_t> & expected) {
  const std::vector<std::int32_t> key(starts_ns.size() + ends_ns.size());
  Events starts{{}, starts_ns}, ends{{}, ends_ns};
  starts.keys.add(std::span(key));
  ends.keys.add(std::span(key));
  EXPECT(ends_of_starts(starts, ends) == expected);
}

void instances_end_with_the_next_event() {
  instances_end({1, 5}, {3, 8}, {0, 1});
  instances_end({1, 3}, {3, 8}, {0, 1});    // it begins when the one before ended
  instances_end({4}, {4}, {0});             // it lasts no time
  instances_end({1, 2}, {9}, {no_row, 0});  // an end was lost
  instances_end({5}, {3, 8}, {1});          // its start was not recorded
  instances_end({}, {3}, {});
}

}  // namespace

int main() {
  nearest_rows_are_those_of_a_search();
  the_table_of_keys_grows();
  instances_end_with_the_next_event();
}
