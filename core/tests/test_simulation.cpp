// Small applications whose schedules are worked by hand. Times are ns; what is not named costs
// none.

#include <algorithm>
#include <map>
#include <utility>

#include "simulation/engine.hpp"
#include "tests/expect.hpp"

using namespace chainshaper;              // NOLINT
using namespace chainshaper::simulation;  // NOLINT

namespace {

using Times = std::vector<Nanoseconds>;
constexpr Place no_time = 0;  // the stream of zeros

// An application that is built up piece by piece.
struct Built {
  Description all;

  Built() {
    all.streams = {{0}};
    all.stop_ns = 1000;
    all.last_timer_ns = 900;
    all.cores.resize(1);
  }

  Place time(Nanoseconds value) {
    all.streams.push_back({value});
    return all.streams.size() - 1;
  }

  // A process with a thread of that rank on the first core; entities come next.
  Place process(std::int64_t rank) {
    all.processes.push_back({ExecutorKind::single_threaded, all.entities.size(), 0});
    ThreadDescription thread;
    thread.rank = rank;
    thread.process = all.processes.size() - 1;
    all.threads.push_back(thread);
    return thread.process;
  }

  EntityDescription & entity(EntityKind kind, Nanoseconds execution) {
    EntityDescription described;
    described.kind = kind;
    described.process = all.processes.size() - 1;
    described.execution = time(execution);
    described.first_publisher = all.publishers.size();
    described.callback = static_cast<std::int64_t>(all.entities.size());
    ++all.processes.back().entity_count;
    all.entities.push_back(described);
    return all.entities.back();
  }

  EntityDescription & timer(Nanoseconds period, Nanoseconds due, Nanoseconds execution) {
    EntityDescription & described = entity(EntityKind::timer, execution);
    described.period_ns = period;
    described.due_ns = due;
    return described;
  }

