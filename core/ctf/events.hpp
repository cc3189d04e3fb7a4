// The events of a stream file: counted in a first pass, so that each has its row, and written to
// the columns of their tables in a second one. Files are cut into chunks of packets, which several
// threads can write at once.

#pragma once

#include <cstdint>
#include <limits>
#include <span>
#include <stdexcept>
#include <vector>

#include "ctf/packets.hpp"
#include "ctf/run.hpp"

namespace chainshaper::ctf {

// A packet whose events are to be read. EventReader checks that it is in the file.
struct PacketEvents {
  std::int64_t offset;        // bytes from the file's beginning
  std::int64_t content_bits;  // pass 1 shortens it to what can be read
  std::int64_t stream_class;  // in Layout::streams
  std::int64_t cpu;
  // In clock cycles; what the times of its events can be.
  std::int64_t earliest{std::numeric_limits<std::int64_t>::min()};
  std::int64_t latest{std::numeric_limits<std::int64_t>::max()};
};

// An event that cannot be read, which ends its packet.
struct BadEvent {
  std::size_t packet;
  std::int64_t offset;  // bytes from the file's beginning
  Failure failure;
};

// Packets [first, end) of a file; the clock before the first one, and how many rows of each table
// the file's events before and up to the chunk's end have.
struct Chunk {
  std::size_t first;
  std::size_t end;
  std::uint64_t clock;
  std::vector<std::int64_t> rows_before;
  std::vector<std::int64_t> rows_after;
};

// The columns of a table. `times_ns` and `cpus` (may be empty) have as many rows as the columns.
struct TableColumns {
  std::span<std::int64_t> times_ns;
  std::span<std::int32_t> cpus;
  std::vector<Column> columns;  // as the layout's table has them
};

// A file has not the events that were counted.
struct FileChanged : std::runtime_error {
  using std::runtime_error::runtime_error;
};

class EventReader {
public:
  // Throws std::invalid_argument for packets that are not in the file or of no stream class.
  EventReader(const Layout & layout, Bytes file, std::vector<PacketEvents> packets);

  // Pass 1. Steps over all events of the packets up to `end`, the first ones that were not counted
  // yet, counts them, and shortens packets to what can be read.
  Chunk count(std::size_t end);

  // Pass 2. Writes the events of a chunk that go to tables, whose rows of this file begin at
  // `first_rows`; returns the texts that text columns have codes of. Throws FileChanged. Threads
  // may write at once.
  std::vector<Text> write(const Chunk & chunk, std::span<const TableColumns> tables,
                          std::span<const std::int64_t> first_rows) const;

  const std::vector<PacketEvents> & packets() const { return packets_; }
  const std::vector<std::int64_t> & counts() const { return counts_; }  // per event class
  const std::vector<std::int64_t> & rows() const { return rows_; }      // per table
  const std::vector<BadEvent> & bad_events() const { return bad_events_; }

private:
  void count_packet(std::size_t number);

  const Layout & layout_;
  Bytes file_;
  std::vector<PacketEvents> packets_;
  std::vector<std::int64_t> counts_;
  std::vector<std::int64_t> rows_;
  std::vector<BadEvent> bad_events_;
  std::size_t counted_{0};  // packets
  Run run_;
};

}  // namespace chainshaper::ctf
