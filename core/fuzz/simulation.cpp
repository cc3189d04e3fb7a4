// Any description is refused, or simulated without a fault: bytes choose its parts, wrong ones too.

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <stdexcept>

#include "simulation/engine.hpp"

using namespace chainshaper;              // NOLINT
using namespace chainshaper::simulation;  // NOLINT

namespace {

class Choices {
public:
  Choices(const std::uint8_t * bytes, std::size_t size) : bytes_(bytes), size_(size) {}

  std::size_t below(std::size_t limit) { return byte() % limit; }

  // Rarely one that is out of bounds.
  std::size_t place(std::size_t limit) { return byte() == 200 ? limit : byte() % limit; }
  std::size_t size() { return byte() == 200 ? 0 : 1 + byte() % 3; }
  bool yes() { return byte() % 2 == 1; }
  MaybePlace maybe(std::size_t limit) { return yes() ? MaybePlace(place(limit)) : std::nullopt; }

  // Mostly short, so that much happens; sometimes the longest, or none.
  Nanoseconds time() {
    if (byte() != 200) return 1 + byte() % 64;
    const auto kind = byte() % 3;
    return kind == 0 ? forever : kind - 2;  // -1 or 0
  }

private:
  std::uint8_t byte() { return next_ < size_ ? bytes_[next_++] : 0; }

