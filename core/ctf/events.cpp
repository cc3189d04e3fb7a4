#include "ctf/events.hpp"

#include <array>
#include <stdexcept>
#include <string>

namespace chainshaper::ctf {
namespace {

// A header of zeros, with so many more bytes of zeros behind it, is no event.
constexpr std::int64_t zeros_of_no_event = 32;

// Bytes ahead of an event that are fetched while it is read.
constexpr std::size_t read_ahead = 1024;

struct Header {
  Reached behind;
  const EventLayout * event;  // nullptr where `behind` is a failure
  std::int64_t end{0};        // bits: behind the event; 0: not known yet
};

// Reads the headers of packets and events.
class Headers {
public:
  Headers(const Layout & layout, const PacketEvents & packet, Bytes file, Run & run)
      : layout_(layout),
        stream_(layout.streams[static_cast<std::size_t>(packet.stream_class)]),
        content_{file.subspan(static_cast<std::size_t>(packet.offset)), packet.content_bits},
        run_(run) {}

  const Content & content() const { return content_; }
  const StreamLayout & stream() const { return stream_; }

  // Reads the packet's header and context; returns the position of its first event.
  Reached open() const {
    run_.forget_variables();
    if (content_.end == 0) return 0;
    const auto header = run_.steps(stream_.packet_header, content_, 0);
    if (header.failed()) return header;
    return run_.steps(stream_.packet_context, content_, header.bits());
  }

  // Reads an event's header, and sets the clock.
  Header read(std::int64_t position) const {
    if (const auto & quick = stream_.quick; quick.align != 0) {
      const auto at = align_up(position, quick.align);
      const auto behind = at + quick.clock_shift + quick.clock_bits;
      const auto byte = static_cast<std::size_t>(at >> 3);
      if (behind <= content_.end && byte + 8 <= content_.bytes.size()) {
        const auto * place = content_.bytes.data() + byte;
        // Without this, waiting for the memory of the next headers would take most of the time.
        if (byte + read_ahead < content_.bytes.size()) __builtin_prefetch(place + read_ahead);
        const auto word = load<std::uint64_t>(place);
        const auto last = low_bits(~std::uint64_t{0}, quick.id_bits);
        if ((word & last) != last) {
          run_.set_clock(low_bits(word >> quick.clock_shift, quick.clock_bits), quick.clock_bits);
          return named(word & last, at, behind);
        }
      }
    }
    run_.set_variable(event_id, stream_.default_event);
    const auto behind = run_.steps(stream_.event_header, content_, position);
    if (behind.failed()) return {behind, nullptr};
    return named(run_.variable(event_id), behind.bits());
  }

  // Returns the position behind an event of constant layout.
  Reached end_of(const Header & header) const {
    const EventLayout & event = *header.event;
    const auto end =
        header.end != 0 ? header.end : align_up(header.behind.bits(), event.align) + event.size;
    return end <= content_.end ? Reached(end) : Reached(Failure::truncated);
  }

  // Returns the position behind an event's contexts and payload, without writing anything.
  Reached step_over(const Header & header) const {
    if (header.end != 0 || header.event->align != 0) return end_of(header);
    return run_.steps(header.event->steps, content_, header.behind.bits());
  }

private:
  // The event whose quick header is from `at` to `behind`.
  Header named(std::uint64_t id, std::int64_t at, std::int64_t behind) const {
    if (id >= stream_.quick_events.size()) return named(static_cast<std::int64_t>(id), behind);
    const auto [event, span] = stream_.quick_events[static_cast<std::size_t>(id)];
    if (event == none) return {Failure::unknown_event, nullptr};
    return {behind, &layout_.events[static_cast<std::size_t>(event)], span == 0 ? 0 : at + span};
  }

  Header named(std::int64_t id, std::int64_t behind) const {
    const auto event = stream_.event(id);
    if (event == none) return {Failure::unknown_event, nullptr};
    return {behind, &layout_.events[static_cast<std::size_t>(event)]};
  }

