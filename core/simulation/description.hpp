// What is simulated: an application's processes, threads, callbacks and topics, as plain values.
//
// Parts refer to each other by their places in the lists of a `Description`. Python fills it in
// (chainshaper/simulation/machine.py) and `check` refuses a contradictory one. A simulated machine
// has a single clock; all times are its nanoseconds.

#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "gate/gate.hpp"

namespace chainshaper::simulation {

using Nanoseconds = std::int64_t;
using Place = std::size_t;
using MaybePlace = std::optional<Place>;

// Later than anything that happens.
inline constexpr Nanoseconds forever = 0x4000'0000'0000'0000;

// Which servers of a core are open from an offset in the cycle on: bit n stands for server n.
struct OpenServers {
  Nanoseconds offset_ns;
  std::uint64_t servers;
};

struct CoreDescription {
  std::vector<OpenServers> table;    // in force in every cycle; empty: no plan governs this core
  std::uint64_t open_servers{0};     // at the start
  Place next{0};                     // the row of the table that comes into force next
  Nanoseconds boundary_ns{forever};  // when it does
};

// What a thread does: it runs an executor's callbacks, sends for the asynchronous publishers of its
// process, receives messages for DDS, or is in a loop of its own.
enum class Role { executor, publisher, dds, loop };

struct ThreadDescription {
  Place core{0};
  std::int64_t rank{0};               // the thread of the smallest rank runs
  std::optional<std::size_t> server;  // number of its server on its core; none: it runs any time
  Role role{Role::executor};
  Place process{0};
  // Streams of CPU times:
  Place wake_up{0};    // after it is woken, until it goes on with its work
  Place take{0};       // after it has chosen a message, until the callback begins
  Place publish{0};    // of publishing a message, or of sending it
  MaybePlace receive;  // of receiving a message; only threads of DDS have it
  // Stream of delays:
  Place delivery{0};  // from sending a message until it is at the subscriber's process
  // Numbers that its events have:
  std::int32_t pid{0};
  std::int32_t tid{0};
  std::int32_t cpu{0};
};

// The order in which the executor of a process runs callbacks; see engine.hpp.
enum class ExecutorKind { single_threaded, static_single_threaded, events, multi_threaded };

struct ProcessDescription {
  ExecutorKind executor{ExecutorKind::single_threaded};
  Place first_entity{0};  // its entities, in the order in which the executor looks at them
  Place entity_count{0};
};

// What an executor waits for. A loop is no callback: a thread of its own runs it, and no executor
// looks at it.
enum class EntityKind { timer, subscription, service, client, loop };

// What the callback of an entity does.
enum class Body { compute, gate, mode_listener, synchronise, store };

struct EntityDescription {
  // Handles, as events have them:
  std::int64_t callback{0};
  std::int64_t handle{0};
  std::int64_t rmw_handle{0};
  Place process{0};
  EntityKind kind{EntityKind::subscription};
  MaybePlace group;  // mutually exclusive callback group; none: it may always run
  Body body{Body::compute};
  Place gate{0};             // of a gate, or of a listener for a gate's modes
  Place synchroniser{0};     // of an input of a synchroniser
  Place loop{0};             // of a loop, or of an input that is stored for a loop
  Place input{0};            // which input of the synchroniser or loop it is
  Nanoseconds period_ns{1};  // of a timer or loop
  Nanoseconds due_ns{0};     // when a timer expires first, or a loop begins
  Place execution{0};        // stream of CPU times of the callback before it publishes
  MaybePlace afterwards;     // stream of CPU times after it has published; none: it ends then
  Place first_publisher{0};  // it publishes with these publishers, in their order
  Place publisher_count{0};
  std::optional<Nanoseconds> lifespan_ns;  // a message that has waited for longer is dropped
  std::size_t depth{1};                    // messages in the history of its reader
  bool starts_chain{false};                // an instance of its callback begins one of the chain
  bool on_chain{false};                    // messages that it takes stay on the chain
};

struct Reader {
  Place entity{0};
  MaybePlace delivery;  // stream of its delivery times; none: those of the sending thread
};

struct PublisherDescription {
  std::int64_t handle{0};
  std::int64_t rmw_handle{0};
  std::vector<Reader> readers;
  bool asynchronous{false};
  std::size_t depth{1};                    // of an asynchronous one
  std::optional<Nanoseconds> lifespan_ns;  // of an asynchronous one
  bool ends_chain{false};
  std::vector<std::int64_t> modes;  // its messages announce these in turn; empty: none
};

struct GateDescription {
  Gate gate;
  std::vector<std::int64_t> modes;  // the number of each of the gate's modes in the application
  // Shifts of all slots: the time from which each shift is in force, and the shift.
  std::vector<std::pair<Nanoseconds, Nanoseconds>> moves;
  Nanoseconds spin_ns{0};   // for how long it spins before a release
  Nanoseconds pause_ns{0};  // for how long it rests after a publication
};

// A synchroniser combines messages to sets, each with a message of every input. A set is complete
// when the last of its messages has come. With a `trigger`, each message of that input completes a
// set with the newest messages of all other inputs.
struct SynchroniserDescription {
  struct Input {
    bool on_chain{false};
    std::size_t depth{1};
  };
  std::vector<Input> inputs;
  MaybePlace trigger;
};

// A loop sleeps until multiples of its entity's period. Each instance uses the newest message of
// each input that was stored before the instance began. When timers expire no more, it begins only
// instances that have something new to use.
struct LoopDescription {
  Place thread{0};         // its own
  std::size_t inputs{0};   // of so many topics it uses the newest message
  Nanoseconds last_ns{0};  // it begins no instance afterwards
  bool ends_chain{false};  // the end of an instance ends the chain
};

// A sequence of CPU times or delays: a constant, or numbers that the engine asks for in blocks.
struct StreamDescription {
  std::optional<Nanoseconds> constant_ns;
};

struct Description {
  std::vector<CoreDescription> cores;
  std::vector<ThreadDescription> threads;
  std::vector<ProcessDescription> processes;
  std::vector<EntityDescription> entities;
  std::vector<PublisherDescription> publishers;
  std::vector<GateDescription> gates;
  std::vector<SynchroniserDescription> synchronisers;
  std::vector<LoopDescription> loops;
  std::vector<StreamDescription> streams;
  std::size_t groups{0};
  Nanoseconds cycle_ns{0};           // of the plan in force; 0: no plan is
  Nanoseconds quantum_ns{forever};   // of threads of equal rank in turn; `forever`: no turns
  Nanoseconds context_switch_ns{0};  // CPU time that a switch costs the thread that runs then
  Nanoseconds preemption_ns{0};      // CPU time that resuming costs a thread that was pre-empted
  std::int64_t interrupts_ppm{0};    // by how much interrupts make callbacks longer
  Nanoseconds last_timer_ns{0};      // timers expire until then
  Nanoseconds stop_ns{0};            // the simulation ends then
  Nanoseconds record_from_ns{0};     // events and instances of the chain count from then on
  bool events{true};                 // whether events are logged
  bool switches{false};              // whether context switches are logged
  std::size_t instances{0};          // of so many instances of the chain latencies are recorded
  std::size_t log_rows{131'072};     // when the log has so many rows of a kind, the engine pauses
  std::size_t most_messages{4096};   // when so many are under way, the engine gives up
};

// Throws std::invalid_argument if a place is not in its list, or a number is impossible.
void check(const Description & description);

}  // namespace chainshaper::simulation
