// Callbacks that are gates: core/gate decides; here the gate's thread sleeps, spins and publishes.

#include "simulation/engine.hpp"

namespace chainshaper::simulation {
namespace {

template <typename Number>
std::int64_t number_of(const std::optional<Number> & value) {
  return value ? static_cast<std::int64_t>(*value) : absent;
}

}  // namespace

bool Engine::enter_gate(Thread & thread) {
  GateAtWork & gate = *thread.entity->gate;
  // A message that comes to an idle gate arrives when the gate has taken it.
  const bool was_idle = thread.carried.arrival >= gate.decisions.free_ns;
  gate.arrival = was_idle ? now_ : thread.carried.arrival;
  const Nanoseconds phase = gate.decisions.see_phase(gate.arrival, thread.carried.origin);
  gate.release = gate.decisions.decide({gate.arrival, thread.carried.origin, phase});
  thread.began = now_;
  if (!gate.release.at_ns) return leave_gate(thread);
  thread.step = Step::gate_wake;
  thread.began.reset();
  if (*gate.release.at_ns - gate.spin > now_) sleep(thread, *gate.release.at_ns - gate.spin);
  return true;
}

// Does what follows in a gate when its thread has woken, spun, published or paused.
bool Engine::pass_gate(Thread & thread) {
  GateAtWork & gate = *thread.entity->gate;
  if (thread.step == Step::gate_wake) {
    if (!thread.began) {  // it has just woken
      thread.began = now_;
      look_at_waiting(*thread.entity);
      if (!gate.release.at_ns) return leave_gate(thread);
    }
    if (now_ >= *gate.release.at_ns) return publish_from_gate(thread);
    thread.left = *gate.release.at_ns - now_;  // it spins until then
    return true;
  }
  // The pause must not delay a message that waits already.
  const bool published = thread.step == Step::gate_published;
  if (published && gate.pause > 0 && thread.entity->history.size() == 0) {
    thread.step = Step::gate_paused;
    sleep(thread, later(now_, gate.pause));
    return true;
  }
  return leave_gate(thread);
}

bool Engine::publish_from_gate(Thread & thread) {
  GateAtWork & gate = *thread.entity->gate;
  thread.began = now_;
  if (gate.decisions.gate.policy() == Policy::discard &&
      missed(gate.decisions.gate, gate.release, now_)) {
    gate.release.drop(Dropped::discarded);
    gate.release.overrun = Policy::discard;
    return leave_gate(thread);
  }
  gate.decisions.left(gate.release);
  thread.step = Step::gate_published;
  publish(thread, thread.entity->publishers.front());
  thread.left = draw(*thread.publish);
  return true;
}

// Drops the message at the gate if a newer one that came meanwhile replaces it, or if there is no
// room for another message.
void Engine::look_at_waiting(const Entity & entity) {
  GateAtWork & gate = *entity.gate;
  if (entity.history.size() == entity.description->depth) {
    gate.release.drop(Dropped::overflowed);
    return;
  }
  if (entity.history.size() == 0) return;
  for (const Message * newer = &entity.history.oldest(); newer != nullptr; newer = newer->next) {
    const Nanoseconds arrival = newer->carried.arrival;
    const Nanoseconds phase = gate.decisions.schedules.in_force(arrival).phase_ns;
    if (gate.decisions.is_replaced(gate.release, {arrival, newer->carried.origin, phase}, now_)) {
      gate.release.drop(Dropped::replaced);
      return;
    }
  }
}

bool Engine::leave_gate(Thread & thread) {
  GateAtWork & gate = *thread.entity->gate;
  gate.decisions.free_ns = now_;
  log_release(*thread.entity, thread.began.value_or(now_), thread, thread.carried.source,
              gate.arrival, gate.release);
  return end(thread);
}

// Logs the oldest message of a full history as overflowed.
void Engine::overflow(Entity & entity) {
  const Carried & oldest = entity.history.oldest().carried;
  const Nanoseconds phase = entity.gate->decisions.schedules.in_force(oldest.arrival).phase_ns;
  Release release = entity.gate->decisions.release_at({oldest.arrival, oldest.origin, phase}, now_);
  release.drop(Dropped::overflowed);
  log_release(entity, now_, *entity.executor->threads.front(), oldest.source, oldest.arrival,
              release);
}

void Engine::log_release(const Entity & entity, Nanoseconds time, const Thread & thread,
                         Nanoseconds source, Nanoseconds arrival, const Release & release) {
  const std::int64_t mode = release.mode ? entity.gate->modes[*release.mode] : absent;
  log(TracePoint::release, time, &thread,
      {entity.description->callback, source, arrival, release.origin_ns, number_of(release.at_ns),
       number_of(release.slot), release.cycles_waited, static_cast<std::int64_t>(release.anchor),
       number_of(release.overrun), mode, number_of(release.dropped), release.moved_ns});
}

// Tells a gate the application's mode; a mode that the gate does not know changes nothing.
void Engine::announce(GateAtWork & gate, std::optional<std::int64_t> mode) const {
  if (!mode) return;
  if (const auto known = place_of(gate.modes, *mode)) gate.decisions.switch_mode(*known, now_);
}

}  // namespace chainshaper::simulation
