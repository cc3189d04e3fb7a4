// Where the bits of packets are: `lay_out` turns a trace's types into steps that the decoder runs.
//
// The types of a scope (a header, a context, an event's fields) become a list of steps. Fields of
// fixed size in a row, of which none is wanted, become a single step. Events of constant layout
// need no steps at all: their wanted fields are at known places. Positions are bits from the start
// of a packet.

#pragma once

#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "ctf/types.hpp"

namespace chainshaper::ctf {

// Numbers that steps store for later steps, or for the decoder. The first ones are the fields of
// the packet header and packet context that are named here. Behind them come the lengths and tags
// to which types refer.
enum Variable : std::uint8_t {
  event_id,
  magic,
  stream_id,
  stream_instance_id,
  timestamp_begin,
  timestamp_end,
  packet_seq_num,
  events_discarded,
  cpu_id,
  content_size,
  packet_size,
  uuid_low,
  uuid_high,
  well_known_variables,
};

inline constexpr std::int32_t none = -1;

struct Step {
  enum class Does : std::uint8_t {
    skip,        // `size` bits
    number,      // reads an integer
    move,        // reads an integer of 8, 16, 32 or 64 bits with the same bytes as in memory
    text,        // reads bytes up to a NUL
    characters,  // reads `count` bytes; of a text only those before a NUL
    skip_many,   // `count` elements of `size` bits
    loop,        // runs the steps behind it `count` times, then goes on at `target`
    again,       // the end of a loop's turn; `target` is its first step
    choose,      // goes on at the target of the range that a tag is in
    jump,        // goes on at `target`
  };

  Does does;
  bool is_signed{false};
  bool big_endian{false};
  bool sets_clock{false};
  bool is_text{false};
  std::int32_t variable{none};  // that is set by a number; or has `count`, or the tag of `choose`
  std::int32_t column{none};    // column of the event's table to which the value goes
  std::int64_t align{1};        // bits
  std::int64_t size{0};         // bits
  std::int64_t count{0};        // if it is constant, else `variable` has it
  std::size_t target{0};        // a step
  std::size_t first_range{0};   // of `choose`: its first one in Layout::ranges
  std::size_t ranges{0};        // of `choose`: how many it has
  std::int64_t least{0};        // the fewest bits that an element of a loop takes
  std::int64_t cost{0};         // of an element of a loop, see run.hpp
};

// Steps [first, end) of a layout.
struct Steps {
  std::size_t first{0};
  std::size_t end{0};
};

// Tags from `low` to `high`, as `Integer::ordered` returns them, choose the step `target`.
struct TagRange {
  std::uint64_t low;
  std::uint64_t high;
  std::size_t target;
};

// A value at a constant place in an event, which goes to a column.
struct Move {
  std::int64_t offset;  // bytes from the aligned start of the event's contexts and payload
  std::int64_t length;  // bytes
  std::int32_t column;  // of the event's table
  bool is_characters;   // the column gets the code of a text, else the bytes themselves
  bool is_text;         // characters that end at a NUL
};

struct EventLayout {
  // Pass 1 steps over an event of constant layout at once, by these two:
  std::int64_t align{0};     // 0: the layout is not constant
  std::int64_t size{0};      // bits
  std::int64_t cost{0};      // of header and steps, and the bytes of a row
  std::int32_t table{none};  // that it goes to; none: it is not wanted
  bool is_moved{false};      // whether pass 2 needs only `moves`, not `steps`
  Steps steps;               // of contexts and payload
  std::vector<Move> moves;
};

// LTTng's compact or large event header, if a stream has one: an id of few bits, then the clock's
// low bits, both of which are read at once. An id of all ones announces the long form of the
// header, which is read by its steps.
struct QuickHeader {
  std::int64_t align{0};  // 0: the stream has another header
  std::int64_t id_bits{0};
  std::int64_t clock_shift{0};
  std::int64_t clock_bits{0};
};

// What follows a quick header with some id. Stepping from one event to the next waits for little
// more than to load this.
struct QuickEvent {
  std::int32_t event{none};  // class
  std::int32_t span{0};  // bits from the header's aligned start to the event's end; 0: not known
};

// Where the process and the thread of an event are, as 32 bits each: bits from where the event's
// contexts begin.
struct ProcessPlace {
  std::int64_t align{0};  // 0: not known; or a kernel's trace, in which 0 is a valid number
  std::int64_t process{0};
  std::int64_t thread{0};
};

struct StreamLayout {
  std::int64_t id;
  Steps packet_header;
  Steps packet_context;
  Steps event_header;
  QuickHeader quick;
  ProcessPlace process;
  std::int64_t frequency_hz;
  std::int64_t packet_cost;
  std::int64_t default_event{0};  // the id of events whose header has none
  std::uint32_t known{0};         // bit n: packets have Variable n
  std::pair<std::int64_t, std::int64_t> uuid{0, 0};
  std::vector<std::int32_t> events;      // event class by small id, or `none`
  std::vector<QuickEvent> quick_events;  // the same, of streams with a quick header
  std::vector<std::pair<std::int64_t, std::int32_t>> rare_events;  // large id and class, ascending

