// What the threads of an executor do next, and what an expiry or a message makes them do.

#include <algorithm>

#include "simulation/engine.hpp"

namespace chainshaper::simulation {

// Does the next steps of a running thread whose CPU time for the present step is used up.
void Engine::advance(Thread & thread) {
  while (thread.runnable && thread.left == 0 && pause_ != Pause::endless) {
    count_step();
    switch (thread.step) {
      case Step::begin_instance:
        begin_instance(thread);
        break;
      case Step::collect:
        collect(thread);
        break;
      case Step::turn:
        choose(thread);
        break;
      case Step::send:
      case Step::sent:
      case Step::receive:
      case Step::received:
        send_or_receive(thread);
        break;
      case Step::take:
      case Step::publish:
      case Step::gate_wake:
      case Step::gate_published:
      case Step::gate_paused:
        if (go_on_with_callback(thread)) break;
        if (thread.loop != nullptr) {
          fall_asleep(thread);
          break;
        }
        if (thread.entity->group_is_busy != nullptr) {
          *thread.entity->group_is_busy = false;
          wake_owner(*thread.executor);
        }
        choose(thread);
    }
  }
}

bool Engine::go_on_with_callback(Thread & thread) {
  if (thread.step == Step::take) return take(thread);
  if (thread.step == Step::publish) return go_on_publishing(thread);
  return pass_gate(thread);
}

// Handles a timer's expiry: the executor sees it in its next snapshot, or gets an event.
void Engine::expire(Entity & timer) {
  if (timer.executor->kind == ExecutorKind::events) {
    queue_event(timer);
    call_timer(timer);
  }
  if (timer.may_run()) wake_owner(*timer.executor);
}

// Moves on to the first expiry that is not over yet, as `rcl_timer_call` does.
void Engine::call_timer(Entity & timer) {
  const Nanoseconds period = timer.description->period_ns;
  const Nanoseconds over = now_ - timer.due;
  const Nanoseconds missed = over <= 0 ? 0 : (over - 1) / period;
  timer.due = later(timer.due + missed * period, period);
  if (timer.due <= description_.last_timer_ns) agenda_.plan(timer.due, Expiry{&timer});
}

bool Engine::is_ready(Entity & entity) {
  if (entity.description->kind == EntityKind::timer)
    return entity.due <= std::min(now_, description_.last_timer_ns);
  drop_expired(entity);
  return entity.history.size() > 0;
}

// Fills the wait set and takes a snapshot of what is ready; waits if nothing is.
void Engine::collect(Thread & thread) {
  Executor & executor = *thread.executor;
  bool any_ready = !executor.events.empty();
  if (executor.kind != ExecutorKind::events) {
    for (Entity & entity : executor.entities) {
      entity.ready = entity.may_run() && is_ready(entity);
      any_ready = any_ready || entity.ready;
    }
  }
  if (any_ready)
    choose(thread);
  else
    wait(thread);
}

namespace {

// Takes the first entity that may run out of the snapshot; none: there is no such entity.
Entity * first_ready(const Executor & executor) {
  Entity * chosen = nullptr;
  for (Entity & entity : executor.entities) {
    if (!entity.ready) continue;
    if (chosen == nullptr) {
      entity.ready = false;
      if (entity.may_run()) chosen = &entity;
    } else if (executor.kind == ExecutorKind::static_single_threaded) {
      entity.ready = false;  // one callback per wait set
    }
  }
  return chosen;
}

}  // namespace

// Begins to execute the next entity of the snapshot; if there is none, a new snapshot comes next.
void Engine::choose(Thread & thread) {
  Executor & executor = *thread.executor;
  if (executor.kind == ExecutorKind::multi_threaded && !takes_turn(thread)) return;
  Entity * chosen = nullptr;
  if (executor.kind != ExecutorKind::events) {
    chosen = first_ready(executor);
  } else if (!executor.events.empty()) {
    chosen = executor.events.front();
    executor.events.pop_front();
    --queued_entries_;
  }
  if (chosen == nullptr)
    refill(thread);
  else
    begin(thread, *chosen);
}

void Engine::begin(Thread & thread, Entity & chosen) {
  Executor & executor = *thread.executor;
  log(TracePoint::execute, now_, &thread, {chosen.description->handle});
  thread.entity = &chosen;
  thread.step = Step::take;
  if (chosen.description->kind != EntityKind::timer)
    thread.left = draw(*thread.take);
  else if (executor.kind != ExecutorKind::events)  // those call a timer when it expires
    call_timer(chosen);
  if (executor.kind != ExecutorKind::multi_threaded) return;
  if (chosen.group_is_busy != nullptr) *chosen.group_is_busy = true;
  give_turn(executor);
}

// Makes the thread the one that waits or chooses, and returns true; or, if another thread is that,
// lets it queue up.
bool Engine::takes_turn(Thread & thread) {
  Executor & executor = *thread.executor;
  if (executor.owner == nullptr || executor.owner == &thread) {
    executor.owner = &thread;
    return true;
  }
  thread.step = Step::turn;
  queue_up(thread);
  wait(thread);
  return false;
}

// Wakes the thread that has queued up for longest; yet another one may take the turn before it.
void Engine::give_turn(Executor & executor) {
  executor.owner = nullptr;
  Thread * longest = nullptr;
  for (Thread * thread : executor.threads) {
    const bool queues = !thread->runnable && thread->step == Step::turn;
    if (queues && (longest == nullptr || thread->sequence < longest->sequence)) longest = thread;
  }
  if (longest != nullptr) wake(*longest, Step::turn);
}

void Engine::refill(Thread & thread) {
  thread.step = Step::collect;
  if (thread.executor->kind == ExecutorKind::events) return;
  Nanoseconds due = description_.stop_ns;
  for (const Entity & entity : thread.executor->entities)
    if (entity.description->kind == EntityKind::timer && entity.due <= description_.last_timer_ns)
      due = std::min(due, entity.due);
  log(TracePoint::wait, now_, &thread, {std::max<Nanoseconds>(0, due - now_)});
}

// Takes the message of the chosen entity and begins its callback; returns whether that goes on.
bool Engine::take(Thread & thread) {
  Entity & entity = *thread.entity;
  if (entity.description->kind == EntityKind::timer) {
    thread.carried.chain_start.reset();
    thread.carried.origin = now_;
  } else if (!take_message(thread, entity)) {
    return false;
  }
  if (entity.description->starts_chain && now_ >= description_.record_from_ns) {
    thread.carried.chain_start = now_;
    thread.carried.instance = started_++;
  }
  log(TracePoint::callback_start, now_, &thread, {entity.description->callback, thread.used, 0});
  return begin_body(thread);
}

bool Engine::take_message(Thread & thread, Entity & entity) {
  drop_expired(entity);
  if (entity.history.size() == 0) {
    thread.carried.chain_start.reset();
    log(TracePoint::take, now_, &thread, {entity.description->rmw_handle, 0, 0, 0});
    return false;
  }
  Message & message = entity.history.take_oldest();
  thread.carried = message.carried;
  if (!entity.description->on_chain) thread.carried.chain_start.reset();
  log(TracePoint::take, now_, &thread,
      {entity.description->rmw_handle, message.address, message.carried.source, 1});
  messages_.give_back(message);
  return true;
}

// Wakes the thread that waits for work of an executor, as something may be ready.
void Engine::wake_owner(const Executor & executor) {
  if (executor.owner != nullptr) wake(*executor.owner, Step::collect);
}

}  // namespace chainshaper::simulation
