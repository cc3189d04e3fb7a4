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

void early_messages_wait_and_late_ones_overrun() {
  Gate gate = gate_with({{60, 61}}, 100);
  EXPECT(release_of(gate, 1040, 1000, {}, 1040, 0).at_ns == 1060);
  EXPECT(release_of(gate, 1070, 1000, {}, 1070, 0).at_ns == 1160);
  EXPECT(release_of(gate, 1070, 1000, {}, 1070, 0).overrun == Policy::wait);
  EXPECT(release_of(gate, 1140, 1100, {}, 1140, 0, {{1050, 10}}).at_ns == 1170);
  gate.overrun = Policy::discard;
  EXPECT(release_of(gate, 1070, 1000, {}, 1070, 0).dropped == Dropped::discarded);
}

void slots_count_from_the_phase_where_a_stamp_is_of_no_use() {
  const Gate gate = gate_with({{60, 61}}, 100);
  const auto release = release_of(gate, 5040, 1000, {}, 5040, 20);  // more than 10 cycles old
  EXPECT(release.anchor == Anchor::cycle);
  EXPECT(release.origin_ns == 5020);
  EXPECT(release.at_ns == 5080);
}

void each_mode_has_its_slot() {
  Gate gate = gate_with({{20, 21}, {60, 61}}, 100);
  gate.modes = {"city", "highway"};
  gate.bands = {1, 0};
  gate.late = Policy::next_slot;
  EXPECT(release_of(gate, 1110, 1100, {{1050, 1}}, 1110, 0).at_ns == 1120);
  EXPECT(release_of(gate, 1110, 1100, {{1150, 1}}, 1110, 0).at_ns == 1160);
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
  the_newest_leaves_for_those_before_it();
  the_oldest_has_no_room();
  gates_without_sense_are_refused();
  one_message_of_a_period_passes();
}