  const Layout & layout_;
  const StreamLayout & stream_;
  Content content_;
  Run & run_;
};

// Whether a header and the bytes behind it are zeros, as in a file whose data never reached the
// disk.
bool only_zeros(const Content & content, std::int64_t position, std::int64_t behind) {
  const auto first = position >> 3, last = (behind >> 3) + zeros_of_no_event;
  if (last > content.end >> 3) return false;
  for (auto at = first; at < last; ++at)
    if (content.bytes[static_cast<std::size_t>(at)] != 0) return false;
  return true;
}

bool is_zero(const Content & content, std::int64_t position) {
  const auto at = position >> 3;
  return at <= (content.end >> 3) - 8 &&
         load<std::uint32_t>(content.bytes.data() + static_cast<std::size_t>(at)) == 0;
}

// Checks that a tracer can have written an event, whose header is from `position` to `behind`: it
// happened while its packet was open, in a process with a number, and its bytes are not all zeros.
// Returns `behind`, or what is wrong.
Reached believed(const Headers & headers, const PacketEvents & packet, const Run & run,
                 std::int64_t position, std::int64_t behind, const EventLayout * event_of_id_0,
                 const EventLayout * event) {
  const auto now = static_cast<std::int64_t>(run.clock());
  if (now < packet.earliest || now > packet.latest) return Failure::other_time;
  const auto & process = headers.stream().process;
  if (process.align != 0) {
    const auto begin = align_up(behind, process.align);
    if (is_zero(headers.content(), begin + process.process) ||
        is_zero(headers.content(), begin + process.thread))
      return Failure::no_process;
  } else if (headers.stream().quick.align != 0 && event == event_of_id_0) {
    const auto begin = align_up(position, headers.stream().quick.align);
    if (only_zeros(headers.content(), begin, behind)) return Failure::all_zeros;
  }
  return behind;
}

// Converts clock cycles to nanoseconds, rounded down.
std::int64_t nanoseconds(std::uint64_t cycles, std::int64_t frequency_hz) {
  constexpr std::uint64_t billion = 1'000'000'000;
  const auto rate = static_cast<std::uint64_t>(frequency_hz);
  if (rate == billion) return static_cast<std::int64_t>(cycles);
  return static_cast<std::int64_t>(cycles / rate * billion + cycles % rate * billion / rate);
}

// Events of a class of constant layout that are written together, column by column, so that there
// is no branch for each value.
struct Batch {
  static constexpr std::size_t most = 128;

  std::size_t count{0};
  std::size_t first_row{0};  // of the first event; the rows of the others follow
  std::array<const std::uint8_t *, most> places{};

  bool is_followed_by(std::size_t row) const { return count < most && first_row + count == row; }
};

template <typename Number>
void move_numbers(const Batch & batch, const Move & move, const Column & column) {
  auto * values = column.values + batch.first_row * sizeof(Number);
  for (std::size_t index = 0; index < batch.count; ++index)
    std::memcpy(values + index * sizeof(Number), batch.places[index] + move.offset, sizeof(Number));
}

// Writes the events of a chunk to their tables.
class RowWriter {
public:
  RowWriter(const Layout & layout, Bytes file, std::span<const TableColumns> tables,
            std::vector<std::int64_t> rows, std::vector<std::int64_t> ends)
      : layout_(layout),
        file_(file),
        tables_(tables),
        rows_(std::move(rows)),
        ends_(std::move(ends)),
        batches_(layout.events.size()) {}

