#include "simulation/engine.hpp"

#include <algorithm>

namespace chainshaper::simulation {

Pause Engine::run(std::uint64_t most_instants) {
  if (pause_ == Pause::messages_full || pause_ == Pause::endless) return pause_;
  pause_ = Pause::none;
  for (std::uint64_t instants = 0; instants < most_instants && pause_ == Pause::none; ++instants) {
    const Nanoseconds instant = next_instant();
    if (instant > description_.stop_ns) return Pause::over;
    if (instant > now_) steps_ = 0;
    now_ = instant;
    count_step();
    while (agenda_.next_time() <= now_) happen(agenda_.take_next());
    // A thread that goes on may plan something for this instant, so only one goes on at a time.
    if (let_one_thread_go_on()) continue;
    for (Core & core : cores_) {
      if (core.boundary <= now_) cross_boundary(core);
      if (core.changed) reschedule(core);
    }
  }
  return pause_;
}

std::vector<Nanoseconds> Engine::latencies() const {
  const auto count = std::min(started_, latencies_.size());
  return {latencies_.begin(), latencies_.begin() + static_cast<std::ptrdiff_t>(count)};
}

void Engine::count_step() {
  constexpr std::uint64_t most = 1'000'000;  // more than any application needs at an instant
  if (++steps_ > most) pause_ = Pause::endless;
}

void Engine::happen(const Happening & happening) {
  if (const auto * delivery = std::get_if<Delivery>(&happening))
    deliver(*delivery->message);
  else if (const auto * expiry = std::get_if<Expiry>(&happening))
    expire(*expiry->timer);
  else if (const auto * sleep = std::get_if<SleepOver>(&happening))
    wake(*sleep->thread, sleep->thread->step);
}

Nanoseconds Engine::next_instant() const {
  Nanoseconds instant = agenda_.next_time();
  for (const Core & core : cores_) {
    if (core.changed) return now_;
    instant = std::min({instant, core.until, core.boundary});
  }
  return instant;
}

// Lets a single running thread go on that has used the CPU time for its step, or its quantum.
// Returns whether there is one.
bool Engine::let_one_thread_go_on() {
  for (Core & core : cores_) {
    if (core.until > now_) continue;
    Thread & thread = *core.running;
    charge(core);
    if (thread.left == 0) {
      advance(thread);
    } else if (core.quantum <= 0) {
      queue_up(thread);
      core.quantum = description_.quantum_ns;
      core.changed = true;
    }
    run_until_next_step(core);
    return true;
  }
  return false;
}

// Sets when the running thread has to be looked at again.
void Engine::run_until_next_step(Core & core) const {
  core.until = forever;
  if (core.running == nullptr || !core.running->runnable) return;
  const Nanoseconds left = core.running->left;
  const bool takes_turns = core.running->server != 0;
  core.until = later(now_, takes_turns ? std::min(left, core.quantum) : left);
}

// Counts the CPU time that the running thread has used since this was called last.
void Engine::charge(Core & core) const {
  if (core.running == nullptr) return;
  const Nanoseconds used = now_ - core.since;
  core.running->left -= used;
  core.running->used += used;
  core.quantum -= used;
  core.since = now_;
}

// Opens and closes servers; sets the next boundary, which may be in the next cycle.
void Engine::cross_boundary(Core & core) const {
  const OpenServers & row = core.table[core.next];
  core.open_servers = row.servers;
  Nanoseconds elapsed = -row.offset_ns;
  if (++core.next == core.table.size()) {
    core.next = 0;
    elapsed += description_.cycle_ns;
  }
  core.boundary = later(core.boundary, elapsed + core.table[core.next].offset_ns);
  core.changed = true;
}

namespace {

bool is_eligible(const Core & core, const Thread & thread) {
  return thread.runnable && (thread.server == 0 || (core.open_servers & thread.server) != 0);
}

bool goes_before(const Thread & thread, const Thread * best) {
  if (best == nullptr) return true;
  if (thread.rank != best->rank) return thread.rank < best->rank;
  return thread.sequence < best->sequence;
}

}  // namespace

// Lets the eligible thread of the smallest rank and sequence run.
void Engine::reschedule(Core & core) {
  core.changed = false;
  charge(core);
  Thread * best = nullptr;
  for (Thread * thread : core.threads)
    if (is_eligible(core, *thread) && goes_before(*thread, best)) best = thread;
  if (best != core.running) switch_to(core, best);
  run_until_next_step(core);
}

void Engine::switch_to(Core & core, Thread * thread) {
  Thread * before = core.running;
  const bool was_runnable = before != nullptr && before->runnable;
  if (was_runnable) before->preempted = true;
  if (description_.switches) {
    log(TracePoint::context_switch, now_, thread,
        {&core - cores_.data(), before == nullptr ? absent : before->place, was_runnable ? 1 : 0});
  }
  core.running = thread;
  if (thread == nullptr) return;
  if (thread->preempted) thread->left = later(thread->left, description_.preemption_ns);
  thread->preempted = false;
  if (thread != core.ran_last) thread->left = later(thread->left, description_.context_switch_ns);
  core.ran_last = thread;
  core.since = now_;
  core.quantum = description_.quantum_ns;
}

// Stops running a thread that has nothing to do.
void Engine::wait(Thread & thread) {
  thread.runnable = false;
  thread.core->changed = true;
}

// Makes a thread runnable, behind all threads of its rank, if it waits and `step` is its next step.
void Engine::wake(Thread & thread, Step step) {
  if (thread.runnable || thread.step != step) return;
  thread.runnable = true;
  thread.left = later(thread.left, draw(*thread.wake_up));
  queue_up(thread);
  thread.core->changed = true;
}

void Engine::sleep(Thread & thread, Nanoseconds until) {
  wait(thread);
  agenda_.plan(until, SleepOver{&thread});
}

void Engine::log(TracePoint point, Nanoseconds time, const Thread * thread,
                 std::initializer_list<std::int64_t> fields) {
  if (!description_.events || time < description_.record_from_ns) return;
  const auto place = thread == nullptr ? static_cast<std::int32_t>(absent) : thread->place;
  if (log_.add(point, time, place, fields) >= description_.log_rows && pause_ == Pause::none)
    pause_ = Pause::log_full;
}

}  // namespace chainshaper::simulation
