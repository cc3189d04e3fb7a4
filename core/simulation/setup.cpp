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
    : given_(checked(std::move(description))),
      source_(std::move(source)),
      groups_(given_.groups, false),
      log_(given_.log_rows),
      latencies_(given_.instances, absent) {
  for (Place place = 0; place < given_.streams.size(); ++place)
    streams_.emplace_back(given_.streams[place], place);
  for (const auto & core : given_.cores) cores_.emplace_back(core);
  for (const auto & gate : given_.gates) gates_.emplace_back(gate);
  for (const auto & described : given_.synchronisers) {
    Synchroniser & synchroniser = synchronisers_.emplace_back();
    synchroniser.trigger = described.trigger;
    for (const auto & input : described.inputs)
      synchroniser.inputs.push_back({input.on_chain, input.depth, {}});
  }
  // Pointers lead from one to the other: each list has its size before any is taken.
  threads_.resize(given_.threads.size());
  executors_.resize(given_.processes.size());
  entities_.resize(given_.entities.size());
  publishers_.resize(given_.publishers.size());
  set_up_publishers();
  set_up_entities();
  set_up_threads();
}

void Engine::set_up_threads() {
  for (Place place = 0; place < threads_.size(); ++place) {
    Thread & thread = threads_[place];
    const ThreadDescription & given = given_.threads[place];
    Executor & executor = executors_[given.process];
    thread.rank = given.rank;
    thread.server = given.server ? std::uint64_t{1} << *given.server : 0;
    thread.place = static_cast<std::int32_t>(place);
    thread.core = &cores_[given.core];
    thread.executor = &executor;
    thread.wake_up = &streams_[given.wake_up];
    thread.take = &streams_[given.take];
    thread.publish = &streams_[given.publish];
    thread.receive = given.receive ? &streams_[*given.receive] : nullptr;
    thread.delivery = &streams_[given.delivery];
    thread.core->threads.push_back(&thread);
    thread.step = first_step(given.role, executor.threads.empty());
    if (given.role == Role::executor) {
      executor.threads.push_back(&thread);
      executor.owner = executor.threads.front();
    }
    if (given.role == Role::publisher && executor.publisher_thread == nullptr)
      executor.publisher_thread = &thread;
    if (given.role == Role::dds && executor.dds_thread == nullptr) executor.dds_thread = &thread;
  }
}

void Engine::set_up_entities() {
  for (Place place = 0; place < executors_.size(); ++place) {
    const ProcessDescription & given = given_.processes[place];
    executors_[place].kind = given.executor;
    executors_[place].entities =
        std::span(entities_).subspan(given.first_entity, given.entity_count);
  }
  std::vector<std::pair<Nanoseconds, Entity *>> expiries;
  for (Place place = 0; place < entities_.size(); ++place) {
    Entity & entity = entities_[place];
    const EntityDescription & given = given_.entities[place];
    const bool of_gate = given.body == Body::gate || given.body == Body::mode_listener;
    entity.given = &given;
    entity.executor = &executors_[given.process];
    entity.group_is_busy = given.group ? &groups_[*given.group] : nullptr;
    entity.execution = &streams_[given.execution];
    entity.afterwards = given.afterwards ? &streams_[*given.afterwards] : nullptr;
    entity.publishers =
        std::span(publishers_).subspan(given.first_publisher, given.publisher_count);
    entity.gate = of_gate ? &gates_[given.gate] : nullptr;
    entity.synchroniser =
        given.body == Body::synchronise ? &synchronisers_[given.synchroniser] : nullptr;
    entity.due = given.due_ns;
    if (given.kind == EntityKind::timer) expiries.emplace_back(given.due_ns, &entity);
  }
  std::sort(expiries.begin(), expiries.end());  // of the same time, in the order of the list
  for (const auto & [due, entity] : expiries) agenda_.plan(due, Expiry{entity});
}

void Engine::set_up_publishers() {
  for (Place place = 0; place < publishers_.size(); ++place) {
    Publisher & publisher = publishers_[place];
    publisher.given = &given_.publishers[place];
    publisher.place = static_cast<std::int64_t>(place);
    for (const auto & reader : publisher.given->readers) {
      publisher.readers.push_back(
          {&entities_[reader.entity], reader.delivery ? &streams_[*reader.delivery] : nullptr});
    }
  }
}

}  // namespace chainshaper::simulation
