// Drives the C++ gate without ROS 2: what becomes of the messages of the cases on standard input,
// one case a line; with `--origins` the origins of payloads in hexadecimal; with a path a log.

#include <iostream>
#include <string>

#include "chainshaper_shaping/shaper.hpp"
#include "chainshaper_shaping/gate_log.hpp"

using namespace chainshaper;  // NOLINT

namespace {

std::int64_t number() {
  std::int64_t value{};
  std::cin >> value;
  return value;
}

// "-" stands for none.
Maybe maybe() {
  std::string word;
  std::cin >> word;
  if (word == "-") return std::nullopt;
  return std::stoll(word);
}

template <typename T>
void show(const std::optional<T> & value) {
  if (value)
    std::cout << ' ' << static_cast<std::int64_t>(*value);
  else
    std::cout << " -";
}

Gate read_gate() {
  Gate gate;
  gate.anchor = static_cast<Anchor>(number());
  gate.phase_ns = number();
  gate.overrun = static_cast<Policy>(number());
  gate.due_cycles = number();
  gate.messages = static_cast<Messages>(number());
  gate.depth = static_cast<std::size_t>(number());
  gate.cycle_ns = number();
  gate.into_open_slot = static_cast<Entry>(number());
  for (auto slots = number(); slots > 0; --slots) {
    const auto start = number();
    gate.slots.push_back({start, number()});
  }
  if (const auto modes = number(); modes > 0) {
    for (auto mode = 0; mode < modes; ++mode) {
      gate.modes.push_back("mode" + std::to_string(mode));
      gate.mode_slots.push_back(static_cast<std::size_t>(number()));
    }
    gate.first_mode = static_cast<std::size_t>(number());
    gate.late = static_cast<Policy>(number());
  }
  return gate;
}

struct Outcome {
  Maybe left_ns;
  Release release;
};

// What the gate does without a clock; messages are their places in the order of coming.
void walk() {
  Queue<std::size_t> queue(read_gate());
  for (auto count = number(); count > 0; --count) {
    const auto from_ns = number();
    const auto what = number();  // in the order of `CHANGED`
    const auto value = number();
    if (what == 0)
      queue.switch_mode(static_cast<std::size_t>(value), from_ns);
    else if (what == 1)
      queue.move_slots(value, from_ns);
    else
      queue.set_phase(value, from_ns);
  }
  std::deque<std::int64_t> steps;
  for (auto count = number(); count > 0; --count) steps.push_back(number());
  const auto publishing_ns = number();
  const auto late_ns = number();
  std::vector<std::pair<std::int64_t, Maybe>> arrivals;
  for (auto count = number(); count > 0; --count) {
    const auto arrival = number();
    arrivals.emplace_back(arrival, maybe());
  }
  std::vector<Outcome> found(arrivals.size());
  std::size_t next = 0;
  std::int64_t now = 0;
  const auto come_until = [&](std::int64_t time) {
    for (; next < arrivals.size() && arrivals[next].first <= time; ++next) {
      if (!steps.empty() && steps.front() <= arrivals[next].first) {
        steps.pop_front();
        queue.doubt_stamps(arrivals[next].first);
      }
      const auto full = queue.arrive(next, arrivals[next].first, arrivals[next].second);
      if (full) found[full->waiting.message] = {std::nullopt, full->release};
    }
  };
  while (next < arrivals.size() || !queue.waiting.empty()) {
    if (queue.waiting.empty()) {
      now = std::max(now, arrivals[next].first);
      come_until(now);
    }
    const auto oldest = queue.waiting.front().message;
    auto release = queue.decide();
    if (release.at_ns) {
      const bool slept = *release.at_ns > now;
      now = std::max(now, *release.at_ns);
      come_until(now);
      if (queue.waiting.front().message != oldest) continue;
      now += slept ? late_ns : 0;
      if (queue.replaced(release, now)) {
        release.drop(Dropped::replaced);
      } else if (queue.gate.policy() == Policy::discard && missed(queue.gate, release, now)) {
        release.overrun = Policy::discard;
        release.drop(Dropped::discarded);
      }
    }
    found[oldest] = {release.dropped ? std::nullopt : Maybe(now), release};
    queue.leave(release, now);
    now += release.dropped ? 0 : publishing_ns;
    queue.free_ns = now;
    come_until(now);
  }
  for (const auto & [left_ns, release] : found) {
    show(left_ns);
    show(release.at_ns);
    std::cout << ' ' << release.origin_ns;
    show(release.slot);
    std::cout << ' ' << release.cycles_waited << ' ' << static_cast<int>(release.anchor);
    show(release.overrun);
    show(release.mode);
    show(release.dropped);
    std::cout << ' ' << release.moved_ns << '\n';
  }
}

void show_origins() {
  for (std::string line; std::getline(std::cin, line);) {
    std::vector<std::uint8_t> payload;
    for (std::size_t i = 0; i + 1 < line.size(); i += 2)
      payload.push_back(static_cast<std::uint8_t>(std::stoi(line.substr(i, 2), nullptr, 16)));
    show(origin_of(payload.data(), payload.size()));
    std::cout << '\n';
  }
}

void write_log(const std::string & path, std::int64_t most_bytes, int rows) {
  Gate gate;
  gate.slots = {{300'000'000, 400'000'000}};
  gate.cycle_ns = 1'000'000'000;
  gate.overrun = Policy::discard;
  gate.modes = {"city", "highway"};
  gate.mode_slots = {0, 0};
  gate.first_mode = 1;
  gate.late = Policy::discard;
  Shaper<int> shaper(gate, 0);
  {
    GateLog log;
    if (!log.open_file(path, most_bytes)) throw std::runtime_error("no log");
    const auto hold = [&](std::int64_t age_ns, Maybe source) {
      shaper.arrive(0, clock_ns(CLOCK_REALTIME) - age_ns, source, false, source ? 2 : 0);
      return *shaper.hold();
    };
    const auto first = hold(0, 5);
    log.write(shaper.queue.gate, first, monotonic_ns(), shaper.time_lost(first));
    shaper.announce("city", monotonic_ns());
    const auto second = hold(0, std::nullopt);
    log.write(shaper.queue.gate, second, monotonic_ns(), shaper.time_lost(second));
    const auto late = hold(500'000'000, std::numeric_limits<std::int64_t>::max());
    for (auto row = 0; row < rows; ++row) {
      log.write(shaper.queue.gate, late);
      if (row % 1000 == 999)  // the writer is an ordinary thread
        sleep_until(monotonic_ns() + 50'000'000);
    }
    std::cout << log.losses() << '\n';
  }
}

}  // namespace

int main(int argc, char ** argv) {
  const std::string what = argc > 1 ? argv[1] : "";
  if (what == "--origins") {
    show_origins();
    return 0;
  }
  if (!what.empty()) {
    write_log(what, std::stoll(argv[2]), std::stoi(argv[3]));
    return 0;
  }
  for (auto cases = number(); cases > 0; --cases) walk();
}
