// What is simulated: an application's processes, threads, callbacks and topics, as plain values.
//
// Parts refer to each other by their places in the lists of a `Description`. Python fills it in
// (chainshaper/simulation/machine.py) and `check` refuses a contradictory one. All times are
// nanoseconds of the only clock that a simulated machine has.

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

// From an offset in the cycle on, these servers of a core are open; bit n stands for server n.
struct OpenServers {
  Nanoseconds offset_ns;
  std::uint64_t servers;
};

struct CoreDescription {
  std::vector<OpenServers> table;    // in force again and again; empty: no plan governs this core
  std::uint64_t open_servers{0};     // at the start
  Place next{0};                     // the row of the table that comes into force next
  Nanoseconds boundary_ns{forever};  // when it does
};

// What a thread does: it runs an executor's callbacks, sends for the asynchronous publishers of its
// process, or receives messages for DDS.
enum class Role { executor, publisher, dds };

struct ThreadDescription {
  Place core{0};
  std::int64_t rank{0};               // the smaller one runs
  std::optional<std::size_t> server;  // of its core; none: it runs at any time
  Role role{Role::executor};
  Place process{0};
  // Streams of CPU times:
  Place wake_up{0};    // from being woken to being at work
  Place take{0};       // from choosing a message to the beginning of its callback
  Place publish{0};    // of publishing a message, or of sending it
  MaybePlace receive;  // of receiving a message; threads of DDS have it
  // Stream of delays:
  Place delivery{0};  // from sending a message until it is at the subscriber's process
  // In its events:
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

// What an executor waits for.
enum class EntityKind { timer, subscription, service, client };

// What the callback of an entity does.
enum class Body { compute, gate, mode_listener, synchronise };

struct EntityDescription {
  // Handles, as events have them:
  std::int64_t callback{0};
  std::int64_t handle{0};
  std::int64_t rmw_handle{0};
  Place process{0};
  EntityKind kind{EntityKind::subscription};
  MaybePlace group;  // mutually exclusive callback group; none: it may always run
  Body body{Body::compute};
  Place gate{0};             // if it is a gate, or listens for the modes of one
  Place synchroniser{0};     // if it is an input of one
  Place input{0};            // which input of the synchroniser it is
  Nanoseconds period_ns{1};  // of a timer
  Nanoseconds due_ns{0};     // when a timer expires first
  Place execution{0};        // stream of CPU times of the callback before it publishes
  MaybePlace afterwards;     // the same after it has published; none: it ends then
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
  std::vector<std::int64_t> modes;  // that it announces in turn; empty: none
};

struct GateDescription {
  Gate gate;
  std::vector<std::int64_t> modes;  // the number of each of the gate's modes in the application
  // Shifts of all slots against the gate's: the time from which each holds, and how far it is.
  std::vector<std::pair<Nanoseconds, Nanoseconds>> moves;
  Nanoseconds spin_ns{0};   // for how long it watches the clock before a release
  Nanoseconds pause_ns{0};  // for how long it rests after a publication
};

// A synchroniser makes sets of messages, one of each input. A set is complete when its last message
// comes. With a `trigger`, each message of that input completes a set, with the newest messages of
// all other inputs.
struct SynchroniserDescription {
  struct Input {
    bool on_chain{false};
    std::size_t depth{1};
  };
  std::vector<Input> inputs;
  MaybePlace trigger;
};

// A sequence of CPU times or delays: a constant, or numbers that are asked for in blocks.
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
  std::vector<StreamDescription> streams;
  std::size_t groups{0};
  Nanoseconds cycle_ns{0};           // of the plan in force; 0: no plan is
  Nanoseconds quantum_ns{forever};   // how long a turn takes; `forever`: equals take no turns
  Nanoseconds context_switch_ns{0};  // CPU time that switching costs the thread switched to
  Nanoseconds preemption_ns{0};      // CPU time that resuming costs a thread that was pre-empted
  std::int64_t interrupts_ppm{0};    // by how much interrupts make callbacks longer
  Nanoseconds last_timer_ns{0};      // timers expire until then
  Nanoseconds stop_ns{0};
  Nanoseconds record_from_ns{0};    // events and instances of the chain count from then on
  bool events{true};                // whether events are logged
  bool switches{false};             // whether context switches are logged
  std::size_t instances{0};         // of how many instances of the chain latencies are kept
  std::size_t log_rows{131'072};    // the engine pauses when the log has so many rows of a kind
  std::size_t most_messages{4096};  // if more are under way, messages pile up without end
};

// Throws std::invalid_argument if a place is not in its list, or a number is not possible.
void check(const Description & description);

}  // namespace chainshaper::simulation
