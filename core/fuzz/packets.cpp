// Fuzzes the trace decoder: descriptions and files of any bytes are laid out, searched for packets,
// counted and written. What was counted has to be what is written, and nothing may read or write
// where it must not, which the sanitizers see.

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <stdexcept>

#include "ctf/events.hpp"
#include "ctf/sorting.hpp"
#include "fuzz/description.hpp"

namespace chainshaper::fuzz {
namespace {

void expect(bool condition, const char * statement) {
  if (condition) return;
  std::fprintf(stderr, "not so: %s\n", statement);
  std::abort();
}

// Asks for every event, and a column for each field that can have one.
std::vector<ctf::WantedEvent> everything(const ctf::TraceClass & trace) {
  std::vector<ctf::WantedEvent> wanted;
  std::size_t number = 0;
  for (const auto & stream : trace.streams)
    for (const auto & event : stream.events) {
      ctf::WantedEvent wish{number, static_cast<std::int32_t>(number), {}};
      for (const auto & [scope, structure] :
           {std::pair{ctf::Scope::stream_event_context, &stream.event_context},
            std::pair{ctf::Scope::event_context, &event.context},
            std::pair{ctf::Scope::event_fields, &event.fields}})
        for (std::size_t field = 0; *structure && field < (*structure)->fields.size(); ++field)
          if (ctf::column_width(*(*structure)->fields[field].type))
            wish.columns.push_back({scope, field});
      wanted.push_back(std::move(wish));
      ++number;
    }
  return wanted;
}

// A table with just the memory that its rows need.
struct Table {
  Table(const ctf::TableLayout & layout, std::size_t rows)
      : times_ns(rows), cpus(layout.has_cpu ? rows : 0) {
    for (const auto width : layout.widths)
      values.emplace_back(rows * static_cast<std::size_t>(width));
    columns.times_ns = times_ns;
    columns.cpus = cpus;
    for (std::size_t column = 0; column < values.size(); ++column)
      columns.columns.push_back({values[column].data(), layout.widths[column], rows});
  }

  std::vector<std::int64_t> times_ns;
  std::vector<std::int32_t> cpus;
  std::vector<std::vector<std::uint8_t>> values;
  ctf::TableColumns columns;
};

void read_events(const ctf::Layout & layout, ctf::Bytes file,
                 std::vector<ctf::PacketEvents> packets) {
  const auto count = packets.size();
  ctf::EventReader reader(layout, file, std::move(packets));
  std::vector<ctf::Chunk> chunks;
  for (const auto end : {count / 2, count}) chunks.push_back(reader.count(end));
  std::vector<Table> tables;
  tables.reserve(layout.tables.size());
  std::int64_t rows = 0;
  for (std::size_t table = 0; table < layout.tables.size(); ++table) {
    tables.emplace_back(layout.tables[table], static_cast<std::size_t>(reader.rows()[table]));
    rows += reader.rows()[table];
  }
  std::int64_t events = 0;
  for (const auto number : reader.counts()) events += number;
  expect(rows == events, "each event has a row");
  expect(rows <= static_cast<std::int64_t>(64 * file.size()), "rows are paid for");
  std::vector<ctf::TableColumns> columns;
  for (const auto & table : tables) columns.push_back(table.columns);
  const std::vector<std::int64_t> first_rows(tables.size(), 0);
  for (const auto & chunk : chunks) {
    std::size_t bytes = 0;
    for (const auto & text : reader.write(chunk, columns, first_rows)) {
      expect(text.length >= 0, "lengths of texts are no negative numbers");
      for (std::int64_t place = 0; place < text.length; ++place) bytes += text.place[place];
    }
    expect(bytes < SIZE_MAX, "texts can be read");
  }
  for (auto & table : tables) {
    ctf::sort_by_time(table.columns);
    expect(std::is_sorted(table.times_ns.begin(), table.times_ns.end()), "rows are sorted");
  }
}

void run(std::span<const std::uint8_t> input) {
  Source source(input);
  Describer describer(source);
  const auto trace = describer.trace();
  const auto cut = source.byte() % 4 == 0;  // whether the times of packets are believed
  // In memory of just this size, so that what reads behind it is seen.
  const std::vector<std::uint8_t> file(source.rest().begin(), source.rest().end());
  ctf::Layout layout;
  try {
    layout = ctf::lay_out(std::span(&trace, 1), everything(trace));
  } catch (const ctf::LayoutError &) {
    return;
  }
  const std::uint8_t beginning[] = {0xC1, 0x1F, 0xFC, 0xC1};
  const auto search = ctf::find_packets(layout, 0, file, beginning);
  std::vector<ctf::PacketEvents> packets;
  for (const auto & packet : search.packets) {
    packets.push_back({packet.offset, packet.content_bits, packet.stream_class, packet.cpu});
    if (cut) packets.back().earliest = packet.begin;
  }
  read_events(layout, file, std::move(packets));
}

}  // namespace
}  // namespace chainshaper::fuzz

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t * data, std::size_t size) {
  chainshaper::fuzz::run({data, size});
  return 0;
}
