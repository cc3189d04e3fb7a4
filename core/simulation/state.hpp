// What changes while an application is simulated: cores, threads, executors, callbacks, topics.
//
// They point to their parts of the description and to each other, so none of them is ever moved in
// memory.

#pragma once

#include <algorithm>
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
struct LoopAtWork;

struct Core {
  explicit Core(const CoreDescription & described)
      : table(described.table),
        open_servers(described.open_servers),
        next(described.next),
        boundary(described.boundary_ns) {}

  std::vector<Thread *> threads;
  std::vector<OpenServers> table;
  std::uint64_t open_servers;
  Place next;            // the row of the table that comes into force next
  Nanoseconds boundary;  // when it does
  Thread * running{nullptr};
  Thread * ran_last{nullptr};  // the thread that ran last, also while the core is idle
  Nanoseconds since{0};        // the CPU time of the running thread is counted up to this time
  Nanoseconds until{forever};  // when the running thread has to be looked at
  Nanoseconds quantum{0};      // what is left of the running thread's turn
  bool changed{true};          // whether another thread may have to run
};

// What a thread does next, when it has used the CPU time that is left to it.
enum class Step {
  // Of an executor's thread:
  collect,  // look for what is ready
  turn,     // execute what is next, after waiting for other threads of the executor
  take,     // take the message of the chosen entity and begin its callback
  publish,  // publish, or end the callback
  gate_wake,
  gate_published,
  gate_paused,
  // Of a publisher thread:
  send,
  sent,
  // Of a thread of DDS:
  receive,
  received,
  // Of a thread in a loop:
  begin_instance,
};

struct Thread {
  std::int64_t rank;     // the thread with the smallest rank runs
  std::uint64_t server;  // the bit of its server in Core::open_servers; 0: it runs at any time
  std::int32_t place;    // in the list of threads
  Core * core;
  Executor * executor;  // of its process, also if it runs no callbacks
  Stream * wake_up;
  Stream * take;
  Stream * publish;
  Stream * receive;
  Stream * delivery;
  Step step;

  bool runnable{false};
  bool preempted{false};
  Nanoseconds left{0};               // CPU time to the next step
  Nanoseconds used{0};               // CPU time so far
  std::uint64_t sequence{0};         // of threads of equal rank, that with the smallest runs
  Entity * entity{nullptr};          // the entity whose callback it runs
  std::size_t publication{0};        // how many of the entity's publishers have published
  Publisher * sending{nullptr};      // of a publisher thread
  std::deque<Publisher *> to_send;   // of a publisher thread
  MessageQueue to_receive;           // of a thread of DDS
  LoopAtWork * loop{nullptr};        // in which it is
  Carried carried;                   // what the message at which it works carries
  std::optional<Nanoseconds> began;  // when it began to send, or its gate woke up
};

struct Executor {
  ExecutorKind kind;
  std::span<Entity> entities;
  std::vector<Thread *> threads;
  Thread * publisher_thread{nullptr};  // none: nothing is published asynchronously
  Thread * dds_thread{nullptr};        // none: receiving takes no CPU time
  // The thread that waits for work or chooses a callback; none: all its threads run callbacks.
  Thread * owner{nullptr};
  std::deque<Entity *> events;  // of an events executor: the entities to run, in order
};

// A gate in a callback. Messages wait for it in the history of its reader.
struct GateAtWork {
  explicit GateAtWork(const GateDescription & described)
      : decisions(described.gate),
        modes(described.modes),
        spin(described.spin_ns),
        pause(described.pause_ns) {
    for (const auto & [from_ns, by_ns] : described.moves) decisions.move_slots(by_ns, from_ns);
  }

  Decisions decisions;
  std::vector<std::int64_t> modes;  // the application's number of each of the gate's modes
  Nanoseconds spin;
  Nanoseconds pause;
  Nanoseconds arrival{0};  // of the message that it holds
  Release release{};       // the decision about that message
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

// A loop, and what the executor of its process has stored for it.
struct LoopAtWork {
  // What the newest message of an input carries, and the newest one from before the instant
  // `since`. An instance that begins at that instant uses the latter.
  struct Stored {
    std::optional<Carried> newest;
    std::optional<Carried> before;
    Nanoseconds since{-1};
  };

  // Whether an instance that begins now has something that the one before had not.
  bool has_news(Nanoseconds now) const {
    return std::any_of(inputs.begin(), inputs.end(), [&](const Stored & stored) {
      return stored.since >= begun && stored.since < now;
    });
  }

  const LoopDescription * description;
  Entity * entity{nullptr};
  std::vector<Stored> inputs;
  Nanoseconds begun{0};  // when the last instance began
};

struct Entity {
  const EntityDescription * description;
  Executor * executor;
  bool * group_is_busy;  // of its callback group; none: it may always run
  Stream * execution;
  Stream * afterwards;
  std::span<Publisher> publishers;
  GateAtWork * gate;
  Synchroniser * synchroniser;
  LoopAtWork * loop;  // whose entity it is, or for which its callback stores messages

  MessageQueue history;
  Nanoseconds due;    // of a timer or loop
  bool ready{false};  // in the executor's snapshot

  bool may_run() const { return group_is_busy == nullptr || !*group_is_busy; }
};

struct ReaderOf {
  Entity * entity;
  Stream * delivery;            // none: that of the sending thread
  Nanoseconds last_arrival{0};  // DDS delivers the messages of a publisher in order
};

struct Publisher {
  const PublisherDescription * description;
  std::int64_t place;  // in the list of publishers
  std::vector<ReaderOf> readers;
  MessageQueue history;  // messages that wait for the publisher thread
  std::uint64_t published{0};
};

}  // namespace chainshaper::simulation