  // Writes an event that is wanted; returns the position behind it.
  Reached write(const Header & header, const PacketEvents & packet, const Headers & headers,
                Run & run) {
    const EventLayout & event = *header.event;
    const auto position = header.behind.bits();
    const auto number = static_cast<std::size_t>(event.table);
    const TableColumns & table = tables_[number];
    if (rows_[number] >= ends_[number]) return Failure::table_full;
    const auto row = static_cast<std::size_t>(rows_[number]++);
    table.times_ns[row] = nanoseconds(run.clock(), headers.stream().frequency_hz);
    if (!table.cpus.empty()) table.cpus[row] = static_cast<std::int32_t>(packet.cpu);
    const Content & content = headers.content();
    if (!event.is_moved) {
      const Row place{table.columns.data(), row, &texts_};
      return run.steps(event.steps, content, position, &place);
    }
    const auto end = headers.end_of(header);
    if (end.failed()) return end;
    Batch & batch = batches_[static_cast<std::size_t>(&event - layout_.events.data())];
    if (!batch.is_followed_by(row)) {
      move(event, batch);
      batch.first_row = row;
    }
    batch.places[batch.count++] = content.bytes.data() + (align_up(position, event.align) >> 3);
    return end;
  }

  // Writes the batches that are not written yet; returns whether all expected rows were written.
  bool finish() {
    for (std::size_t number = 0; number < batches_.size(); ++number)
      move(layout_.events[number], batches_[number]);
    return rows_ == ends_;
  }

  const std::vector<Text> & texts() const { return texts_.all(); }

private:
  void move(const EventLayout & event, Batch & batch) {
    if (batch.count == 0) return;
    const TableColumns & table = tables_[static_cast<std::size_t>(event.table)];
    for (const Move & each : event.moves) {
      const Column & column = table.columns[static_cast<std::size_t>(each.column)];
      if (each.is_characters) {
        move_texts(batch, each, column);
        continue;
      }
      switch (each.length) {
        case 8:
          move_numbers<std::uint64_t>(batch, each, column);
          break;
        case 4:
          move_numbers<std::uint32_t>(batch, each, column);
          break;
        case 2:
          move_numbers<std::uint16_t>(batch, each, column);
          break;
        default:
          move_numbers<std::uint8_t>(batch, each, column);
          break;
      }
    }
    batch.count = 0;
  }

  void move_texts(const Batch & batch, const Move & move, const Column & column) {
    for (std::size_t index = 0; index < batch.count; ++index) {
      const Bytes bytes(batch.places[index] + move.offset, file_.data() + file_.size());
      column.store(batch.first_row + index,
                   texts_.code(text_at(bytes, 0, move.length, move.is_text)));
    }
  }

