// Reads the events of a stream file in two passes. The first pass counts them, so that the row of
// each event is known; the second one writes them to the columns of their tables. Files are cut
// into chunks of packets, which several threads can write at once.

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
  std::int64_t content_bits;  // pass 1 shortens this to what can be read
  std::int64_t stream_class;  // in Layout::streams
  std::int64_t cpu;
  // Between which the times of its events must be, in clock cycles.
  std::int64_t earliest{std::numeric_limits<std::int64_t>::min()};
  std::int64_t latest{std::numeric_limits<std::int64_t>::max()};
};

// An event that cannot be read, which ends its packet.
struct BadEvent {
  std::size_t packet;
  std::int64_t offset;  // bytes from the file's beginning
  Failure failure;
};

// Packets [first, end) of a file.
struct Chunk {
  std::size_t first;
  std::size_t end;
  std::uint64_t clock;                    // before the first packet
  std::vector<std::int64_t> rows_before;  // of each table, from the file's packets before the chunk
  std::vector<std::int64_t> rows_after;   // the same, with the chunk's packets
};

// The columns of a table, all with the same number of rows.
struct TableColumns {
  std::span<std::int64_t> times_ns;
  std::span<std::int32_t> cpus;  // empty if they are not known
  std::vector<Column> columns;   // in the order of the layout's table
};

// Thrown if a file no longer has the events that were counted.
struct FileChanged : std::runtime_error {
  using std::runtime_error::runtime_error;
};

class EventReader {
public:
  // Throws std::invalid_argument for packets that are not in the file, or of an unknown stream
  // class.
  EventReader(const Layout & layout, Bytes file, std::vector<PacketEvents> packets);

  // Pass 1. Counts the events of the packets up to `end` that were not counted yet, and shortens
  // these packets to what can be read.
  Chunk count(std::size_t end);

  // Pass 2. Writes the wanted events of a chunk to their tables, in which the rows of this file
  // begin at `first_rows`. Returns the texts in the order of their codes. Throws FileChanged.
  // Several threads may write chunks at once.
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
