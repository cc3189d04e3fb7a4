// The gate's decisions, worked by hand; tests/gate_conformance.yaml has more, for every gate.

#include "gate/decision.hpp"
#include "gate/queue.hpp"
#include "gate/throttling.hpp"
#include "tests/expect.hpp"

using namespace chainshaper;  // NOLINT

namespace {

Gate gate_with(std::vector<Slot> slots, std::int64_t cycle_ns) {
  Gate gate;
  gate.slots = std::move(slots);
  gate.cycle_ns = cycle_ns;
  return gate;
}

// The schedules of a gate whose second mode is announced at a time.
Schedules switched_at(const Gate & gate, std::int64_t from_ns) {
  Schedules schedules(gate);
  schedules.change(from_ns, &Schedule::mode, std::optional<std::size_t>(1));
  return schedules;
}

void early_messages_wait_and_late_ones_overrun() {
  Gate gate = gate_with({{60, 61}}, 100);
  EXPECT(release_of(gate, 1040, 1000, Schedules(gate), 1040, 0).at_ns == 1060);
  EXPECT(release_of(gate, 1070, 1000, Schedules(gate), 1070, 0).at_ns == 1160);
  EXPECT(release_of(gate, 1070, 1000, Schedules(gate), 1070, 0).overrun == Policy::wait);
  EXPECT(release_of(gate, 1140, 1100, Schedules({0, 0, 10, {}}), 1140, 0).at_ns == 1170);
  gate.overrun = Policy::discard;
  EXPECT(release_of(gate, 1070, 1000, Schedules(gate), 1070, 0).dropped == Dropped::discarded);
}

void slots_count_from_the_phase_where_a_stamp_is_of_no_use() {
  const Gate gate = gate_with({{60, 61}}, 100);
  const auto release =
      release_of(gate, 5040, 1000, Schedules(gate), 5040, 20);  // more than 10 cycles old
  EXPECT(release.anchor == Anchor::cycle);
  EXPECT(release.origin_ns == 5020);
  EXPECT(release.at_ns == 5080);
}

void each_mode_has_its_slot() {
  Gate gate = gate_with({{20, 21}, {60, 61}}, 100);
  gate.modes = {"city", "highway"};
  gate.mode_slots = {1, 0};
  gate.late = Policy::next_slot;
  EXPECT(release_of(gate, 1110, 1100, switched_at(gate, 1050), 1110, 0).at_ns == 1120);
  EXPECT(release_of(gate, 1110, 1100, switched_at(gate, 1150), 1110, 0).at_ns == 1160);
}

void what_is_announced_ahead_gets_later_changes_too() {
  Schedules schedules(Schedule{0, 7, 0, {}});
  schedules.change(200, &Schedule::moved_ns, 10);
  schedules.change(100, &Schedule::phase_ns, 50);
  EXPECT(schedules.in_force(-5).phase_ns == 7);
  EXPECT(schedules.in_force(99).phase_ns == 7);
  EXPECT(schedules.in_force(100).phase_ns == 50 && schedules.in_force(100).moved_ns == 0);
  EXPECT(schedules.in_force(200).phase_ns == 50 && schedules.in_force(200).moved_ns == 10);
  schedules.see_phase(3, 50);  // a good stamp, in a cycle of before
  EXPECT(schedules.in_force(50).phase_ns == 3 && schedules.in_force(100).phase_ns == 50);
  for (std::int64_t from_ns = 300; from_ns < 400; ++from_ns)
    schedules.change(from_ns, &Schedule::moved_ns, from_ns);
  EXPECT(schedules.in_force(0).moved_ns == 400 - schema::schedules);  // the oldest that is known
}

void the_newest_leaves_for_those_before_it() {
  Gate gate = gate_with({{60, 65}}, 100);
  gate.anchor = Anchor::cycle;
  gate.messages = Messages::newest;
  Queue<char> queue(gate);
  EXPECT(!queue.arrive('a', 5, std::nullopt));
  const auto first = queue.decide();
  EXPECT(first.at_ns == 60);
  EXPECT(!queue.arrive('b', 15, std::nullopt));
  EXPECT(queue.replaced(first, 60));
  queue.leave(std::nullopt, 60);
  EXPECT(queue.decide().at_ns == 60);
}

void the_oldest_has_no_room() {
  Gate gate = gate_with({{60, 65}}, 100);
  gate.depth = 1;
  Queue<char> queue(gate);
  EXPECT(!queue.arrive('a', 5, 0));
  const auto full = queue.arrive('b', 15, 10);
  EXPECT(full && full->waiting.message == 'a');
  EXPECT(full->release.dropped == Dropped::overflowed);
}

void gates_without_sense_are_refused() {
  EXPECT_REFUSED(check(gate_with({}, 100)));
  EXPECT_REFUSED(check(gate_with({{0, 101}}, 100)));
  EXPECT_REFUSED(check(gate_with({{10, 20}, {15, 30}}, 100)));
  Gate gate = gate_with({{0, 1}}, 100);
  gate.due_cycles = std::numeric_limits<std::int64_t>::max();
  EXPECT_REFUSED(check(gate));
  gate.due_cycles = 0;
  gate.modes = {"city"};
  EXPECT_REFUSED(check(gate));
}

void one_message_of_a_period_passes() {
  FirstOfPeriod rule{100};
  EXPECT(rule.passes(0));
  EXPECT(!rule.passes(70));
  EXPECT(rule.passes(80));  // early by a fifth of the period
}

}  // namespace

int main() {
  early_messages_wait_and_late_ones_overrun();
  slots_count_from_the_phase_where_a_stamp_is_of_no_use();
  each_mode_has_its_slot();
  what_is_announced_ahead_gets_later_changes_too();
  the_newest_leaves_for_those_before_it();
  the_oldest_has_no_room();
  gates_without_sense_are_refused();
  one_message_of_a_period_passes();
}
