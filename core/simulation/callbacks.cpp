// What callbacks do: compute, publish, synchronise inputs. Gates are in gates.cpp.

#include "simulation/engine.hpp"

namespace chainshaper::simulation {

// Begins the callback of the thread's entity.
bool Engine::begin_body(Thread & thread) {
  const Entity & entity = *thread.entity;
  thread.publication = 0;
  thread.step = Step::publish;
  switch (entity.given->body) {
    case Body::gate:
      return enter_gate(thread);
    case Body::mode_listener:
      announce(*entity.gate, thread.carried.mode);
      return end(thread);
    case Body::synchronise:
      if (!complete(thread)) return end(thread);
      break;
    case Body::compute:
      break;
  }
  thread.left = computing_time(*entity.execution);
  return true;
}

// Publishes on the next topic, or computes what comes behind them, or ends the callback.
bool Engine::go_on_publishing(Thread & thread) {
  const Entity & entity = *thread.entity;
  const std::size_t place = thread.publication++;
  if (place < entity.publishers.size()) {
    publish(thread, entity.publishers[place]);
    thread.left = draw(*thread.publish);
    return true;
  }
  if (place == entity.publishers.size() && entity.afterwards != nullptr) {
    thread.left = computing_time(*entity.afterwards);
    return true;
  }
  return end(thread);
}

// Draws a CPU time and adds the share that interrupts take meanwhile.
Nanoseconds Engine::computing_time(Stream & stream) {
  constexpr Nanoseconds million = 1'000'000;
  const Nanoseconds time = draw(stream);
  Nanoseconds product = 0;
  if (!__builtin_mul_overflow(time, given_.interrupts_ppm, &product))
    return later(time, product / million);
  const auto longer = static_cast<__int128>(time) * given_.interrupts_ppm / million;
  return later(time, longer < forever ? static_cast<Nanoseconds>(longer) : forever);
}

bool Engine::end(Thread & thread) {
  log(TracePoint::callback_end, now_, &thread, {thread.entity->given->callback, thread.used});
  return false;
}

namespace {

// Whether there is a message of each input.
bool has_set(const Synchroniser & synchroniser) {
  for (const auto & input : synchroniser.inputs)
    if (input.messages.size() == 0) return false;
  return true;
}

}  // namespace

// Adds the message to its synchroniser's input; whether that completes a set.
//
// A set has the oldest message of every input, and the stamp of the first one's. Where one input
// triggers, the others have their newest one only, which stays for the next message of that input.
bool Engine::complete(Thread & thread) {
  Synchroniser & synchroniser = *thread.entity->synchroniser;
  const Place place = thread.entity->given->input;
  Synchroniser::Input & input = synchroniser.inputs[place];
  Message & added = new_message();
  added.carried = thread.carried;
  put_newest(input.messages, input.depth, added);
  if (synchroniser.trigger && *synchroniser.trigger != place) return false;
  if (!has_set(synchroniser)) {
    if (synchroniser.trigger) messages_.give_back(input.messages.take_oldest());
    return false;
  }
  thread.carried.chain_start.reset();
  for (Place source = 0; source < synchroniser.inputs.size(); ++source) {
    auto & [on_chain, depth, queue] = synchroniser.inputs[source];
    const bool stays = synchroniser.trigger && *synchroniser.trigger != source;
    Message & message = stays ? queue.oldest() : queue.take_oldest();
    if (source == 0) thread.carried.origin = message.carried.origin;
    if (on_chain) {
      thread.carried.chain_start = message.carried.chain_start;
      thread.carried.instance = message.carried.instance;
    }
    if (!stays) messages_.give_back(message);
  }
  return true;
}

}  // namespace chainshaper::simulation