  const std::uint8_t * bytes_;
  std::size_t size_;
  std::size_t next_{0};
};

GateDescription chosen_gate(Choices & choose) {
  GateDescription described;
  Gate & gate = described.gate;
  gate.cycle_ns = choose.time() + 20;
  gate.slots = {{choose.time() % 8, 9}, {12, 13 + choose.time() % 7}};
  gate.anchor = static_cast<Anchor>(choose.below(2));
  gate.overrun = static_cast<Policy>(choose.below(3));
  gate.due_cycles = static_cast<std::int64_t>(choose.below(3));
  gate.messages = static_cast<Messages>(choose.below(3));
  gate.into_open_slot = static_cast<Entry>(choose.below(2));
  if (choose.yes()) {
    gate.modes = {"city", "highway"};
    gate.mode_slots = {choose.place(2), 0};
    gate.late = static_cast<Policy>(choose.below(4));
    described.modes = {0, 1};
  }
  if (choose.yes()) described.moves = {{choose.time(), choose.time() % 4}};
  described.spin_ns = choose.time();
  described.pause_ns = choose.time();
  return described;
}

EntityDescription chosen_entity(Choices & choose, Place process, Place publishers) {
  EntityDescription entity;
  entity.process = process;
  entity.kind = static_cast<EntityKind>(choose.below(4));
  entity.group = choose.maybe(2);
  entity.body = static_cast<Body>(choose.below(5));
  entity.synchroniser = choose.place(1);
  entity.loop = choose.place(1);
  entity.input = choose.place(2);
  entity.period_ns = choose.time();
  entity.due_ns = choose.time();
  entity.execution = choose.below(4);
  entity.afterwards = choose.maybe(4);
  entity.first_publisher = publishers;
  entity.publisher_count = entity.body == Body::gate ? choose.size() : choose.below(3);
  if (choose.yes()) entity.lifespan_ns = choose.time();
  entity.depth = choose.size();
  entity.starts_chain = choose.yes();
  entity.on_chain = choose.yes();
  return entity;
}

PublisherDescription chosen_publisher(Choices & choose) {
  PublisherDescription publisher;
  for (auto readers = choose.below(3); readers > 0; --readers)
    publisher.readers.push_back({choose.below(9), choose.maybe(4)});
  publisher.asynchronous = choose.yes();
  publisher.depth = choose.size();
  if (choose.yes()) publisher.lifespan_ns = choose.time();
  publisher.ends_chain = choose.yes();
  if (choose.yes()) publisher.modes = {1, 0, 7};
  return publisher;
}

ThreadDescription chosen_thread(Choices & choose, Place process, Role role) {
  ThreadDescription thread;
  thread.core = choose.below(2);
  thread.rank = static_cast<std::int64_t>(choose.below(3));
  thread.server = choose.maybe(2);
  thread.role = role;
  thread.process = process;
  thread.wake_up = choose.below(4);
  thread.take = choose.below(4);
  thread.publish = choose.below(4);
  thread.receive = choose.maybe(4);
  thread.delivery = choose.below(4);
  return thread;
}

// Adds a loop to the last process, behind what its executor looks at.
void choose_loop(Choices & choose, Description & all) {
  const Place process = all.processes.size() - 1;
  EntityDescription entity = chosen_entity(choose, process, all.publishers.size());
  entity.kind = EntityKind::loop;
  entity.body = Body::compute;
  entity.loop = all.loops.size();
  for (auto left = entity.publisher_count; left > 0; --left)
    all.publishers.push_back(chosen_publisher(choose));
  all.entities.push_back(entity);
  const Nanoseconds last = choose.yes() ? all.stop_ns : choose.time();
  all.loops.push_back({all.threads.size(), choose.below(3), last, choose.yes()});
  all.threads.push_back(chosen_thread(choose, process, Role::loop));
}

Description chosen(Choices & choose) {
  Description all;
  all.stop_ns = 20'000;
  all.last_timer_ns = 15'000;
  all.streams = {{0}, {choose.time()}, {choose.time()}, {}};
  all.groups = 2;
  all.cycle_ns = choose.time() + 20;
  all.quantum_ns = choose.time();
  all.context_switch_ns = choose.time();
  all.preemption_ns = choose.time();
  all.interrupts_ppm = choose.time();
  all.switches = choose.yes();
  all.instances = choose.below(4);
  all.most_messages = 200;
  all.cores.resize(2);
  if (choose.yes()) {
    all.cores[0].table = {{0, choose.below(4)}, {choose.time() % 20, choose.below(4)}};
    all.cores[0].next = choose.place(2);
    all.cores[0].boundary_ns = choose.time();
  }
  all.gates = {chosen_gate(choose)};
  all.synchronisers = {{{{choose.yes(), 1}, {choose.yes(), 2}}, choose.maybe(2)}};
  for (Place process = 0, count = 1 + choose.below(3); process < count; ++process) {
    ProcessDescription described{static_cast<ExecutorKind>(choose.below(4)), all.entities.size(),
                                 choose.below(4)};
    for (Place place = 0; place < described.entity_count; ++place) {
      all.entities.push_back(chosen_entity(choose, process, all.publishers.size()));
      for (auto left = all.entities.back().publisher_count; left > 0; --left)
        all.publishers.push_back(chosen_publisher(choose));
    }
    all.processes.push_back(described);
    for (auto threads = choose.size(); threads > 0; --threads)
      all.threads.push_back(chosen_thread(choose, process, Role::executor));
    if (choose.size() > 0) all.threads.push_back(chosen_thread(choose, process, Role::publisher));
    if (choose.yes()) {
      all.threads.push_back(chosen_thread(choose, process, Role::dds));
      all.threads.back().receive = choose.place(4);
    }
    if (choose.yes()) choose_loop(choose, all);
  }
  for (auto & entity : all.entities)
    if (entity.body == Body::store && all.loops.empty()) entity.body = Body::compute;
  // Readers that there are: mostly what no timer or loop is.
  for (auto & publisher : all.publishers)
    std::erase_if(publisher.readers, [&](const Reader & reader) {
      return reader.entity >= all.entities.size() ||
             all.entities[reader.entity].kind == EntityKind::timer ||
             all.entities[reader.entity].kind == EntityKind::loop;
    });
  return all;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t * bytes, std::size_t size) {
  Choices choose(bytes, size);
  const Description description = chosen(choose);
  try {
    Engine engine(description, [&](Place) { return std::vector<Nanoseconds>(8, choose.time()); });
    engine.run(5'000);
    engine.take_log();
    engine.latencies();
  } catch (const std::invalid_argument &) {  // it was refused
  }
  return 0;
}
