#include <algorithm>
#include <utility>

#include "simulation/engine.hpp"

namespace chainshaper::simulation {
namespace {

Step first_step(Role role, bool first_of_executor) {
  switch (role) {
    case Role::publisher:
      return Step::send;
    case Role::dds:
      return Step::receive;
    case Role::loop:
      return Step::begin_instance;
    case Role::executor:
      break;
  }
  return first_of_executor ? Step::collect : Step::turn;
}

Description checked(Description description) {
  check(description);
  return description;
}

}  // namespace

Engine::Engine(Description description, Source source)
    : description_(checked(std::move(description))),
      source_(std::move(source)),
      groups_(description_.groups, false),
      log_(description_.log_rows),
      latencies_(description_.instances, absent) {
  for (Place place = 0; place < description_.streams.size(); ++place)
    streams_.emplace_back(description_.streams[place], place);
  for (const auto & core : description_.cores) cores_.emplace_back(core);
  for (const auto & gate : description_.gates) gates_.emplace_back(gate);
  for (const auto & described : description_.synchronisers) {
    Synchroniser & synchroniser = synchronisers_.emplace_back();
    synchroniser.trigger = described.trigger;
    for (const auto & input : described.inputs)
      synchroniser.inputs.push_back({input.on_chain, input.depth, {}});
  }
  for (const auto & loop : description_.loops) {
    loops_.push_back({&loop, nullptr, {}});
    loops_.back().inputs.resize(loop.inputs);
  }
  // They will point to each other, so each list gets its size before the first pointer is taken.
  threads_.resize(description_.threads.size());
  executors_.resize(description_.processes.size());
  entities_.resize(description_.entities.size());
  publishers_.resize(description_.publishers.size());
  set_up_publishers();
  set_up_entities();
  set_up_threads();
  set_up_loops();
}

void Engine::set_up_threads() {
  for (Place place = 0; place < threads_.size(); ++place) {
    Thread & thread = threads_[place];
    const ThreadDescription & description = description_.threads[place];
    Executor & executor = executors_[description.process];
    thread.rank = description.rank;
    thread.server = description.server ? std::uint64_t{1} << *description.server : 0;
    thread.place = static_cast<std::int32_t>(place);
    thread.core = &cores_[description.core];
    thread.executor = &executor;
    thread.wake_up = &streams_[description.wake_up];
    thread.take = &streams_[description.take];
    thread.publish = &streams_[description.publish];
    thread.receive = description.receive ? &streams_[*description.receive] : nullptr;
    thread.delivery = &streams_[description.delivery];
    thread.core->threads.push_back(&thread);
    thread.step = first_step(description.role, executor.threads.empty());
    if (description.role == Role::executor) {
      executor.threads.push_back(&thread);
      executor.owner = executor.threads.front();
    }
    if (description.role == Role::publisher && executor.publisher_thread == nullptr)
      executor.publisher_thread = &thread;
    if (description.role == Role::dds && executor.dds_thread == nullptr)
      executor.dds_thread = &thread;
  }
}

void Engine::set_up_entities() {
  for (Place place = 0; place < executors_.size(); ++place) {
    const ProcessDescription & description = description_.processes[place];
    executors_[place].kind = description.executor;
    executors_[place].entities =
        std::span(entities_).subspan(description.first_entity, description.entity_count);
  }
  std::vector<std::pair<Nanoseconds, Entity *>> expiries;
  for (Place place = 0; place < entities_.size(); ++place) {
    Entity & entity = entities_[place];
    const EntityDescription & description = description_.entities[place];
    const bool of_gate = description.body == Body::gate || description.body == Body::mode_listener;
    entity.description = &description;
    entity.executor = &executors_[description.process];
    entity.group_is_busy = description.group ? &groups_[*description.group] : nullptr;
    entity.execution = &streams_[description.execution];
    entity.afterwards = description.afterwards ? &streams_[*description.afterwards] : nullptr;
    entity.publishers =
        std::span(publishers_).subspan(description.first_publisher, description.publisher_count);
    entity.gate = of_gate ? &gates_[description.gate] : nullptr;
    entity.synchroniser =
        description.body == Body::synchronise ? &synchronisers_[description.synchroniser] : nullptr;
    const bool of_loop = description.kind == EntityKind::loop || description.body == Body::store;
    entity.loop = of_loop ? &loops_[description.loop] : nullptr;
    entity.due = description.due_ns;
    if (description.kind == EntityKind::timer) expiries.emplace_back(description.due_ns, &entity);
  }
  std::sort(expiries.begin(), expiries.end());  // of the same time, in the order of the list
  for (const auto & [due, entity] : expiries) agenda_.plan(due, Expiry{entity});
}

// Lets the threads that are in loops sleep until the first instance.
void Engine::set_up_loops() {
  for (Entity & entity : entities_)
    if (entity.description->kind == EntityKind::loop) entity.loop->entity = &entity;
  for (LoopAtWork & loop : loops_) {
    Thread & thread = threads_[loop.description->thread];
    thread.loop = &loop;
    if (loop.entity->due <= loop.description->last_ns)
      agenda_.plan(loop.entity->due, SleepOver{&thread});
  }
}

void Engine::set_up_publishers() {
  for (Place place = 0; place < publishers_.size(); ++place) {
    Publisher & publisher = publishers_[place];
    publisher.description = &description_.publishers[place];
    publisher.place = static_cast<std::int64_t>(place);
    for (const auto & reader : publisher.description->readers) {
      publisher.readers.push_back(
          {&entities_[reader.entity], reader.delivery ? &streams_[*reader.delivery] : nullptr});
    }
  }
}

}  // namespace chainshaper::simulation
