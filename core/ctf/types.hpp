// What a trace's metadata declares (Common Trace Format 1.8, sections 4 and 7): types of fields,
// and the classes of streams and events that are made of them. Sizes and alignments are in bits.
//
// Numbers need not be checked before: `checked` (below) refuses impossible ones.

#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <variant>
#include <vector>

namespace chainshaper::ctf {

struct Kind;

// A type of fields. Fields whose type is declared once share it.
using Type = std::shared_ptr<const Kind>;

struct Field {
  std::string name;  // as the metadata writes it, with LTTng's leading underscore
  Type type;
};

// Values of an enumeration, both ends included, as `Integer::ordered` returns them.
struct Range {
  std::uint64_t low;
  std::uint64_t high;
};

// An integer or an enumeration (4.1.5, 4.1.8).
struct Integer {
  std::int64_t size;  // 1 to 64
  std::int64_t align;
  bool is_signed;
  bool big_endian;
  bool maps_clock;                                   // its value is the low bits of the clock
  std::map<std::string, std::vector<Range>> labels;  // of an enumeration

  // Returns an unsigned number for each value of this type, in the same order: the top bit of a
  // signed value is inverted.
  std::uint64_t ordered(std::uint64_t bits) const {
    return is_signed ? bits ^ (std::uint64_t{1} << 63) : bits;
  }
};

struct String {};  // bytes up to and with the first NUL (4.2.5)

// An array, or a sequence, whose length is the value of a field before it (4.2.3, 4.2.4).
struct Array {
  Type element;
  std::variant<std::int64_t, std::string>
      length;    // the number of elements, or the path of the field that has it
  bool is_text;  // of characters: a text ends at the first NUL
};

struct Structure {  // 4.2.1
  std::vector<Field> fields;
  std::int64_t align;  // at least that of each field
};

struct Variant {                   // 4.2.2
  std::optional<std::string> tag;  // the path of the enumeration that chooses an option
  std::vector<Field> options;
};

struct Kind {
  std::variant<Integer, String, Array, Structure, Variant> is;
};

struct EventClass {
  std::int64_t id;
  std::optional<Structure> context;
  std::optional<Structure> fields;
};

struct StreamClass {
  std::int64_t id;
  std::optional<Structure> packet_context;
  std::optional<Structure> event_header;
  std::optional<Structure> event_context;
  std::vector<EventClass> events;
  std::int64_t frequency_hz;  // of the clock that its time stamps are mapped to
};

struct TraceClass {
  bool big_endian;
  bool of_kernel;  // in a kernel trace, 0 is a valid number of a thread
  std::optional<std::pair<std::int64_t, std::int64_t>>
      uuid;  // its bytes as two little-endian words
  std::optional<Structure> packet_header;
  std::set<std::string> referenced;  // names of fields that lengths and tags refer to
  std::vector<StreamClass> streams;
};

// Returns the alignment of a type; a variant has none: 1.
std::int64_t alignment(const Type & type);

// Returns a type. Throws std::invalid_argument for an impossible size, alignment or length.
Type checked(Kind kind);

}  // namespace chainshaper::ctf
