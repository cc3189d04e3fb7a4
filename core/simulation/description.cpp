#include "simulation/description.hpp"

#include <algorithm>
#include <stdexcept>
#include <string>

namespace chainshaper::simulation {
namespace {

void require(bool sound, const char * problem) {
  if (!sound) throw std::invalid_argument(std::string("a simulation cannot have ") + problem);
}

// Times are so small that the sum of a few of them does not overflow.
bool is_time(Nanoseconds value) { return value >= 0 && value <= forever; }

template <typename Listed>
bool has(const std::vector<Listed> & list, MaybePlace place) {
  return !place || *place < list.size();
}

template <typename Listed>
bool has_range(const std::vector<Listed> & list, Place first, std::size_t count) {
  return first <= list.size() && count <= list.size() - first;
}

void check_core(const Description & all, const CoreDescription & core) {
  if (core.table.empty()) {
    require(core.boundary_ns == forever, "a boundary of servers without servers");
    return;
  }
  require(all.cycle_ns > 0 && is_time(all.cycle_ns), "servers without a cycle");
  require(core.next < core.table.size(), "servers without what comes next");
  require(is_time(core.boundary_ns), "servers that open never");
  Nanoseconds before = -1;
  for (const auto & row : core.table) {
    require(row.offset_ns > before && row.offset_ns < all.cycle_ns,
            "servers that open outside of the cycle, or not one after the other");
    before = row.offset_ns;
  }
}

void check_thread(const Description & all, const ThreadDescription & thread) {
  require(has(all.cores, thread.core), "a thread on an unknown core");
  require(!thread.server || *thread.server < 64, "more than 64 servers on a core");
  require(has(all.processes, thread.process), "a thread of an unknown process");
  for (const auto stream : {thread.wake_up, thread.take, thread.publish, thread.delivery})
    require(has(all.streams, stream), "a thread without its CPU times");
  require(has(all.streams, thread.receive), "a thread without its CPU times");
  require(thread.receive || thread.role != Role::dds, "a thread of DDS that takes no time");
}

void check_entity(const Description & all, const EntityDescription & entity) {
  require(has(all.processes, entity.process), "a callback of an unknown process");
  require(!entity.group || *entity.group < all.groups, "a callback of an unknown group");
  require(has(all.streams, entity.execution) && has(all.streams, entity.afterwards),
          "a callback without its CPU times");
  require(has_range(all.publishers, entity.first_publisher, entity.publisher_count),
          "a callback with an unknown publisher");
  require(!entity.lifespan_ns || is_time(*entity.lifespan_ns), "a negative lifespan");
  require(entity.depth > 0, "a history without room");
  const bool loop = entity.kind == EntityKind::loop;
  const bool timer = entity.kind == EntityKind::timer || loop;
  require(!timer || (entity.period_ns > 0 && is_time(entity.period_ns) && is_time(entity.due_ns)),
          "a timer or loop without a period");
  require(!loop || has(all.loops, entity.loop), "a loop without a thread");
  if (entity.body == Body::gate || entity.body == Body::mode_listener)
    require(has(all.gates, entity.gate), "a callback of an unknown gate");
  require(entity.body != Body::gate || entity.publisher_count > 0, "a gate that leads nowhere");
  if (entity.body == Body::synchronise) {
    require(has(all.synchronisers, entity.synchroniser) &&
                has(all.synchronisers[entity.synchroniser].inputs, entity.input),
            "an input of an unknown synchroniser");
  }
  if (entity.body == Body::store) {
    require(has(all.loops, entity.loop) && entity.input < all.loops[entity.loop].inputs,
            "an input of an unknown loop");
  }
}

// Checks that a loop has a thread, and is the thread's only one.
void check_loop(const Description & all, const LoopDescription & loop) {
  require(has(all.threads, loop.thread) && all.threads[loop.thread].role == Role::loop,
          "a loop without a thread");
  require(is_time(loop.last_ns), "a loop that begins never");
  const auto in_thread = [&](const auto & other) { return other.thread == loop.thread; };
  require(std::count_if(all.loops.begin(), all.loops.end(), in_thread) == 1,
          "two loops in a thread");
}

// Checks that each thread that is in a loop has it, and each loop its entity.
void check_loops(const Description & all) {
  for (const auto & loop : all.loops) check_loop(all, loop);
  const auto loops = static_cast<std::ptrdiff_t>(all.loops.size());
  const auto is_loop = [](const auto & entity) { return entity.kind == EntityKind::loop; };
  const auto in_loop = [](const auto & thread) { return thread.role == Role::loop; };
  require(std::count_if(all.entities.begin(), all.entities.end(), is_loop) == loops &&
              std::count_if(all.threads.begin(), all.threads.end(), in_loop) == loops,
          "loops without a thread, or threads without a loop");
  std::vector<bool> seen(all.loops.size());
  for (const auto & entity : all.entities) {
    if (!is_loop(entity)) continue;
    require(!seen[entity.loop], "a loop of two entities");
    seen[entity.loop] = true;
  }
}

void check_publisher(const Description & all, const PublisherDescription & publisher) {
  for (const auto & reader : publisher.readers) {
    require(has(all.entities, reader.entity) && has(all.streams, reader.delivery) &&
                all.entities[reader.entity].kind != EntityKind::timer &&
                all.entities[reader.entity].kind != EntityKind::loop,
            "a publisher with an unknown reader");
  }
  require(publisher.depth > 0, "a history without room");
  require(!publisher.lifespan_ns || is_time(*publisher.lifespan_ns), "a negative lifespan");
}

void check_gate(const GateDescription & described) {
  check(described.gate);
  require(described.modes.size() == described.gate.modes.size(), "a gate with unknown modes");
  require(is_time(described.spin_ns) && is_time(described.pause_ns), "a gate that rests for ever");
  for (const auto & [since_ns, by_ns] : described.moves) {
    require(is_time(since_ns) && described.gate.may_move(by_ns),
            "a gate whose slots leave the cycle");
  }
}

// Checks that processes have their callbacks, and the threads that these need.
void check_processes(const Description & all) {
  std::vector<bool> executing(all.processes.size()), sending(all.processes.size());
  for (const auto & thread : all.threads) {
    if (thread.role == Role::executor) executing[thread.process] = true;
    if (thread.role == Role::publisher) sending[thread.process] = true;
  }
  for (const auto & process : all.processes) {
    require(has_range(all.entities, process.first_entity, process.entity_count),
            "a process with unknown callbacks");
    for (Place place = 0; place < process.entity_count; ++place) {
      const auto & entity = all.entities[process.first_entity + place];
      require(&all.processes[entity.process] == &process, "a callback of two processes");
      require(entity.kind != EntityKind::loop, "an executor with a loop");
    }
  }
  for (const auto & entity : all.entities) {
    require(executing[entity.process] || entity.kind == EntityKind::loop,
            "a callback without a thread");
    for (Place place = 0; place < entity.publisher_count; ++place) {
      require(
          !all.publishers[entity.first_publisher + place].asynchronous || sending[entity.process],
          "an asynchronous publisher without a thread");
    }
  }
}

}  // namespace

void check(const Description & all) {
  for (const auto & core : all.cores) check_core(all, core);
  for (const auto & thread : all.threads) check_thread(all, thread);
  for (const auto & entity : all.entities) check_entity(all, entity);
  for (const auto & publisher : all.publishers) check_publisher(all, publisher);
  check_loops(all);
  for (const auto & gate : all.gates) check_gate(gate);
  for (const auto & synchroniser : all.synchronisers) {
    require(!synchroniser.inputs.empty(), "a synchroniser without inputs");
    require(has(synchroniser.inputs, synchroniser.trigger), "a synchroniser triggered by nothing");
    for (const auto & input : synchroniser.inputs)
      require(input.depth > 0, "a history without room");
  }
  for (const auto & stream : all.streams)
    require(!stream.constant_ns || is_time(*stream.constant_ns), "a negative time");
  check_processes(all);
  require(all.log_rows > 0 && all.log_rows <= std::size_t{1} << 24, "a log of that size");
  require(is_time(all.quantum_ns) && all.quantum_ns > 0, "turns of no time");
  require(is_time(all.context_switch_ns) && is_time(all.preemption_ns), "switches of no time");
  require(is_time(all.interrupts_ppm), "negative interrupts");
  require(is_time(all.last_timer_ns) && is_time(all.stop_ns) && is_time(all.record_from_ns),
          "an end beyond 146 years");
}

}  // namespace chainshaper::simulation