  bool knows(Variable variable) const { return (known >> variable & 1) != 0; }

  // Returns the event class of an id, in Layout::events; `none`: it is not declared.
  std::int32_t event(std::int64_t id_of_event) const {
    if (static_cast<std::uint64_t>(id_of_event) < events.size())
      return events[static_cast<std::size_t>(id_of_event)];
    return rare_event(id_of_event);
  }

private:
  std::int32_t rare_event(std::int64_t id_of_event) const;
};

// The dynamic scopes behind an event's header.
enum class Scope : std::uint8_t { stream_event_context, event_context, event_fields };

// A field that gets a column: its number in the structure of its scope.
struct ColumnField {
  Scope scope;
  std::size_t field;
};

// An event class that is wanted; classes are numbered over all traces, in order of declaration.
struct WantedEvent {
  std::size_t event;
  std::int32_t table;
  std::vector<ColumnField> columns;  // in the order in which the fields are recorded
};

// A table that wanted events go to.
struct TableLayout {
  bool has_cpu;
  // The bytes of a value of each column: for an integer the next power of two, for a text 4, since
  // its column has codes.
  std::vector<std::int64_t> widths;
};

struct Layout {
  std::vector<Step> steps;
  std::vector<TagRange> ranges;
  std::vector<StreamLayout> streams;
  std::vector<EventLayout> events;
  std::vector<TableLayout> tables;
  std::vector<std::pair<std::size_t, std::size_t>> traces;  // [first, end) of each one's streams
  std::int32_t variables{well_known_variables};
  std::size_t types{0};  // that were laid out

  std::span<const StreamLayout> streams_of(std::size_t trace) const {
    const auto [first, end] = traces.at(trace);
    return std::span(streams).subspan(first, end - first);
  }
};

// Stands for all larger sizes: no packet has so many bits. The sum of two of them does not
// overflow.
inline constexpr std::int64_t endless_bits = std::int64_t{1} << 56;

// Thrown if a trace cannot be laid out: a length or tag is no number, types are nested too deeply,
// or a field can have no column.
struct LayoutError : std::invalid_argument {
  LayoutError(const std::string & reason, std::size_t number)
      : std::invalid_argument(reason), trace(number) {}

  std::size_t trace;  // its number among the traces
};

// Lays out all streams and events of some traces. `wanted` are in order of the events. Throws
// LayoutError.
Layout lay_out(std::span<const TraceClass> traces, std::span<const WantedEvent> wanted);

// Returns the bytes that a value of a type takes in a column; none: it can have no column.
std::optional<std::int64_t> column_width(const Kind & kind);

}  // namespace chainshaper::ctf