  // The last entity publishes to that one.
  PublisherDescription & publishes_to(std::vector<Reader> readers) {
    PublisherDescription described;
    described.readers = std::move(readers);
    all.publishers.push_back(described);
    ++all.entities.back().publisher_count;
    return all.publishers.back();
  }
};

Times none_drawn(Place) { throw std::logic_error("all streams are constant"); }

Times column(const Column<Nanoseconds> & numbers, std::size_t count) {
  return {numbers.get(), numbers.get() + count};
}

// When callbacks with that number ended.
Times ends_of(const std::vector<EntryColumns> & log, std::int64_t callback) {
  const auto & ended = log[static_cast<std::size_t>(TracePoint::callback_end)];
  Times times;
  for (std::size_t row = 0; row < ended.count; ++row)
    if (ended.fields[0][row] == callback) times.push_back(ended.times[row]);
  return times;
}

std::vector<EntryColumns> run(const Description & description) {
  Engine engine(description, none_drawn);
  EXPECT(engine.run(1'000'000) == Pause::over);
  return engine.take_log();
}

void the_more_urgent_thread_preempts() {
  Built built;
  built.process(2);
  built.timer(1000, 100, 50);
  built.process(1);
  built.timer(1000, 120, 20);
  const auto log = run(built.all);
  EXPECT(ends_of(log, 1) == Times{140});
  EXPECT(ends_of(log, 0) == Times{170});
}

void a_message_travels_along_the_chain() {
  Built built;
  built.process(1);
  built.timer(400, 100, 50).starts_chain = true;
  built.publishes_to({{1, built.time(7)}});
  built.process(1);
  built.all.threads.back().take = built.time(3);
  built.entity(EntityKind::subscription, 20).on_chain = true;
  built.publishes_to({}).ends_chain = true;
  built.all.instances = 5;
  built.all.stop_ns = 970;
  Engine engine(built.all, none_drawn);
  EXPECT(engine.run(1'000'000) == Pause::over);
  EXPECT(ends_of(engine.take_log(), 1) == (Times{180, 580}));
  EXPECT(engine.latencies() == (Times{80, 80, absent}));  // the third one is not done then
}

void a_thread_runs_while_its_server_is_open() {
  Built built;
  built.process(1);
  built.timer(1000, 105, 30);
  built.all.threads.back().server = 0;
  built.all.cycle_ns = 100;
  built.all.cores[0].table = {{0, 1}, {20, 0}};
  built.all.cores[0].boundary_ns = 0;
  const auto log = run(built.all);
  EXPECT(ends_of(log, 0) == Times{215});  // 15 of it up to 120, the rest from 200 on
}

void equals_take_turns_in_a_server() {
  Built built;
  for (auto count = 0; count < 2; ++count) {
    built.process(1);
    built.timer(1000, 100, 30);
    built.all.threads.back().server = 0;
  }
  built.all.cycle_ns = 1000;
  built.all.cores[0].table = {{0, 1}};
  built.all.cores[0].boundary_ns = 0;
  built.all.quantum_ns = 20;
  const auto log = run(built.all);
  EXPECT(ends_of(log, 0) == Times{150});
  EXPECT(ends_of(log, 1) == Times{160});
}

void a_gate_holds_a_message_until_its_slot() {
  Built built;
  built.process(1);
  built.timer(400, 100, 5);
  built.publishes_to({{1, no_time}});
  built.process(1);
  EntityDescription & shaper = built.entity(EntityKind::subscription, 0);
  shaper.body = Body::gate;
  shaper.depth = 10;
  built.publishes_to({});
  GateDescription gate;
  gate.gate.slots = {{30, 40}};
  gate.gate.cycle_ns = 100;
  built.all.gates = {gate};
  const auto log = run(built.all);
  const auto & published = log[static_cast<std::size_t>(TracePoint::publish)];
  EXPECT((column(published.times, published.count) == Times{105, 130, 505, 530, 905, 930}));
  const auto & released = log[static_cast<std::size_t>(TracePoint::release)];
  EXPECT((column(released.fields[4], released.count) == Times{130, 530, 930}));  // `release`
}

void a_full_history_loses_its_oldest_message() {
  Built built;
  built.process(1);
  for (auto count = 0; count < 3; ++count) {
    built.timer(2000, 100, 0);
    built.publishes_to({{3, no_time}});
  }
  built.process(2);
  built.entity(EntityKind::subscription, 10).depth = 2;
  const auto log = run(built.all);
  EXPECT((ends_of(log, 3) == Times{110, 120}));
}

void a_set_is_complete_with_the_last_input() {
  Built built;
  built.process(1);
  built.timer(2000, 100, 0);
  built.publishes_to({{2, no_time}});
  built.timer(2000, 150, 0);
  built.publishes_to({{3, no_time}});
  built.process(1);
  for (Place input = 0; input < 2; ++input) {
    EntityDescription & described = built.entity(EntityKind::subscription, 10);
    described.body = Body::synchronise;
    described.input = input;
  }
  built.all.synchronisers = {{{{false, 1}, {false, 1}}, {}}};
  const auto log = run(built.all);
  EXPECT(ends_of(log, 2) == Times{100});  // it only left its message
  EXPECT(ends_of(log, 3) == Times{160});
}

void messages_that_pile_up_end_it() {
  Built built;
  built.process(1);
  built.timer(1, 100, 0);
  built.publishes_to({{1, built.time(forever)}});
  built.process(1);
  built.entity(EntityKind::subscription, 0);
  built.all.most_messages = 100;
  Engine engine(built.all, none_drawn);
  EXPECT(engine.run(1'000'000) == Pause::messages_full);
  EXPECT(engine.run(1'000'000) == Pause::messages_full);
}

void callbacks_that_call_each_other_in_no_time_end_it() {
  Built built;
  built.process(1);
  built.timer(1000, 100, 0);
  built.publishes_to({{1, no_time}});
  built.process(1);
  built.entity(EntityKind::subscription, 0);
  built.publishes_to({{1, no_time}});
  built.all.events = false;
  Engine engine(built.all, none_drawn);
  EXPECT(engine.run(100'000'000) == Pause::endless);
}

void what_makes_no_sense_is_refused() {
  Built built;
  built.process(1);
  built.timer(100, 100, 5);
  built.publishes_to({});
  const Description sound = built.all;
  const auto refused = [&](auto change) {
    Description wrong = sound;
    change(wrong);
    EXPECT_REFUSED(Engine(wrong, none_drawn));
  };
  refused([](Description & all) { all.entities[0].execution = 99; });
  refused([](Description & all) { all.entities[0].period_ns = 0; });
  refused([](Description & all) { all.entities[0].publisher_count = 2; });
  refused([](Description & all) { all.entities[0].body = Body::gate; });
  refused([](Description & all) { all.publishers[0].readers = {{0, {}}}; });
  refused([](Description & all) { all.publishers[0].asynchronous = true; });
  refused([](Description & all) { all.threads.clear(); });
  refused([](Description & all) { all.threads[0].core = 1; });
  refused([](Description & all) { all.processes[0].entity_count = 2; });
  refused([](Description & all) { all.streams[0].constant_ns = -1; });
  refused([](Description & all) { all.stop_ns = -1; });
}

void numbers_are_asked_for_when_they_are_needed() {
  Built built;
  built.process(1);
  built.timer(100, 100, 0);
  built.all.streams.push_back({});
  built.all.entities[0].execution = built.all.streams.size() - 1;
  Engine engine(built.all, [](Place) { return Times{5, 7}; });
  EXPECT(engine.run(1'000'000) == Pause::over);
  const auto ends = ends_of(engine.take_log(), 0);
  EXPECT((Times(ends.begin(), ends.begin() + 4) == Times{105, 207, 305, 407}));
  Engine ended(built.all, [](Place) { return Times{}; });
  EXPECT_REFUSED(ended.run(1'000'000));
}

}  // namespace

int main() {
  the_more_urgent_thread_preempts();
  a_message_travels_along_the_chain();
  a_thread_runs_while_its_server_is_open();
  equals_take_turns_in_a_server();
  a_gate_holds_a_message_until_its_slot();
  a_full_history_loses_its_oldest_message();
  a_set_is_complete_with_the_last_input();
  messages_that_pile_up_end_it();
  callbacks_that_call_each_other_in_no_time_end_it();
  what_makes_no_sense_is_refused();
  numbers_are_asked_for_when_they_are_needed();
}
