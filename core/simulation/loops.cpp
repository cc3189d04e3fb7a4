// Threads that are in a loop: they sleep, wake up, use what was stored, compute, and publish.

#include "simulation/engine.hpp"

namespace chainshaper::simulation {
namespace {

constexpr std::int64_t clock_nanosleep = 1;  // as `SLEEPING_CALLS` in event_declarations.py says

}  // namespace

// Stores the message of an executor's thread for the loop of its process.
void Engine::store(const Thread & thread) {
  const Entity & entity = *thread.entity;
  LoopAtWork::Stored & stored = entity.loop->inputs[entity.description->input];
  if (stored.since < now_) stored.before = stored.newest;
  stored.newest = thread.carried;
  stored.since = now_;
}

// Begins an instance of the thread's loop, when the thread has slept.
void Engine::begin_instance(Thread & thread) {
  const bool timers_ended = thread.loop->entity->due > description_.last_timer_ns;
  if (timers_ended && !thread.loop->has_news(now_)) return fall_asleep(thread);
  thread.loop->begun = now_;
  log(TracePoint::wake, now_, &thread, {clock_nanosleep, thread.used});
  use_stored(thread);
  thread.entity = thread.loop->entity;
  if (thread.entity->description->starts_chain && now_ >= description_.record_from_ns) {
    thread.carried.chain_start = now_;
    thread.carried.instance = started_++;
  }
  begin_body(thread);
}

// Gives the thread what the newest message of each input carries: the stamp of the first, and the
// chain of the one that is on it. Its first use is the reaction to a message; when it is used
// again, it is not on the chain any more.
void Engine::use_stored(Thread & thread) {
  thread.carried = Carried{};
  thread.carried.origin = now_;
  auto & inputs = thread.loop->inputs;
  for (Place input = 0; input < inputs.size(); ++input) {
    auto & used = inputs[input].since < now_ ? inputs[input].newest : inputs[input].before;
    if (!used) continue;
    if (input == 0) thread.carried.origin = used->origin;
    if (!used->chain_start) continue;
    thread.carried.chain_start = used->chain_start;
    thread.carried.instance = used->instance;
    used->chain_start.reset();
  }
}

// Ends an instance of the thread's loop.
void Engine::end_instance(Thread & thread) {
  if (thread.loop->description->ends_chain) note_latency(thread.carried);
}

// Lets the thread sleep until the first multiple of its period that is not over yet.
void Engine::fall_asleep(Thread & thread) {
  const LoopAtWork & loop = *thread.loop;
  Entity & entity = *loop.entity;
  const Nanoseconds period = entity.description->period_ns;
  const Nanoseconds over = now_ - later(entity.due, period);
  const Nanoseconds missed = over <= 0 ? 0 : (over - 1) / period + 1;
  entity.due = later(entity.due + missed * period, period);
  log(TracePoint::sleep, now_, &thread, {entity.due, clock_nanosleep, thread.used});
  thread.step = Step::begin_instance;
  if (entity.due == now_) return;  // the call returns at once
  wait(thread);
  if (entity.due <= loop.description->last_ns) agenda_.plan(entity.due, SleepOver{&thread});
}

}  // namespace chainshaper::simulation