  const Layout & layout_;
  Bytes file_;
  std::span<const TableColumns> tables_;
  std::vector<std::int64_t> rows_;  // the next row of each table
  std::vector<std::int64_t> ends_;  // the end of the rows of each table
  std::vector<Batch> batches_;      // per event class
  Texts texts_;
};

void check(const Layout & layout, Bytes file, const PacketEvents & packet) {
  const auto size = static_cast<std::int64_t>(file.size());
  if (packet.offset < 0 || packet.offset > size || packet.content_bits < 0 ||
      (packet.content_bits + 7) >> 3 > size - packet.offset)
    throw std::invalid_argument("a packet that is not in its file");
  if (packet.stream_class < 0 ||
      packet.stream_class >= static_cast<std::int64_t>(layout.streams.size()))
    throw std::invalid_argument("a packet of no stream class");
}

void check(const TableLayout & layout, const TableColumns & table, std::int64_t rows) {
  const auto expected = static_cast<std::size_t>(rows);
  bool fits = table.times_ns.size() >= expected && table.columns.size() == layout.widths.size();
  fits = fits && (layout.has_cpu ? table.cpus.size() >= expected : table.cpus.empty());
  for (std::size_t column = 0; fits && column < table.columns.size(); ++column)
    fits = table.columns[column].width == layout.widths[column] &&
           table.columns[column].rows >= expected;
  if (!fits) throw std::invalid_argument("columns that are not those of their table");
}

[[noreturn]] void file_changed() {
  throw FileChanged("the file has not the events that were counted");
}

}  // namespace

EventReader::EventReader(const Layout & layout, Bytes file, std::vector<PacketEvents> packets)
    : layout_(layout),
      file_(file),
      packets_(std::move(packets)),
      counts_(layout.events.size()),
      rows_(layout.tables.size()),
      run_(layout) {
  for (const PacketEvents & packet : packets_) check(layout, file, packet);
}

Chunk EventReader::count(std::size_t end) {
  if (end < counted_ || end > packets_.size())
    throw std::invalid_argument("packets are counted once, in their order");
  Chunk chunk{counted_, end, run_.clock(), rows_, {}};
  for (; counted_ < end; ++counted_) count_packet(counted_);
  chunk.rows_after = rows_;
  return chunk;
}

void EventReader::count_packet(std::size_t number) {
  PacketEvents & packet = packets_[number];
  const Headers headers(layout_, packet, file_, run_);
  const auto end = packet.content_bits;
  const EventLayout * event_of_id_0 = nullptr;
  if (const auto id_0 = headers.stream().event(0); id_0 != none)
    event_of_id_0 = &layout_.events[static_cast<std::size_t>(id_0)];
  run_.set_budget(budget_per_byte * ((end + 7) >> 3));
  auto clock = run_.clock();
  std::int64_t position = 0;
  auto reached = headers.open();
  while (!reached.failed() && reached.bits() < end) {
    position = reached.bits();
    clock = run_.clock();
    const auto header = headers.read(position);
    reached = header.behind;
    if (!reached.failed())
      reached =
          believed(headers, packet, run_, position, reached.bits(), event_of_id_0, header.event);
    if (reached.failed()) break;
    const EventLayout & event = *header.event;
    reached = headers.step_over(header);
    if (!run_.afford(event.cost)) reached = Failure::over_budget;
    if (!reached.failed() && reached.bits() == position) reached = Failure::truncated;
    if (reached.failed()) break;
    ++counts_[static_cast<std::size_t>(header.event - layout_.events.data())];
    if (event.table != none) ++rows_[static_cast<std::size_t>(event.table)];
  }
  if (!reached.failed()) return;
  bad_events_.push_back({number, packet.offset + (position >> 3), reached.failure()});
  packet.content_bits = position;
  run_.set_whole_clock(clock);
}

std::vector<Text> EventReader::write(const Chunk & chunk, std::span<const TableColumns> tables,
                                     std::span<const std::int64_t> first_rows) const {
  auto rows = chunk.rows_before, ends = chunk.rows_after;
  if (chunk.first > chunk.end || chunk.end > counted_ || tables.size() != rows.size() ||
      first_rows.size() != rows.size() || ends.size() != rows.size())
    throw std::invalid_argument("a chunk, or tables, of another file");
  for (std::size_t table = 0; table < rows.size(); ++table) {
    if (first_rows[table] < 0 ||
        first_rows[table] > static_cast<std::int64_t>(tables[table].times_ns.size()))
      throw std::invalid_argument("rows that are not in their table");
    rows[table] += first_rows[table];
    ends[table] += first_rows[table];
    check(layout_.tables[table], tables[table], ends[table]);
  }
  Run run(layout_);
  run.set_whole_clock(chunk.clock);
  RowWriter writer(layout_, file_, tables, std::move(rows), std::move(ends));
  for (auto number = chunk.first; number < chunk.end; ++number) {
    const PacketEvents & packet = packets_[number];
    const Headers headers(layout_, packet, file_, run);
    auto reached = headers.open();
    while (!reached.failed() && reached.bits() < packet.content_bits) {
      const auto header = headers.read(reached.bits());
      if (header.behind.failed()) file_changed();
      reached = header.event->table != none ? writer.write(header, packet, headers, run)
                                            : headers.step_over(header);
    }
    if (reached.failed() || (packet.content_bits > 0 && reached.bits() > packet.content_bits))
      file_changed();
  }
  if (!writer.finish()) file_changed();
  return writer.texts();
}

}  // namespace chainshaper::ctf
