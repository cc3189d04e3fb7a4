// Descriptions of traces made from the bytes of a fuzzer: whatever metadata can declare.

#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>

#include "ctf/types.hpp"

namespace chainshaper::fuzz {

// Takes bytes from the front of an input; 0s once it is used up.
class Source {
public:
  explicit Source(std::span<const std::uint8_t> bytes) : bytes_(bytes) {}

  std::uint8_t byte() {
    if (bytes_.empty()) return 0;
    const auto first = bytes_.front();
    bytes_ = bytes_.subspan(1);
    return first;
  }

  std::int64_t below(std::int64_t count) { return byte() % count; }
  std::span<const std::uint8_t> rest() const { return bytes_; }

private:
  std::span<const std::uint8_t> bytes_;
};

class Describer {
public:
  explicit Describer(Source & source) : source_(source) {}

  ctf::TraceClass trace() {
    ctf::TraceClass trace{};
    const auto form = source_.byte();
    trace.big_endian = (form & 1) != 0;
    trace.of_kernel = (form & 2) != 0;
    big_endian_ = trace.big_endian;
    for (const char * name : names_) trace.referenced.insert(name);
    if ((form & 4) != 0) trace.uuid = std::pair{std::int64_t{0}, std::int64_t{0}};
    trace.packet_header = (form & 8) != 0 ? structure(0) : packet_header();
    const auto streams = 1 + source_.below(2);
    for (std::int64_t id = 0; id < streams; ++id) trace.streams.push_back(stream(id));
    return trace;
  }

private:
  static constexpr std::array names_{"id", "n", "tag", "_length", "vpid", "vtid", "cpu_id"};

  ctf::Type integer(std::int64_t size, std::int64_t align, bool clock = false) {
    return ctf::checked({ctf::Integer{size, align, false, big_endian_, clock, {}}});
  }

  ctf::Structure packet_header() {
    return {{{"magic", integer(32, 8)}, {"stream_id", integer(8, 8)}}, 8};
  }

  ctf::Structure packet_context() {
    return {{{"timestamp_begin", integer(64, 8, true)},
             {"timestamp_end", integer(64, 8, true)},
             {"content_size", integer(32, 8)},
             {"packet_size", integer(32, 8)},
             {"packet_seq_num", integer(64, 8)},
             {"events_discarded", integer(64, 8)},
             {"cpu_id", integer(32, 8)}},
            8};
  }

  // The headers that LTTng writes.
  ctf::Structure event_header(bool compact) {
    const std::int64_t bits = compact ? 5 : 16;
    const auto last = (std::uint64_t{1} << bits) - 1;
    const ctf::Integer id{bits,  compact ? 1 : 8,
                          false, big_endian_,
                          false, {{"compact", {{0, last - 1}}}, {"extended", {{last, last}}}}};
    const ctf::Structure brief{{{"timestamp", integer(compact ? 27 : 32, compact ? 1 : 8, true)}},
                               compact ? 1 : 8};
    const ctf::Structure extended{{{"id", integer(32, 8)}, {"timestamp", integer(64, 8, true)}}, 8};
    const ctf::Variant variant{
        "id", {{"compact", ctf::checked({brief})}, {"extended", ctf::checked({extended})}}};
    return {{{"id", ctf::checked({id})}, {"v", ctf::checked({variant})}}, 8};
  }

  ctf::Structure event_context() {
    const auto character = integer(8, 8);
    return {{{"_vpid", integer(32, 8)},
             {"_vtid", integer(32, 8)},
             {"_procname", ctf::checked({ctf::Array{character, std::int64_t{17}, true}})}},
            8};
  }

  ctf::StreamClass stream(std::int64_t id) {
    ctf::StreamClass stream{};
    const auto form = source_.byte();
    stream.id = id;
    stream.packet_context = (form & 1) != 0 ? structure(0) : packet_context();
    stream.event_header = (form & 2) != 0 ? structure(0) : event_header((form & 4) != 0);
    if ((form & 8) != 0) stream.event_context = event_context();
    if ((form & 16) != 0) stream.event_context = structure(0);
    stream.frequency_hz = (form & 32) != 0 ? 1'000'000'000 : 1 + source_.byte();
    const auto events = 1 + source_.below(4);
    for (std::int64_t number = 0; number < events; ++number) {
      ctf::EventClass event{};
      event.id = (form & 64) != 0 ? number * 5000 : number;
      if (source_.below(4) == 0) event.context = structure(0);
      event.fields = structure(0);
      stream.events.push_back(std::move(event));
    }
    return stream;
  }

  ctf::Structure structure(int depth) {
    ctf::Structure structure{{}, std::int64_t{1} << source_.below(5)};
    const auto fields = source_.below(6);
    for (std::int64_t number = 0; number < fields; ++number)
      structure.fields.push_back(field(depth));
    for (const auto & field : structure.fields)
      structure.align = std::max(structure.align, ctf::alignment(field.type));
    return structure;
  }

  ctf::Field field(int depth) {
    const auto name = source_.below(2 * static_cast<std::int64_t>(names_.size()));
    const std::string text = name < static_cast<std::int64_t>(names_.size())
                                 ? names_[static_cast<std::size_t>(name)]
                                 : "field" + std::to_string(name);
    return {text, type(depth + 1)};
  }

  ctf::Type type(int depth) {
    switch (depth > 4 ? source_.below(4) : source_.below(8)) {
      case 0:
        return integer(8 << source_.below(4), 8);
      case 1:
        return enumeration();
      case 2:
        return ctf::checked({ctf::String{}});
      case 3:
        return ctf::checked({ctf::Array{integer(8, 8), length(), source_.below(2) == 0}});
      case 4:
        return ctf::checked({structure(depth)});
      case 5:
        return ctf::checked({ctf::Array{type(depth + 1), length(), false}});
      case 6:
        return ctf::checked({variant(depth)});
      default:
        return ctf::checked({ctf::Integer{1 + source_.below(64),
                                          std::int64_t{1} << source_.below(7),
                                          source_.below(2) == 0,
                                          source_.below(2) == 0,
                                          source_.below(8) == 0,
                                          {}}});
    }
  }

  ctf::Type enumeration() {
    ctf::Integer integer{8, 8, source_.below(2) == 0, big_endian_, false, {}};
    integer.labels["a"] = {{integer.ordered(0), integer.ordered(3)}};
    integer.labels["b"] = {{integer.ordered(4), integer.ordered(200)}};
    return ctf::checked({integer});
  }

  ctf::Variant variant(int depth) {
    return {reference(), {{"a", type(depth + 1)}, {"_b", type(depth + 1)}}};
  }

  std::string reference() {
    const auto name = names_[static_cast<std::size_t>(source_.below(names_.size()))];
    return source_.below(8) == 0 ? std::string("event.fields.") + name : name;
  }

  std::variant<std::int64_t, std::string> length() {
    const auto number = source_.byte();
    if (number < 128) return reference();
    return number == 255 ? std::int64_t{1} << 31 : std::int64_t{number} - 128;
  }

  Source & source_;
  bool big_endian_{false};
};

}  // namespace chainshaper::fuzz
