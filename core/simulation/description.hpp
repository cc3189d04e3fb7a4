// What is simulated: an application's processes, threads, callbacks and topics, as plain values.
//
// Parts refer to each other by their places in the lists of a `Description`. Python fills it in
// (chainshaper/simulation/machine.py) and `check` refuses one that makes no sense. All times are
// nanoseconds of the one clock that a simulated machine has.

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
  Place next{0};                     // the row of the table that comes into force next,
  Nanoseconds boundary_ns{forever};  // then
};

// Who works in a thread: an executor's callbacks, the asynchronous publishers of its process, or
// DDS on what the process receives.
enum class Role { executor, publisher, dds };

struct ThreadDescription {
  Place core{0};
  std::int64_t rank{0};               // the smaller one runs
  std::optional<std::size_t> server;  // of its core; none: it runs at any time
  Role role{Role::executor};
  Place process{0};
  Place wake_up{0};     // streams of CPU times (ns): from being woken to being at work,
  Place take{0};        // from choosing a message to its callback,
  Place publish{0};     // of a publication, or of sending one;
  MaybePlace receive;   // of a message received: threads of DDS have it.
  Place delivery{0};    // Until a message is at the subscriber's process.
  std::int32_t pid{0};  // what events say of the thread
  std::int32_t tid{0};
  std::int32_t cpu{0};
};

// In which order the executor of a process does what is ready: engine.hpp says what each does.
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
  std::int64_t callback{0};  // handles, as events have them
  std::int64_t handle{0};
  std::int64_t rmw_handle{0};
  Place process{0};
  EntityKind kind{EntityKind::subscription};
  MaybePlace group;  // mutually exclusive callback group; none: it may always run
  Body body{Body::compute};
  Place gate{0};          // of a gate, or of a listener for its modes
  Place synchroniser{0};  // of an input of one, which is its
  Place input{0};
  Nanoseconds period_ns{1};  // of timers,
  Nanoseconds due_ns{0};     // whose first expiry this is
  Place execution{0};        // streams of CPU times: of the callback up to its publications
  MaybePlace afterwards;     // and behind them; none: it ends with its last publication
  Place first_publisher{0};  // it publishes with these, in their order
  Place publisher_count{0};
  std::optional<Nanoseconds> lifespan_ns;  // messages that have waited for longer are gone
  std::size_t depth{1};                    // messages in the history of its reader
  bool starts_chain{false};                // each instance of its callback begins one of the chain
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
  // From when on slots are moved from where the gate has them, and by how much.
  std::vector<std::pair<Nanoseconds, Nanoseconds>> moves;
  Nanoseconds spin_ns{0};   // it watches the clock for so long before a release
  Nanoseconds pause_ns{0};  // and rests for so long behind a publication
};

// Inputs come together: a set has a message of each. It is complete when the last one comes; with a
// `trigger`, at each message of that input, with the newest ones of the others.
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
  Nanoseconds cycle_ns{0};           // of the plan in force; 0: none is
  Nanoseconds quantum_ns{forever};   // equals take turns after so long; forever: they do not
  Nanoseconds context_switch_ns{0};  // CPU time that it costs the thread switched to
  Nanoseconds preemption_ns{0};      // and the thread that is resumed
  std::int64_t interrupts_ppm{0};    // callbacks take so much longer because of interrupts
  Nanoseconds last_timer_ns{0};      // timers expire until then
  Nanoseconds stop_ns{0};
  Nanoseconds record_from_ns{0};    // events and instances of the chain count from then on
  bool events{true};                // they are logged
  bool switches{false};             // and so is every context switch
  std::size_t instances{0};         // the latencies of so many instances of the chain are kept
  std::size_t log_rows{131'072};    // the engine pauses when it has so many entries of a kind
  std::size_t most_messages{4096};  // more under way: messages pile up without end
};

// Throws std::invalid_argument where a place is not in its list or a number makes no sense.
void check(const Description & description);

}  // namespace chainshaper::simulation
