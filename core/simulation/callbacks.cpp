// What callbacks do: compute, publish, synchronise inputs. Gates are in gates.cpp.

#include "simulation/engine.hpp"

namespace chainshaper::simulation {

// Begins the callback of the thread's entity.
bool Engine::begin_body(Thread & thread) {
  const Entity & entity = *thread.entity;
  thread.publication = 0;
  thread.step = Step::publish;
  switch (entity.description->body) {
    case Body::gate:
      return enter_gate(thread);
    case Body::mode_listener:
      announce(*entity.gate, thread.carried.mode);
      return end(thread);
    case Body::synchronise:
      if (!complete(thread)) return end(thread);
      break;
    case Body::store:
      store(thread);
      return end(thread);
    case Body::compute:
      break;
  }
  thread.left = computing_time(*entity.execution);
  return true;
}

// Publishes with the next publisher; after the last one computes again, or ends the callback.
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
  if (!__builtin_mul_overflow(time, description_.interrupts_ppm, &product))
    return later(time, product / million);
  const auto longer = static_cast<__int128>(time) * description_.interrupts_ppm / million;
  return later(time, longer < forever ? static_cast<Nanoseconds>(longer) : forever);
}

bool Engine::end(Thread & thread) {
  if (thread.loop != nullptr) {
    end_instance(thread);
    return false;
  }
  log(TracePoint::callback_end, now_, &thread, {thread.entity->description->callback, thread.used});
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

// Adds the thread's message to its input of the synchroniser; returns whether a set is complete.
//
// A set has the oldest message of every input, and the stamp of the first input's message. With a
// trigger, the other inputs have only their newest message, which stays there for the next set.
bool Engine::complete(Thread & thread) {
  Synchroniser & synchroniser = *thread.entity->synchroniser;
  const Place place = thread.entity->description->input;
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
