// What changes while an application is simulated: cores, threads, executors, callbacks, topics.
//
// Each has its part of the description, and points to what it works with. None of them moves.

#pragma once

#include <cstdint>
#include <deque>
#include <optional>
#include <span>
#include <vector>

#include "gate/queue.hpp"
#include "simulation/description.hpp"
#include "simulation/messages.hpp"
#include "simulation/streams.hpp"

namespace chainshaper::simulation {

struct Thread;
struct Executor;

struct Core {
  explicit Core(const CoreDescription & described)
      : table(described.table),
        open_servers(described.open_servers),
        next(described.next),
        boundary(described.boundary_ns) {}

  std::vector<Thread *> threads;
  std::vector<OpenServers> table;
  std::uint64_t open_servers;
  Place next;            // the row of the table that comes into force
  Nanoseconds boundary;  // then
  Thread * running{nullptr};
  Thread * ran_last{nullptr};  // before it idled, perhaps
  Nanoseconds since{0};        // what the running thread has used up to then is accounted for
  Nanoseconds until{forever};  // then the running thread has to be looked at
  Nanoseconds quantum{0};      // what is left of its turn
  bool changed{true};          // another thread may have to run
};

// What a thread does next, when it has used the CPU time that is left to it.
enum class Step {
  collect,  // an executor: look for what is ready,
  turn,     // after it has waited for other threads of its executor;
  take,     // take what was chosen and begin its callback,
  publish,  // publish, or end the callback;
  gate_wake,
  gate_published,
  gate_paused,
  send,  // a publisher thread
  sent,
  receive,  // a thread of DDS
  received,
};

struct Thread {
  std::int64_t rank;     // the smaller one runs
  std::uint64_t server;  // its bit among those that are open; 0: it runs at any time
  std::int32_t place;    // in the list of threads
  Core * core;
  Executor * executor;  // of its process, also where others than callbacks run in it
  Stream * wake_up;
  Stream * take;
  Stream * publish;
  Stream * receive;
  Stream * delivery;
  Step step;

  bool runnable{false};
  bool preempted{false};
  Nanoseconds left{0};           // CPU time to the next step
  Nanoseconds used{0};           // CPU time so far
  std::uint64_t sequence{0};     // the smaller one goes first among those of its rank
  Entity * entity{nullptr};      // whose callback runs
  std::size_t publication{0};    // how many of its publishers have published; one more: all is done
  Publisher * sending{nullptr};  // of a publisher thread
  std::deque<Publisher *> to_send;   // of a publisher thread
  MessageQueue to_receive;           // of a thread of DDS
  Carried carried;                   // by its present message
  std::optional<Nanoseconds> began;  // sending, or the gate woke
};

struct Executor {
  ExecutorKind kind;
  std::span<Entity> entities;
  std::vector<Thread *> threads;
  Thread * publisher_thread{nullptr};  // none: nothing is published asynchronously
  Thread * dds_thread{nullptr};        // none: receiving takes no CPU time
  Thread * owner{nullptr};             // waits, or takes what is next; none: all execute
  std::deque<Entity *> events;         // of an events executor, in the order of happening
};

// A gate in a callback: its messages wait in the history of its reader.
struct GateAtWork {
  explicit GateAtWork(const GateDescription & described)
      : turns(described.gate),
        modes(described.modes),
        spin(described.spin_ns),
        pause(described.pause_ns) {
    for (const auto & [from_ns, by_ns] : described.moves) turns.move_slots(by_ns, from_ns);
  }

  Turns turns;
  std::vector<std::int64_t> modes;  // the number of each in the application
  Nanoseconds spin;
  Nanoseconds pause;
  Nanoseconds arrival{0};  // of the message that it holds
  Release release{};       // what was decided about it
};

struct Synchroniser {
  struct Input {
    bool on_chain;
    std::size_t depth;
    MessageQueue messages;
  };
  std::vector<Input> inputs;
  MaybePlace trigger;
};

struct Entity {
  const EntityDescription * given;
  Executor * executor;
  bool * group_is_busy;  // none: it may always run
  Stream * execution;
  Stream * afterwards;
  std::span<Publisher> publishers;
  GateAtWork * gate;
  Synchroniser * synchroniser;

  MessageQueue history;
  Nanoseconds due;    // of a timer
  bool ready{false};  // in the executor's snapshot

  bool may_run() const { return group_is_busy == nullptr || !*group_is_busy; }
};

struct ReaderOf {
  Entity * entity;
  Stream * delivery;            // none: that of the sending thread
  Nanoseconds last_arrival{0};  // DDS delivers what comes from one publisher in order
};

struct Publisher {
  const PublisherDescription * given;
  std::int64_t place;  // in the list of publishers
  std::vector<ReaderOf> readers;
  MessageQueue history;  // what waits for the publisher thread
  std::uint64_t published{0};
};

}  // namespace chainshaper::simulation
