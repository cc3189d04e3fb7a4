// Finds the packets of a stream file (CTF 1.8, section 5), and goes on after damaged parts.

#pragma once

#include <cstdint>
#include <vector>

#include "ctf/bits.hpp"
#include "ctf/layout.hpp"

namespace chainshaper::ctf {

inline constexpr std::uint32_t packet_magic = 0xC1FC1FC1;

// What a packet's header and context say. Numbers that they do not have are -1.
struct Packet {
  std::int64_t offset;        // bytes from the file's beginning
  std::int64_t size;          // bytes, not more than the file has
  std::int64_t content_bits;  // header, context and events
  std::int64_t stream_class;  // in Layout::streams
  std::int64_t instance;      // which stream of that class
  std::int64_t begin;         // when it was opened, in clock cycles
  std::int64_t end;           // when it was closed, in clock cycles
  std::int64_t sequence;      // its number in the stream
  std::int64_t discarded;     // events that the tracer dropped so far
  std::int64_t cpu;           // the core on which its events were recorded
};

// What is wrong at a place where a packet should be.
enum class Damage : std::uint8_t {
  bad_magic,   // it does not begin with the magic number
  bad_uuid,    // it belongs to another trace
  bad_stream,  // of a stream class that is not declared
  bad_size,    // impossible sizes of content or packet
  bad_header,  // its header is cut short
  cut,         // it has no end: the file ends, or another packet begins; it is listed anyway
  costly,      // headers that take far more work than their size warrants
};

struct DamagedPlace {
  Damage damage;
  std::int64_t offset;     // bytes from the file's beginning
  std::int64_t following;  // where the next packet begins; -1: the rest of the file is not read
};

struct FoundPackets {
  std::vector<Packet> packets;  // in order of the file
  std::vector<DamagedPlace> damaged;
};

// Finds the packets of a file of a trace. After damage it goes on at the next place with the bytes
// of `beginning`, with which each packet of the trace begins. Without such bytes it ends there.
FoundPackets find_packets(const Layout & layout, std::size_t trace, Bytes file, Bytes beginning);

}  // namespace chainshaper::ctf
