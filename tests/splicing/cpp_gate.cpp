// Drives the C++ gate without ROS 2: decisions for the cases on standard input, one a line; with
// `--origins` the origins of payloads in hexadecimal; with a path a log with three messages.

#include <iostream>
#include <string>

#include "chainshaper_shaping/gate.hpp"
#include "chainshaper_shaping/gate_log.hpp"
#include "chainshaper_shaping/shaper.hpp"

using namespace chainshaper;  // NOLINT

namespace
{

std::int64_t number()
{
  std::int64_t value{};
  std::cin >> value;
  return value;
}

// "-" stands for none.
std::optional<std::int64_t> maybe()
{
  std::string word;
  std::cin >> word;
  if (word == "-") {
    return std::nullopt;
  }
  return std::stoll(word);
}

template<typename T>
void show(const std::optional<T> & value)
{
  if (value) {
    std::cout << ' ' << static_cast<std::int64_t>(*value);
  } else {
    std::cout << " -";
  }
}

void decide()
{
  Gate gate;
  gate.anchor = static_cast<Anchor>(number());
  gate.phase_ns = number();
  gate.max_age_ns = maybe();
  gate.max_future_ns = number();
  gate.overrun = static_cast<Policy>(number());
  gate.due_cycles = number();
  for (auto slots = number(); slots > 0; --slots) {
    const auto start = number();
    gate.slots.push_back({start, number()});
  }
  if (const auto modes = number(); modes > 0) {
    gate.modes.emplace();
    for (auto mode = 0; mode < modes; ++mode) {
      gate.modes->names.push_back("mode" + std::to_string(mode));
      gate.modes->bands.push_back(static_cast<std::size_t>(number()));
    }
    gate.modes->initial = static_cast<std::size_t>(number());
    gate.modes->late = static_cast<Policy>(number());
  }
  std::deque<Change> changes;
  for (auto count = number(); count > 0; --count) {
    const auto time = number();
    changes.emplace_back(time, static_cast<std::size_t>(number()));
  }
  const auto arrival = number();
  const auto stamp = maybe();
  const auto now = number();
  gate.cycle_ns = number();
  check(gate);
  const Release release = release_of(gate, arrival, stamp, changes);
  show(release.at_ns);
  std::cout << ' ' << release.origin_ns;
  show(release.slot);
  std::cout << ' ' << release.cycles_waited << ' ' << static_cast<int>(release.anchor);
  show(release.overrun);
  show(release.mode);
  std::cout << ' ' << missed(gate, release, now) << '\n';
}

void show_origins()
{
  for (std::string line; std::getline(std::cin, line); ) {
    std::vector<std::uint8_t> payload;
    for (std::size_t i = 0; i + 1 < line.size(); i += 2) {
      payload.push_back(static_cast<std::uint8_t>(std::stoi(line.substr(i, 2), nullptr, 16)));
    }
    show(origin_of(payload.data(), payload.size()));
    std::cout << '\n';
  }
}

void write_log(const std::string & path)
{
  Gate gate;
  gate.slots = {{300'000'000, 400'000'000}};
  gate.cycle_ns = 1'000'000'000;
  gate.overrun = Policy::discard;
  gate.modes = Modes{{"city", "highway"}, {0, 0}, 1, Policy::discard};
  Shaper shaper(gate, 0);
  GateLog log;
  if (!log.open_file(path)) {
    throw std::runtime_error("no log");
  }
  const auto stamp = [] {return clock_ns(CLOCK_REALTIME);};
  const Held first = shaper.hold(stamp());
  log.write(shaper.gate(), first, 5, monotonic_ns(), shaper.time_lost(first));
  shaper.announce("city", monotonic_ns());
  const Held second = shaper.hold(stamp());
  log.write(shaper.gate(), second, std::nullopt, monotonic_ns(), shaper.time_lost(second));
  const Held late = shaper.hold(stamp() - 500'000'000);
  log.write(
    shaper.gate(), late, std::numeric_limits<std::int64_t>::max(), std::nullopt, std::nullopt);
}

// Cycles of 4 s are to begin 2 s from now instead: when one begins before that is in force (counted
// from where one did), and behind it (counted from where the first was to). In ms.
void moved_phase()
{
  Gate gate;
  gate.cycle_ns = 4'000'000'000;
  gate.slots = {{0, gate.cycle_ns}};
  gate.anchor = Anchor::cycle;
  Shaper shaper(gate, 0);
  const std::int64_t now = monotonic_ns();
  const std::int64_t moved = now + 2'000'000'000;
  shaper.set_phase(moved % gate.cycle_ns, now);
  const auto origin = [&] {return shaper.hold(std::nullopt).release.origin_ns;};
  std::cout << origin() % gate.cycle_ns / 1'000'000 << "\n";
  sleep_until(moved);
  std::cout << (origin() - moved) / 1'000'000 << "\n";
}

}  // namespace

int main(int argc, char ** argv)
{
  const std::string what = argc > 1 ? argv[1] : "";
  if (what == "--phase") {
    moved_phase();
    return 0;
  }
  if (what == "--origins") {
    show_origins();
    return 0;
  }
  if (!what.empty()) {
    write_log(what);
    return 0;
  }
  for (auto cases = number(); cases > 0; --cases) {
    decide();
  }
}
