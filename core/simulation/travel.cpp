// How messages travel: from a publication to the histories of its readers.

#include <algorithm>

#include "simulation/engine.hpp"

namespace chainshaper::simulation {
namespace {

// Addresses of messages repeat, as they do in a real process.
constexpr std::uint64_t addresses = 64;
constexpr std::int64_t first_address = 0x7F00'0000'0000;
constexpr std::int64_t distance = 0x480;

std::int64_t next_address(const Publisher & publisher) {
  const auto number = static_cast<std::int64_t>(publisher.published % addresses);
  return first_address + (publisher.place * std::int64_t{addresses} + number) * distance;
}

}  // namespace

// Publishes a message with what the thread carries.
void Engine::publish(Thread & thread, Publisher & publisher) {
  const PublisherDescription & description = *publisher.description;
  Message & message = new_message();
  message.publisher = &publisher;
  message.address = next_address(publisher);
  message.carried = thread.carried;
  message.carried.source = now_;
  message.carried.mode.reset();
  if (!description.modes.empty())
    message.carried.mode = description.modes[publisher.published % description.modes.size()];
  ++publisher.published;
  log(TracePoint::publish, now_, &thread,
      {description.handle, description.rmw_handle, message.address, now_});
  if (description.asynchronous)
    hand_over(*thread.executor->publisher_thread, publisher, message);
  else
    send(thread, message);
}

// Queues an asynchronous publisher's message for the publisher thread.
void Engine::hand_over(Thread & sender, Publisher & publisher, Message & message) {
  if (publisher.history.size() < publisher.description->depth) {
    sender.to_send.push_back(&publisher);
    ++queued_entries_;
    count_in_use();
  } else {  // the oldest message is lost; its entry in `to_send` serves for the new one
    log(TracePoint::send, now_, &sender,
        {publisher.description->rmw_handle, publisher.history.oldest().carried.source,
         static_cast<std::int64_t>(SendOutcome::overwritten), 0});
  }
  put_newest(publisher.history, publisher.description->depth, message);
  wake(sender, Step::send);
}

// Sends a message now; each reader gets a copy.
void Engine::send(Thread & thread, Message & message) {
  if (message.publisher->description->ends_chain) note_latency(message.carried);
  for (ReaderOf & reader : message.publisher->readers) {
    Message & copy = new_message();
    copy = message;
    copy.entity = reader.entity;
    const Nanoseconds duration =
        draw(reader.delivery != nullptr ? *reader.delivery : *thread.delivery);
    reader.last_arrival = std::max(later(now_, duration), reader.last_arrival);
    if (reader.last_arrival == now_)
      deliver(copy);
    else
      agenda_.plan(reader.last_arrival, Delivery{&copy});
  }
  messages_.give_back(message);
}

// Notes that an instance of the chain ends, unless it has ended before.
void Engine::note_latency(const Carried & carried) {
  if (!carried.chain_start || carried.instance >= latencies_.size()) return;
  Nanoseconds & latency = latencies_[carried.instance];
  if (latency == absent) latency = now_ - *carried.chain_start;
}

// Brings a message to its reader's process, where a DDS thread may have to spend time on it.
void Engine::deliver(Message & message) {
  Thread * receiver = message.entity->executor->dds_thread;
  if (receiver == nullptr) {
    arrive(message);
  } else {
    receiver->to_receive.append(message);
    wake(*receiver, Step::receive);
  }
}

// Puts a message into its reader's history, and wakes the executor if it waits for work.
void Engine::arrive(Message & message) {
  Entity & entity = *message.entity;
  const bool overwrites = entity.history.size() == entity.description->depth;
  message.carried.arrival = now_;
  if (overwrites && entity.description->body == Body::gate) overflow(entity);
  put_newest(entity.history, entity.description->depth, message);
  // The event of an overwritten message is still in the queue, and serves for this message.
  if (entity.executor->kind == ExecutorKind::events && !overwrites) queue_event(entity);
  if (entity.may_run()) wake_owner(*entity.executor);
}

// Does the next step of a publisher thread or a DDS thread.
void Engine::send_or_receive(Thread & thread) {
  switch (thread.step) {
    case Step::sent: {
      const Nanoseconds began = thread.began.value_or(now_);
      log(TracePoint::send, began, &thread,
          {thread.sending->description->rmw_handle, thread.carried.source,
           static_cast<std::int64_t>(SendOutcome::sent), now_ - began});
      thread.step = Step::send;
      break;
    }
    case Step::received:
      arrive(thread.to_receive.take_oldest());
      thread.step = Step::receive;
      break;
    case Step::receive:
      if (thread.to_receive.size() == 0) return wait(thread);
      thread.left = draw(*thread.receive);
      thread.step = Step::received;
      break;
    default:
      if (thread.to_send.empty()) return wait(thread);
      send_next(thread);
  }
}

void Engine::send_next(Thread & thread) {
  Publisher & publisher = *thread.to_send.front();
  thread.to_send.pop_front();
  --queued_entries_;
  Message & message = publisher.history.take_oldest();
  const Nanoseconds source = message.carried.source;
  const auto & lifespan = publisher.description->lifespan_ns;
  if (lifespan && now_ - source > *lifespan) {
    log(TracePoint::send, now_, &thread,
        {publisher.description->rmw_handle, source, static_cast<std::int64_t>(SendOutcome::expired),
         0});
    messages_.give_back(message);
    return;
  }
  thread.began = now_;
  thread.carried.source = source;
  thread.sending = &publisher;
  send(thread, message);
  thread.left = draw(*thread.publish);
  thread.step = Step::sent;
}

// Appends a message to a queue; a full queue loses its oldest message.
void Engine::put_newest(MessageQueue & queue, std::size_t depth, Message & message) {
  if (queue.size() == depth) messages_.give_back(queue.take_oldest());
  queue.append(message);
}

// Forgets messages that have waited in a history for longer than their lifespan.
void Engine::drop_expired(Entity & entity) {
  const auto & lifespan = entity.description->lifespan_ns;
  if (!lifespan) return;
  while (entity.history.size() > 0 && now_ - entity.history.oldest().carried.arrival > *lifespan)
    messages_.give_back(entity.history.take_oldest());
}

// Appends an entity to the queue of its events executor.
void Engine::queue_event(Entity & entity) {
  entity.executor->events.push_back(&entity);
  ++queued_entries_;
  count_in_use();
}

Message & Engine::new_message() {
  Message & message = messages_.take();
  count_in_use();
  return message;
}

void Engine::count_in_use() {
  if (messages_.in_use() + queued_entries_ >= description_.most_messages)
    pause_ = Pause::messages_full;
}

}  // namespace chainshaper::simulation
