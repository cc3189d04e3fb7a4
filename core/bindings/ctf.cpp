#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/set.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/variant.h>
#include <nanobind/stl/vector.h>

#include <new>
#include <stdexcept>

#include "bindings/arrays.hpp"
#include "ctf/events.hpp"
#include "ctf/layout.hpp"
#include "ctf/packets.hpp"
#include "ctf/sorting.hpp"
#include "ctf/types.hpp"

namespace chainshaper::bindings {
namespace {

using File = Array<const std::uint8_t>;
using Numbers = Array<const std::int64_t>;

// Types

// A type of the metadata, as Python has it.
struct FieldType {
  ctf::Type type;
};

using Fields = std::vector<std::pair<std::string, FieldType>>;

std::vector<ctf::Field> fields_of(const Fields & types) {
  std::vector<ctf::Field> fields;
  fields.reserve(types.size());
  for (const auto & [name, field] : types) fields.push_back({name, field.type});
  return fields;
}

std::optional<ctf::Structure> structure_of(const std::optional<FieldType> & scope) {
  if (!scope) return std::nullopt;
  const auto * structure = std::get_if<ctf::Structure>(&scope->type->is);
  if (structure == nullptr) throw std::invalid_argument("a scope is a structure");
  return *structure;
}

FieldType integer(
    std::int64_t size, std::int64_t align, bool is_signed, bool big_endian, bool maps_clock,
    const std::vector<std::tuple<std::string, std::uint64_t, std::uint64_t>> & labels) {
  ctf::Integer integer{size, align, is_signed, big_endian, maps_clock, {}};
  for (const auto & [label, low, high] : labels) integer.labels[label].push_back({low, high});
  return {ctf::checked({std::move(integer)})};
}

FieldType array(const FieldType & element, std::variant<std::int64_t, std::string> length,
                bool is_text) {
  return {ctf::checked({ctf::Array{element.type, std::move(length), is_text}})};
}

FieldType structure(const Fields & fields, std::int64_t align) {
  return {ctf::checked({ctf::Structure{fields_of(fields), align}})};
}

FieldType variant(std::optional<std::string> tag, const Fields & options) {
  return {ctf::checked({ctf::Variant{std::move(tag), fields_of(options)}})};
}

void bind_types(nb::module_ & module) {
  nb::class_<FieldType>(module, "CtfType", "A type of a trace's metadata.")
      .def_static("integer", &integer, nb::kw_only(), nb::arg("size"), nb::arg("align"),
                  nb::arg("is_signed"), nb::arg("big_endian"), nb::arg("maps_clock"),
                  nb::arg("labels"), "An integer or an enumeration.")
      .def_static(
          "string", [] { return FieldType{ctf::checked({ctf::String{}})}; },
          "Bytes up to and including the first NUL.")
      .def_static("array", &array, nb::kw_only(), nb::arg("element"), nb::arg("length"),
                  nb::arg("is_text"), "An array, or a sequence where the length is a path.")
      .def_static("structure", &structure, nb::kw_only(), nb::arg("fields"), nb::arg("align"),
                  "Fields that follow each other.")
      .def_static("variant", &variant, nb::kw_only(), nb::arg("tag").none(), nb::arg("options"),
                  "One of several types, which an enumeration before it chooses.");

  nb::class_<ctf::EventClass>(module, "CtfEventClass", "What an event class declares.")
      .def(
          "__init__",
          [](ctf::EventClass * self, std::int64_t id, const std::optional<FieldType> & context,
             const std::optional<FieldType> & fields) {
            new (self) ctf::EventClass{id, structure_of(context), structure_of(fields)};
          },
          nb::kw_only(), nb::arg("id"), nb::arg("context").none(), nb::arg("fields").none());

  nb::class_<ctf::StreamClass>(module, "CtfStreamClass", "What a stream class declares.")
      .def(
          "__init__",
          [](ctf::StreamClass * self, std::int64_t id,
             const std::optional<FieldType> & packet_context,
             const std::optional<FieldType> & event_header,
             const std::optional<FieldType> & event_context, std::vector<ctf::EventClass> events,
             std::int64_t frequency_hz) {
            new (self) ctf::StreamClass{id,
                                        structure_of(packet_context),
                                        structure_of(event_header),
                                        structure_of(event_context),
                                        std::move(events),
                                        frequency_hz};
          },
          nb::kw_only(), nb::arg("id"), nb::arg("packet_context").none(),
          nb::arg("event_header").none(), nb::arg("event_context").none(), nb::arg("events"),
          nb::arg("frequency_hz"));

  nb::class_<ctf::TraceClass>(module, "CtfTraceClass", "What a trace's metadata declares.")
      .def(
          "__init__",
          [](ctf::TraceClass * self, bool big_endian, bool of_kernel,
             std::optional<std::pair<std::int64_t, std::int64_t>> uuid,
             const std::optional<FieldType> & packet_header, std::set<std::string> referenced,
             std::vector<ctf::StreamClass> streams) {
            new (self) ctf::TraceClass{big_endian,
                                       of_kernel,
                                       uuid,
                                       structure_of(packet_header),
                                       std::move(referenced),
                                       std::move(streams)};
          },
          nb::kw_only(), nb::arg("big_endian"), nb::arg("of_kernel"), nb::arg("uuid").none(),
          nb::arg("packet_header").none(), nb::arg("referenced"), nb::arg("streams"));
}

// Layout

void bind_layout(nb::module_ & module) {
  nb::enum_<ctf::Scope>(module, "CtfScope", "The part of an event in which a field is.")
      .value("STREAM_EVENT_CONTEXT", ctf::Scope::stream_event_context)
      .value("EVENT_CONTEXT", ctf::Scope::event_context)
      .value("EVENT_FIELDS", ctf::Scope::event_fields);

  nb::class_<ctf::WantedEvent>(module, "CtfWantedEvent", "An event class that is wanted.")
      .def(
          "__init__",
          [](ctf::WantedEvent * self, std::size_t event, std::int32_t table,
             const std::vector<std::pair<ctf::Scope, std::size_t>> & columns) {
            new (self) ctf::WantedEvent{event, table, {}};
            for (const auto & [scope, field] : columns) self->columns.push_back({scope, field});
          },
          nb::kw_only(), nb::arg("event"), nb::arg("table"), nb::arg("columns"));

  nb::class_<ctf::Layout>(module, "CtfLayout", "Where the bits of some traces' packets are.")
      .def(
          "__init__",
          [](ctf::Layout * self, const std::vector<ctf::TraceClass> & traces,
             const std::vector<ctf::WantedEvent> & wanted) {
            new (self) ctf::Layout(without_lock([&] { return ctf::lay_out(traces, wanted); }));
          },
          nb::arg("traces"), nb::arg("wanted"))
      .def_ro("traces", &ctf::Layout::traces, "The stream classes of each trace: first and end.");

  // It becomes ValueError(reason, trace), so that a message can name the trace's file.
  nb::register_exception_translator([](const std::exception_ptr & thrown, void * /*payload*/) {
    try {
      std::rethrow_exception(thrown);
    } catch (const ctf::LayoutError & error) {
      PyErr_SetObject(PyExc_ValueError, nb::make_tuple(error.what(), error.trace).ptr());
    }
  });
}

// Packets

template <typename Member>
nb::object column_of(const std::vector<ctf::Packet> & packets, Member member) {
  std::vector<std::int64_t> column;
  column.reserve(packets.size());
  for (const auto & packet : packets) column.push_back(packet.*member);
  return nb::cast(array_of(std::move(column)));
}

nb::dict columns_of(const ctf::FoundPackets & file) {
  const auto & packets = file.packets;
  nb::dict columns;
  columns["offset"] = column_of(packets, &ctf::Packet::offset);
  columns["size"] = column_of(packets, &ctf::Packet::size);
  columns["content_bits"] = column_of(packets, &ctf::Packet::content_bits);
  columns["stream_class"] = column_of(packets, &ctf::Packet::stream_class);
  columns["instance"] = column_of(packets, &ctf::Packet::instance);
  columns["begin"] = column_of(packets, &ctf::Packet::begin);
  columns["end"] = column_of(packets, &ctf::Packet::end);
  columns["sequence"] = column_of(packets, &ctf::Packet::sequence);
  columns["discarded"] = column_of(packets, &ctf::Packet::discarded);
  columns["cpu"] = column_of(packets, &ctf::Packet::cpu);
  return columns;
}

ctf::FoundPackets find_packets(const ctf::Layout & layout, std::size_t trace, const File & file,
                               const nb::bytes & beginning) {
  if (trace >= layout.traces.size()) throw std::invalid_argument("no such trace in the layout");
  const ctf::Bytes first(reinterpret_cast<const std::uint8_t *>(beginning.c_str()),
                         beginning.size());
  const auto bytes = span_of(file);
  return without_lock([&] { return ctf::find_packets(layout, trace, bytes, first); });
}

void bind_packets(nb::module_ & module) {
  module.attr("CTF_MAGIC") = ctf::packet_magic;
  nb::enum_<ctf::Damage>(module, "CtfDamage", "What is wrong where a packet should be.")
      .value("BAD_MAGIC", ctf::Damage::bad_magic)
      .value("BAD_UUID", ctf::Damage::bad_uuid)
      .value("BAD_STREAM", ctf::Damage::bad_stream)
      .value("BAD_SIZE", ctf::Damage::bad_size)
      .value("BAD_HEADER", ctf::Damage::bad_header)
      .value("CUT", ctf::Damage::cut)
      .value("COSTLY", ctf::Damage::costly);

  nb::class_<ctf::DamagedPlace>(module, "CtfDamagedPlace", "A place in a file with damage.")
      .def_ro("damage", &ctf::DamagedPlace::damage)
      .def_ro("offset", &ctf::DamagedPlace::offset)
      .def_ro("following", &ctf::DamagedPlace::following);

  nb::class_<ctf::FoundPackets>(module, "CtfPackets", "The packets of a stream file.")
      .def_prop_ro("columns", &columns_of)
      .def_ro("damaged", &ctf::FoundPackets::damaged);

  module.def("find_packets", &find_packets, nb::arg("layout"), nb::arg("trace"), nb::arg("file"),
             nb::kw_only(), nb::arg("beginning"), "Find the packets of a trace's stream file.");
}

// Events

// The columns of a table, and the arrays that they are in, so that these stay alive.
struct EventTable {
  std::vector<nb::object> arrays;
  ctf::TableColumns columns;
};

ctf::Column column_of(const nb::ndarray<nb::ndim<1>, nb::c_contig, nb::device::cpu> & array) {
  const auto type = array.dtype();
  const auto kind = static_cast<nb::dlpack::dtype_code>(type.code);
  const bool is_integer =
      kind == nb::dlpack::dtype_code::Int || kind == nb::dlpack::dtype_code::UInt;
  if (!is_integer || type.lanes != 1) throw std::invalid_argument("a column is of integers");
  return {static_cast<std::uint8_t *>(array.data()), type.bits / 8, array.size()};
}

// A stream file while its events are read. `keep_alive` lets the layout live as long.
struct EventFile {
  File file;
  ctf::EventReader reader;
};

std::vector<ctf::PacketEvents> packets_of(const Numbers & offset, const Numbers & content_bits,
                                          const Numbers & stream_class, const Numbers & cpu,
                                          const Numbers & earliest, const Numbers & latest) {
  const auto count = offset.size();
  check_length("content_bits", content_bits.size(), count);
  check_length("stream_class", stream_class.size(), count);
  check_length("cpu", cpu.size(), count);
  check_length("earliest", earliest.size(), count);
  check_length("latest", latest.size(), count);
  std::vector<ctf::PacketEvents> packets(count);
  for (std::size_t row = 0; row < count; ++row)
    packets[row] = {offset(row), content_bits(row), stream_class(row),
                    cpu(row),    earliest(row),     latest(row)};
  return packets;
}

nb::list write_events(const EventFile & file, const ctf::Chunk & chunk,
                      const std::vector<EventTable *> & tables, const Numbers & first_rows) {
  std::vector<ctf::TableColumns> columns;
  for (const auto * table : tables) columns.push_back(table->columns);
  const auto first = span_of(first_rows);
  const auto texts = without_lock([&] { return file.reader.write(chunk, columns, first); });
  nb::list strings;
  for (const ctf::Text & text : texts)
    strings.append(nb::bytes(text.place, static_cast<std::size_t>(text.length)));
  return strings;
}

void recode(const Array<std::uint32_t> & codes, const Array<const std::uint32_t> & new_codes) {
  const auto rows = span_of(codes);
  const auto replacements = span_of(new_codes);
  without_lock([&] {
    for (auto & code : rows) {
      if (code >= replacements.size()) throw std::invalid_argument("a code of no text");
      code = replacements[code];
    }
  });
}

void bind_bad_events(nb::module_ & module) {
  nb::enum_<ctf::Failure>(module, "CtfFailure", "Why an event cannot be read.")
      .value("TRUNCATED", ctf::Failure::truncated)
      .value("NO_OPTION", ctf::Failure::no_option)
      .value("BAD_LENGTH", ctf::Failure::bad_length)
      .value("UNTERMINATED", ctf::Failure::unterminated)
      .value("UNKNOWN_EVENT", ctf::Failure::unknown_event)
      .value("OVER_BUDGET", ctf::Failure::over_budget)
      .value("OTHER_TIME", ctf::Failure::other_time)
      .value("NO_PROCESS", ctf::Failure::no_process)
      .value("ALL_ZEROS", ctf::Failure::all_zeros)
      .value("TABLE_FULL", ctf::Failure::table_full);

  nb::class_<ctf::BadEvent>(module, "CtfBadEvent", "An event that ends its packet.")
      .def_ro("packet", &ctf::BadEvent::packet)
      .def_ro("offset", &ctf::BadEvent::offset)
      .def_ro("failure", &ctf::BadEvent::failure);
}

void bind_events(nb::module_ & module) {
  module.attr("CTF_BUDGET_PER_BYTE") = ctf::budget_per_byte;
  nb::exception<ctf::FileChanged>(module, "CtfFileChangedError");
  bind_bad_events(module);

  nb::class_<ctf::Chunk>(module, "CtfChunk", "Packets of a file that are written together.")
      .def_ro("first", &ctf::Chunk::first)
      .def_ro("end", &ctf::Chunk::end)
      .def_prop_ro("rows_before",
                   [](const ctf::Chunk & chunk) {
                     return nb::cast(array_of(std::vector(chunk.rows_before)));
                   })
      .def_prop_ro("rows_after", [](const ctf::Chunk & chunk) {
        return nb::cast(array_of(std::vector(chunk.rows_after)));
      });

  nb::class_<EventTable>(module, "CtfTable", "The arrays that events of a table are written to.")
      .def(
          "__init__",
          [](EventTable * self, const Array<std::int64_t> & times_ns,
             const std::optional<Array<std::int32_t>> & cpus,
             const std::vector<nb::ndarray<nb::ndim<1>, nb::c_contig, nb::device::cpu>> & columns) {
            new (self) EventTable{};
            self->columns.times_ns = span_of(times_ns);
            self->arrays.push_back(nb::cast(times_ns));
            if (cpus) {
              self->columns.cpus = span_of(*cpus);
              self->arrays.push_back(nb::cast(*cpus));
            }
            for (const auto & column : columns) {
              self->columns.columns.push_back(column_of(column));
              self->arrays.push_back(nb::cast(column));
            }
          },
          nb::kw_only(), nb::arg("times_ns"), nb::arg("cpus").none(), nb::arg("columns"))
      .def("sort_by_time",
           [](const EventTable & self) { without_lock([&] { ctf::sort_by_time(self.columns); }); });

  nb::class_<EventFile>(module, "CtfEventReader", "Reads the events of a stream file.")
      .def(
          "__init__",
          [](EventFile * self, const ctf::Layout & layout, const File & file,
             const Numbers & offset, const Numbers & content_bits, const Numbers & stream_class,
             const Numbers & cpu, const Numbers & earliest, const Numbers & latest) {
            auto packets = packets_of(offset, content_bits, stream_class, cpu, earliest, latest);
            new (self) EventFile{file, ctf::EventReader(layout, span_of(file), std::move(packets))};
          },
          nb::arg("layout"), nb::arg("file"), nb::kw_only(), nb::arg("offset"),
          nb::arg("content_bits"), nb::arg("stream_class"), nb::arg("cpu"), nb::arg("earliest"),
          nb::arg("latest"), nb::keep_alive<1, 2>())
      .def(
          "count",
          [](EventFile & self, std::size_t end) {
            return without_lock([&] { return self.reader.count(end); });
          },
          nb::arg("end"))
      .def("write", &write_events, nb::arg("chunk"), nb::arg("tables"), nb::arg("first_rows"))
      .def_prop_ro("counts",
                   [](const EventFile & self) {
                     return nb::cast(array_of(std::vector(self.reader.counts())));
                   })
      .def_prop_ro("rows",
                   [](const EventFile & self) {
                     return nb::cast(array_of(std::vector(self.reader.rows())));
                   })
      .def_prop_ro("bad_events", [](const EventFile & self) { return self.reader.bad_events(); });

  module.def("recode", &recode, nb::arg("codes"), nb::arg("new_codes"),
             "Replace each code of `codes` by `new_codes[code]`, in place.");
}

}  // namespace

void bind_ctf(nb::module_ & module) {
  bind_types(module);
  bind_layout(module);
  bind_packets(module);
  bind_events(module);
}

}  // namespace chainshaper::bindings
