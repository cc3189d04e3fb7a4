#include "ctf/packets.hpp"

#include <algorithm>
#include <functional>
#include <optional>

#include "ctf/run.hpp"

namespace chainshaper::ctf {
namespace {

// After so many damaged places the rest of a file is not read.
constexpr std::size_t most_damaged = 1000;

class Search {
public:
  Search(const Layout & layout, std::size_t trace, Bytes file)
      : streams_(layout.streams_of(trace)),
        first_stream_(layout.traces[trace].first),
        file_(file),
        variables_cost_(layout.variables / 8),
        run_(layout) {
    run_.set_budget(budget_per_byte * static_cast<std::int64_t>(file.size()));
  }

  // Lists packets from `offset` on. Returns the first place that is no whole packet; none: the end
  // of the file was reached.
  std::optional<DamagedPlace> read_from(std::int64_t offset, std::vector<Packet> & packets) {
    const auto size = static_cast<std::int64_t>(file_.size());
    while (offset < size) {
      Packet packet{};
      if (const auto damage = read(offset, packet)) return DamagedPlace{*damage, offset, -1};
      const auto bytes = packet.size;
      packet.size = std::min(packet.size, size - offset);
      packet.content_bits = std::min(packet.content_bits, 8 * packet.size);
      packets.push_back(packet);
      if (bytes > packet.size) return DamagedPlace{Damage::cut, offset, -1};
      offset += bytes;
    }
    return std::nullopt;
  }

private:
  // Reads a packet's header and context. Its sizes are those that it has itself, if possible ones.
  std::optional<Damage> read(std::int64_t offset, Packet & packet) {
    const auto bytes = file_.subspan(static_cast<std::size_t>(offset));
    const Content content{bytes, static_cast<std::int64_t>(8 * bytes.size())};
    const StreamLayout & leading = streams_.front();
    run_.forget_variables();
    run_.set_variable(stream_id, leading.id);
    const auto header = run_.steps(leading.packet_header, content, 0);
    if (header.failed()) return Damage::bad_header;
    if (leading.knows(magic) && run_.variable(magic) != std::int64_t{packet_magic})
      return Damage::bad_magic;
    if (leading.knows(uuid_low) &&
        leading.uuid != std::pair{run_.variable(uuid_low), run_.variable(uuid_high)})
      return Damage::bad_uuid;
    const auto stream = std::find_if(streams_.begin(), streams_.end(), [&](const auto & each) {
      return each.id == run_.variable(stream_id);
    });
    if (stream == streams_.end()) return Damage::bad_stream;
    const auto number = stream - streams_.begin();
    if (!run_.afford(stream->packet_cost + number + variables_cost_)) return Damage::costly;
    const auto context = run_.steps(stream->packet_context, content, header.bits());
    if (context.failed()) return Damage::bad_header;
    const auto bits = known_or(*stream, packet_size, content.end);
    const auto content_bits = known_or(*stream, content_size, bits);
    if (bits <= 0 || (bits & 7) != 0 || content_bits < context.bits() || content_bits > bits)
      return Damage::bad_size;
    packet = {.offset = offset,
              .size = bits >> 3,
              .content_bits = content_bits,
              .stream_class = static_cast<std::int64_t>(first_stream_) + number,
              .instance = known_or(*stream, stream_instance_id, -1),
              .begin = known_or(*stream, timestamp_begin, -1),
              .end = known_or(*stream, timestamp_end, -1),
              .sequence = known_or(*stream, packet_seq_num, -1),
              .discarded = known_or(*stream, events_discarded, -1),
              .cpu = known_or(*stream, cpu_id, -1)};
    return std::nullopt;
  }

  std::int64_t known_or(const StreamLayout & stream, Variable variable,
                        std::int64_t fallback) const {
    return stream.knows(variable) ? run_.variable(variable) : fallback;
  }

  std::span<const StreamLayout> streams_;
  std::size_t first_stream_;
  Bytes file_;
  std::int64_t variables_cost_;  // what it costs to forget all variables before a packet
  Run run_;
};

// Returns the first place of `content` in a file from `start` on; -1: there is none.
std::int64_t find(Bytes file, Bytes content, std::int64_t start) {
  const auto from = file.begin() + std::min(start, static_cast<std::int64_t>(file.size()));
  const auto place = std::search(
      from, file.end(), std::boyer_moore_horspool_searcher(content.begin(), content.end()));
  return place == file.end() ? -1 : place - file.begin();
}

}  // namespace

FoundPackets find_packets(const Layout & layout, std::size_t trace, Bytes file, Bytes beginning) {
  FoundPackets result;
  if (layout.streams_of(trace).empty()) return result;
  Search search(layout, trace, file);
  for (std::int64_t offset = 0; offset >= 0;) {
    auto place = search.read_from(offset, result.packets);
    if (!place) break;
    if (!beginning.empty() && place->damage != Damage::costly &&
        result.damaged.size() < most_damaged)
      place->following = find(file, beginning, place->offset + 1);
    if (place->damage == Damage::cut && place->following >= 0) {
      Packet & cut = result.packets.back();
      cut.size = place->following - place->offset;
      cut.content_bits = std::min(cut.content_bits, 8 * cut.size);
    }
    result.damaged.push_back(*place);
    offset = place->following;
  }
  return result;
}

}  // namespace chainshaper::ctf
