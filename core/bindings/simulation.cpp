#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <utility>

#include "bindings/records.hpp"
#include "simulation/engine.hpp"

namespace chainshaper::bindings {
namespace {

using namespace simulation;  // NOLINT(google-build-using-namespace): all of it is bound here

using Pairs = std::vector<std::pair<std::int64_t, std::int64_t>>;
using Constants = std::vector<std::optional<Nanoseconds>>;

void bind_kinds(nb::module_ & module) {
  nb::enum_<Role>(module, "Role", "What a thread is for.")
      .value("executor", Role::executor)
      .value("publisher", Role::publisher)
      .value("dds", Role::dds)
      .value("loop", Role::loop);
  nb::enum_<ExecutorKind>(module, "ExecutorKind", "In which order an executor runs callbacks.")
      .value("single_threaded", ExecutorKind::single_threaded)
      .value("static_single_threaded", ExecutorKind::static_single_threaded)
      .value("events", ExecutorKind::events)
      .value("multi_threaded", ExecutorKind::multi_threaded);
  nb::enum_<EntityKind>(module, "EntityKind", "What an executor waits for.")
      .value("timer", EntityKind::timer)
      .value("subscription", EntityKind::subscription)
      .value("service", EntityKind::service)
      .value("client", EntityKind::client)
      .value("loop", EntityKind::loop);
  nb::enum_<Body>(module, "Body", "What a callback does.")
      .value("compute", Body::compute)
      .value("gate", Body::gate)
      .value("mode_listener", Body::mode_listener)
      .value("synchronise", Body::synchronise)
      .value("store", Body::store);
  nb::enum_<Pause>(module, "Pause", "Why `Simulation.run` has returned.")
      .value("none", Pause::none)
      .value("log_full", Pause::log_full)
      .value("messages_full", Pause::messages_full)
      .value("endless", Pause::endless)
      .value("over", Pause::over);
}

void bind_machine(nb::module_ & module) {
  record<CoreDescription>(module, "CoreDescription", "A core, and which servers are open on it.")
      .def_prop_rw(
          "table",
          [](const CoreDescription & core) {
            std::vector<std::pair<Nanoseconds, std::uint64_t>> rows;
            for (const auto & row : core.table) rows.emplace_back(row.offset_ns, row.servers);
            return rows;
          },
          [](CoreDescription & core,
             const std::vector<std::pair<Nanoseconds, std::uint64_t>> & rows) {
            core.table.clear();
            for (const auto & [offset, servers] : rows) core.table.push_back({offset, servers});
          })
      .def_rw("open_servers", &CoreDescription::open_servers)
      .def_rw("next", &CoreDescription::next)
      .def_rw("boundary_ns", &CoreDescription::boundary_ns);
  record<ThreadDescription>(module, "ThreadDescription", "A thread of a process.")
      .def_rw("core", &ThreadDescription::core)
      .def_rw("rank", &ThreadDescription::rank)
      .def_rw("server", &ThreadDescription::server, nb::arg().none())
      .def_rw("role", &ThreadDescription::role)
      .def_rw("process", &ThreadDescription::process)
      .def_rw("wake_up", &ThreadDescription::wake_up)
      .def_rw("take", &ThreadDescription::take)
      .def_rw("publish", &ThreadDescription::publish)
      .def_rw("receive", &ThreadDescription::receive, nb::arg().none())
      .def_rw("delivery", &ThreadDescription::delivery)
      .def_rw("pid", &ThreadDescription::pid)
      .def_rw("tid", &ThreadDescription::tid)
      .def_rw("cpu", &ThreadDescription::cpu);
  record<ProcessDescription>(module, "ProcessDescription", "A process: its executor.")
      .def_rw("executor", &ProcessDescription::executor)
      .def_rw("first_entity", &ProcessDescription::first_entity)
      .def_rw("entity_count", &ProcessDescription::entity_count);
}

void bind_callbacks(nb::module_ & module) {
  record<EntityDescription>(module, "EntityDescription", "A timer or subscription, its callback.")
      .def_rw("callback", &EntityDescription::callback)
      .def_rw("handle", &EntityDescription::handle)
      .def_rw("rmw_handle", &EntityDescription::rmw_handle)
      .def_rw("process", &EntityDescription::process)
      .def_rw("kind", &EntityDescription::kind)
      .def_rw("group", &EntityDescription::group, nb::arg().none())
      .def_rw("body", &EntityDescription::body)
      .def_rw("gate", &EntityDescription::gate)
      .def_rw("synchroniser", &EntityDescription::synchroniser)
      .def_rw("loop", &EntityDescription::loop)
      .def_rw("input", &EntityDescription::input)
      .def_rw("period_ns", &EntityDescription::period_ns)
      .def_rw("due_ns", &EntityDescription::due_ns)
      .def_rw("execution", &EntityDescription::execution)
      .def_rw("afterwards", &EntityDescription::afterwards, nb::arg().none())
      .def_rw("first_publisher", &EntityDescription::first_publisher)
      .def_rw("publisher_count", &EntityDescription::publisher_count)
      .def_rw("lifespan_ns", &EntityDescription::lifespan_ns, nb::arg().none())
      .def_rw("depth", &EntityDescription::depth)
      .def_rw("starts_chain", &EntityDescription::starts_chain)
      .def_rw("on_chain", &EntityDescription::on_chain);
  record<Reader>(module, "ReaderDescription", "A subscription that reads a publisher.")
      .def_rw("entity", &Reader::entity)
      .def_rw("delivery", &Reader::delivery, nb::arg().none());
  record<PublisherDescription>(module, "PublisherDescription", "A callback's publisher of a topic.")
      .def_rw("handle", &PublisherDescription::handle)
      .def_rw("rmw_handle", &PublisherDescription::rmw_handle)
      .def_rw("readers", &PublisherDescription::readers)
      .def_rw("asynchronous", &PublisherDescription::asynchronous)
      .def_rw("depth", &PublisherDescription::depth)
      .def_rw("lifespan_ns", &PublisherDescription::lifespan_ns, nb::arg().none())
      .def_rw("ends_chain", &PublisherDescription::ends_chain)
      .def_rw("modes", &PublisherDescription::modes);
  using Input = SynchroniserDescription::Input;
  record<Input>(module, "InputDescription", "An input of a synchroniser.")
      .def_rw("on_chain", &Input::on_chain)
      .def_rw("depth", &Input::depth);
  record<SynchroniserDescription>(module, "SynchroniserDescription", "A synchroniser of inputs.")
      .def_rw("inputs", &SynchroniserDescription::inputs)
      .def_rw("trigger", &SynchroniserDescription::trigger, nb::arg().none());
  record<LoopDescription>(module, "LoopDescription", "A loop in a thread of its own.")
      .def_rw("thread", &LoopDescription::thread)
      .def_rw("inputs", &LoopDescription::inputs)
      .def_rw("last_ns", &LoopDescription::last_ns)
      .def_rw("ends_chain", &LoopDescription::ends_chain);
}

// Reads and writes a field of the gate itself that is a word in Python.
template <typename Value, typename Owner, typename Words>
auto word_of(Value Owner::* field, const Words & words) {
  return std::pair(
      [field, &words](const GateDescription & described) {
        return std::string(words[static_cast<std::size_t>(described.gate.*field)]);
      },
      [field, &words](GateDescription & described, const std::string & word) {
        described.gate.*field = value_of<Value>(words, word);
      });
}

template <typename Value, typename Owner>
auto value_in(Value Owner::* field) {
  return std::pair(
      [field](const GateDescription & described) { return described.gate.*field; },
      [field](GateDescription & described, const Value & value) { described.gate.*field = value; });
}

void bind_gate(nb::module_ & module) {
  auto gate = record<GateDescription>(module, "GateDescription", "A gate in a callback.");
  const auto property = [&](const char * name, const auto & access) {
    gate.def_prop_rw(name, access.first, access.second);
  };
  gate.def_prop_rw(
      "slots",
      [](const GateDescription & described) {
        Pairs pairs;
        for (const auto & [start, end] : described.gate.slots) pairs.emplace_back(start, end);
        return pairs;
      },
      [](GateDescription & described, const Pairs & pairs) {
        described.gate.slots.clear();
        for (const auto & [start, end] : pairs) described.gate.slots.push_back({start, end});
      });
  each_gate_value([&](const char * name, auto member, const auto &... words) {
    if constexpr (sizeof...(words) == 0)
      property(name, value_in(member));
    else
      property(name, word_of(member, words...));
  });
  property("mode_names", value_in(&Gate::modes));
  property("mode_slots", value_in(&Gate::mode_slots));
  property("first_mode", value_in(&Gate::first_mode));
  property("late", word_of(&Gate::late, policy_names));
  property("depth", value_in(&Gate::depth));
  gate.def_rw("modes", &GateDescription::modes)
      .def_rw("moves", &GateDescription::moves)
      .def_rw("spin_ns", &GateDescription::spin_ns)
      .def_rw("pause_ns", &GateDescription::pause_ns);
}

void bind_description(nb::module_ & module) {
  record<Description>(module, "Description",
                      "A system to simulate; parts refer to each other by place in their lists.")
      .def_rw("cores", &Description::cores)
      .def_rw("threads", &Description::threads)
      .def_rw("processes", &Description::processes)
      .def_rw("entities", &Description::entities)
      .def_rw("publishers", &Description::publishers)
      .def_rw("gates", &Description::gates)
      .def_rw("synchronisers", &Description::synchronisers)
      .def_rw("loops", &Description::loops)
      .def_prop_rw(
          "streams",
          [](const Description & described) {
            Constants constants;
            for (const auto & stream : described.streams) constants.push_back(stream.constant_ns);
            return constants;
          },
          [](Description & described, const Constants & constants) {
            described.streams.clear();
            for (const auto & constant : constants) described.streams.push_back({constant});
          })
      .def_rw("groups", &Description::groups)
      .def_rw("cycle_ns", &Description::cycle_ns)
      .def_rw("quantum_ns", &Description::quantum_ns)
      .def_rw("context_switch_ns", &Description::context_switch_ns)
      .def_rw("preemption_ns", &Description::preemption_ns)
      .def_rw("interrupts_ppm", &Description::interrupts_ppm)
      .def_rw("last_timer_ns", &Description::last_timer_ns)
      .def_rw("stop_ns", &Description::stop_ns)
      .def_rw("record_from_ns", &Description::record_from_ns)
      .def_rw("events", &Description::events)
      .def_rw("switches", &Description::switches)
      .def_rw("instances", &Description::instances)
      .def_rw("log_rows", &Description::log_rows)
      .def_rw("most_messages", &Description::most_messages);
}

// Makes a source that asks Python for numbers. It takes Python's lock, since the engine runs
// without.
Source source_from(nb::callable draw) {
  return [draw = std::move(draw)](Place stream) {
    const nb::gil_scoped_acquire acquired;
    const auto numbers = nb::cast<Array<const std::int64_t>>(draw(stream));
    return std::vector<Nanoseconds>(numbers.data(), numbers.data() + numbers.size());
  };
}

// Adds the columns `pid`, `tid` and `cpu` of each entry's thread; the idle thread has 0.
void add_threads(nb::dict & columns, const std::vector<ThreadDescription> & threads,
                 const EntryColumns & entries) {
  auto pids = std::make_unique_for_overwrite<std::int32_t[]>(entries.count);
  auto tids = std::make_unique_for_overwrite<std::int32_t[]>(entries.count);
  auto cpus = std::make_unique_for_overwrite<std::int32_t[]>(entries.count);
  const ThreadDescription idle;
  for (std::size_t row = 0; row < entries.count; ++row) {
    const auto place = entries.threads[row];
    const auto & thread = place == absent ? idle : threads[static_cast<Place>(place)];
    pids[row] = thread.pid;
    tids[row] = thread.tid;
    cpus[row] = thread.cpu;
  }
  columns["pid"] = column_of(std::move(pids), entries.count);
  columns["tid"] = column_of(std::move(tids), entries.count);
  columns["cpu"] = column_of(std::move(cpus), entries.count);
}

nb::dict take_log(Engine & engine) {
  nb::dict log;
  auto entries = engine.take_log();
  for (std::size_t number = 0; number < entries.size(); ++number) {
    const auto & [name, fields] = log_layout()[number];
    EntryColumns & taken = entries[number];
    nb::dict columns;
    columns["time"] = column_of(std::move(taken.times), taken.count);
    add_threads(columns, engine.description().threads, taken);
    columns["thread"] = column_of(std::move(taken.threads), taken.count);
    for (std::size_t field = 0; field < fields.size(); ++field)
      columns[fields[field]] = column_of(std::move(taken.fields[field]), taken.count);
    log[name] = columns;
  }
  return log;
}

}  // namespace

void bind_simulation(nb::module_ & module) {
  module.attr("FOREVER_NS") = forever;
  bind_kinds(module);
  bind_machine(module);
  bind_callbacks(module);
  bind_gate(module);
  bind_description(module);
  nb::class_<Engine>(module, "Simulation", "A simulated application, from its start on.")
      .def(
          "__init__",
          [](Engine * place, const Description & description, nb::callable draw) {
            new (place) Engine(description, source_from(std::move(draw)));
          },
          nb::arg("description"), nb::arg("draw"),
          "`draw(stream)` returns the next numbers of a stream. Raises ValueError: the description "
          "is contradictory.")
      .def("run", &Engine::run, nb::arg("most_instants"), nb::call_guard<nb::gil_scoped_release>(),
           "Go on until the end, until the log is full, or for so many instants.")
      .def("take_log", &take_log, "Return and empty the log: columns by names of entry and field.")
      .def(
          "latencies", [](const Engine & engine) { return column_of(engine.latencies()); },
          "Return the latency of each instance of the chain (ns); -1: it did not complete.")
      .def_prop_ro("now_ns", &Engine::now);
}

}  // namespace chainshaper::bindings
