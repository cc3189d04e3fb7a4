// The discrete-event engine: ROS 2's executors, cores that run threads, and the order of events.
//
// On every core the eligible, runnable thread of the smallest rank runs; among threads of equal
// rank, the one that has waited for longest. A pre-empted thread keeps its place (SCHED_FIFO).
// Where a plan is in force, a thread in a server is eligible while a slot of the server is open,
// and has the server's priority as its rank; where the plan says so, threads of equal rank take
// turns of a quantum (round-robin). Threads outside servers come behind these, by their own
// priority (best effort).
//
// At an instant, three things happen in this order:
//
// 1. Timers expire, messages arrive, sleeps end. So an executor's snapshot has all that happened up
//    to the instant.
// 2. Running threads that have used the CPU time they needed go on.
// 3. Slots open and close. So work that fills a slot exactly is done within it.
//
// Executors. Entities are in the order in which their executor looks at them:
//
// * Single-threaded (rclcpp/src/rclcpp/executor.cpp) and multi-threaded ones
//   (multi_threaded_executor.cpp) work as chainshaper/workload/executor.py says, with services and
//   clients behind subscriptions.
// * Static ones (static_single_threaded_executor.cpp) look at subscriptions first, then at timers,
//   clients and services, and run one callback for each wait set.
// * Events executors (events_executor.cpp) run callbacks in the order in which messages came and
//   timers expired; each of these is an event.
//
// Loops. A thread that is in a loop sleeps until multiples of its period, as a `std::thread` with
// `sleep_until` does; multiples that its instance has missed are left out. What an instance uses
// was stored by callbacks of the process's executor that were over when the instance began.
//
// A message reaches every reader of its topic after a delay, in order. A DDS thread of the reader's
// process may have to work for it first. An asynchronous publisher first hands it to the publisher
// thread of its process.

#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <initializer_list>
#include <optional>
#include <vector>

#include "simulation/agenda.hpp"
#include "simulation/description.hpp"
#include "simulation/event_log.hpp"
#include "simulation/messages.hpp"
#include "simulation/state.hpp"
#include "simulation/streams.hpp"

namespace chainshaper::simulation {

// Why `Engine::run` has returned.
enum class Pause {
  none,           // the number of instants that was asked for has passed
  log_full,       // the caller has to take the log
  messages_full,  // too many messages are under way, so the simulation cannot go on
  endless,        // callbacks cause each other in no time, so the simulation cannot go on
  over,           // the end of the simulation was reached
};

class Engine {
public:
  // Throws std::invalid_argument for a contradictory description. The engine asks `source` for
  // numbers while it runs.
  Engine(Description description, Source source);

  Engine(const Engine &) = delete;
  Engine & operator=(const Engine &) = delete;

  // Goes on until the end, until the caller has to do something, or for `most_instants`.
  Pause run(std::uint64_t most_instants);

  Nanoseconds now() const { return now_; }
  const Description & description() const { return description_; }

  // Returns and empties the log.
  std::vector<EntryColumns> take_log() { return log_.take_all(); }

  // Returns the latency of each recorded instance of the chain; `absent`: it did not complete.
  std::vector<Nanoseconds> latencies() const;

private:
  // engine.cpp: time, and which thread runs
  void happen(const Happening & happening);
  Nanoseconds next_instant() const;
  bool let_one_thread_go_on();
  void run_until_next_step(Core & core) const;
  void charge(Core & core) const;
  void cross_boundary(Core & core) const;
  void reschedule(Core & core);
  void switch_to(Core & core, Thread * thread);
  static void wait(Thread & thread);
  void wake(Thread & thread, Step step);
  void sleep(Thread & thread, Nanoseconds until);
  void queue_up(Thread & thread) { thread.sequence = next_sequence_++; }

  // executors.cpp: what is done next
  void advance(Thread & thread);
  bool go_on_with_callback(Thread & thread);
  void expire(Entity & timer);
  void call_timer(Entity & timer);
  bool is_ready(Entity & entity);
  void collect(Thread & thread);
  void choose(Thread & thread);
  void begin(Thread & thread, Entity & chosen);
  bool takes_turn(Thread & thread);
  void give_turn(Executor & executor);
  void refill(Thread & thread);
  bool take(Thread & thread);
  bool take_message(Thread & thread, Entity & entity);
  void wake_owner(const Executor & executor);

  // callbacks.cpp: what callbacks do. These functions set the thread's next step and the CPU time
  // before it, or let the thread wait. They return whether the callback goes on.
  bool begin_body(Thread & thread);
  bool go_on_publishing(Thread & thread);
  bool end(Thread & thread);
  bool complete(Thread & thread);
  Nanoseconds computing_time(Stream & stream);

  // loops.cpp: threads that are in a loop
  void store(const Thread & thread);
  void begin_instance(Thread & thread);
  void use_stored(Thread & thread);
  void end_instance(Thread & thread);
  void fall_asleep(Thread & thread);

  // gates.cpp: callbacks that are gates
  bool enter_gate(Thread & thread);
  bool pass_gate(Thread & thread);
  bool publish_from_gate(Thread & thread);
  bool leave_gate(Thread & thread);
  void look_at_waiting(const Entity & entity);
  void overflow(Entity & entity);
  void log_release(const Entity & entity, Nanoseconds time, const Thread & thread,
                   Nanoseconds source, Nanoseconds arrival, const Release & release);
  void announce(GateAtWork & gate, std::optional<std::int64_t> mode) const;

  // travel.cpp: how messages travel
  void publish(Thread & thread, Publisher & publisher);
  void hand_over(Thread & thread, Publisher & publisher, Message & message);
  void send(Thread & thread, Message & message);
  void note_latency(const Carried & carried);
  void deliver(Message & message);
  void arrive(Message & message);
  void send_or_receive(Thread & thread);
  void send_next(Thread & thread);
  void put_newest(MessageQueue & queue, std::size_t depth, Message & message);
  void drop_expired(Entity & entity);
  void queue_event(Entity & entity);
  Message & new_message();
  void count_in_use();
  void count_step();

  Nanoseconds draw(Stream & stream) const { return stream.next(source_); }
  void log(TracePoint point, Nanoseconds time, const Thread * thread,
           std::initializer_list<std::int64_t> fields);

  // setup.cpp: from the description
  void set_up_threads();
  void set_up_entities();
  void set_up_publishers();
  void set_up_loops();

  Description description_;
  Source source_;
  std::vector<Stream> streams_;
  std::vector<Core> cores_;
  std::vector<Thread> threads_;
  std::vector<Executor> executors_;  // of the processes
  std::vector<Entity> entities_;
  std::vector<Publisher> publishers_;
  std::deque<GateAtWork> gates_;
  std::vector<Synchroniser> synchronisers_;
  std::vector<LoopAtWork> loops_;
  std::deque<bool> groups_;  // whether each callback group is busy

  Nanoseconds now_{0};
  std::uint64_t next_sequence_{0};
  Agenda agenda_;
  MessagePool messages_;
  std::size_t queued_entries_{0};  // in Executor::events and Thread::to_send of all
  EventLog log_;
  Pause pause_{Pause::none};
  std::uint64_t steps_{0};  // of threads and of the engine at this instant
  std::vector<Nanoseconds> latencies_;
  std::size_t started_{0};  // recorded instances of the chain
};

// Returns a time plus a duration, or `forever` if that is less.
inline Nanoseconds later(Nanoseconds time, Nanoseconds duration) {
  return duration >= forever - time ? forever : time + duration;
}

}  // namespace chainshaper::simulation
