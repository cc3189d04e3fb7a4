// The trace decoder, over packets written by hand.

#include <algorithm>
#include <cstring>
#include <numeric>
#include <random>
#include <string>
#include <vector>

#include "ctf/events.hpp"
#include "ctf/sorting.hpp"
#include "expect.hpp"

namespace {

using namespace chainshaper::ctf;

Type integer(std::int64_t size, std::int64_t align = 8, bool is_signed = false, bool clock = false,
             bool big_endian = false) {
  return checked({Integer{size, align, is_signed, big_endian, clock, {}}});
}

Type array(const Type & element, std::variant<std::int64_t, std::string> length, bool is_text) {
  return checked({Array{element, std::move(length), is_text}});
}

// A trace whose packets have a magic number and two sizes, and whose events a time of `bits` only.
TraceClass trace_of(Structure fields, std::int64_t bits = 8) {
  TraceClass trace{};
  trace.referenced = {"n", "tag"};
  trace.packet_header = Structure{{{"magic", integer(32)}}, 8};
  StreamClass stream{};
  stream.frequency_hz = 1'000'000'000;
  stream.packet_context =
      Structure{{{"content_size", integer(32)}, {"packet_size", integer(32)}}, 8};
  stream.event_header = Structure{{{"timestamp", integer(bits, 8, false, true)}}, 8};
  stream.events.push_back({0, std::nullopt, std::move(fields)});
  trace.streams.push_back(std::move(stream));
  return trace;
}

using File = std::vector<std::uint8_t>;

void append(File & file, std::uint32_t number) {
  for (int byte = 0; byte < 4; ++byte)
    file.push_back(static_cast<std::uint8_t>(number >> 8 * byte));
}

void append_packet(File & file, const std::string & events) {
  const auto bits = static_cast<std::uint32_t>(8 * (12 + events.size()));
  for (const auto number : {packet_magic, bits, bits}) append(file, number);
  file.insert(file.end(), events.begin(), events.end());
}

// What a trace of one event class is read as.
struct Read {
  FoundPackets search;
  std::vector<std::int64_t> times_ns;
  std::vector<std::vector<std::int64_t>> columns;  // integers; of texts the codes
  std::vector<std::string> texts;
  std::vector<BadEvent> bad_events;
};

std::int64_t value_at(const std::vector<std::uint8_t> & column, std::size_t row,
                      std::int64_t width) {
  std::int64_t value = 0;
  std::memcpy(&value, column.data() + row * static_cast<std::size_t>(width),
              static_cast<std::size_t>(width));
  return value;
}

Read read(const TraceClass & trace, const File & file, const std::vector<std::size_t> & fields) {
  WantedEvent wanted{0, 0, {}};
  for (const auto field : fields) wanted.columns.push_back({Scope::event_fields, field});
  const auto layout = lay_out(std::span(&trace, 1), std::span(&wanted, 1));
  Read read;
  const std::uint8_t beginning[] = {0xC1, 0x1F, 0xFC, 0xC1};
  read.search = find_packets(layout, 0, file, beginning);
  std::vector<PacketEvents> packets;
  for (const auto & packet : read.search.packets)
    packets.push_back({packet.offset, packet.content_bits, packet.stream_class, packet.cpu});
  EventReader reader(layout, file, packets);
  const auto chunk = reader.count(packets.size());
  const auto rows = static_cast<std::size_t>(reader.rows()[0]);
  read.times_ns.resize(rows);
  std::vector<std::vector<std::uint8_t>> values;
  TableColumns table{read.times_ns, {}, {}};
  for (const auto width : layout.tables[0].widths)
    values.emplace_back(rows * static_cast<std::size_t>(width));
  for (std::size_t column = 0; column < values.size(); ++column)
    table.columns.push_back({values[column].data(), layout.tables[0].widths[column], rows});
  const std::int64_t first_row = 0;
  for (const auto & text : reader.write(chunk, std::span(&table, 1), std::span(&first_row, 1)))
    read.texts.emplace_back(reinterpret_cast<const char *>(text.place),
                            static_cast<std::size_t>(text.length));
  sort_by_time(table);
  for (std::size_t column = 0; column < values.size(); ++column) {
    auto & numbers = read.columns.emplace_back();
    for (std::size_t row = 0; row < rows; ++row)
      numbers.push_back(value_at(values[column], row, table.columns[column].width));
  }
  read.bad_events = reader.bad_events();
  return read;
}

using namespace std::string_literals;

void clocks_of_few_bits_wrap_forward() {
  File file;
  append_packet(file, "\xF0\x01\xFE\x02\x03\x03"s);
  const auto [search, times_ns, columns, texts, bad] =
      read(trace_of({{{"x", integer(8)}}, 8}), file, {0});
  EXPECT((times_ns == std::vector<std::int64_t>{0xF0, 0xFE, 0x103}));
  EXPECT((columns[0] == std::vector<std::int64_t>{1, 2, 3}));
  EXPECT(bad.empty());
}

void bits_of_both_byte_orders() {
  // 3 and 5 bits of 0b10110_011; big-endian 12 bits of 0xABC, then 4.
  File file;
  append_packet(file, "\x01\xB3\xAB\xCD"s);
  const auto trace = trace_of({{{"low", integer(3, 1)},
                                {"high", integer(5, 1, true)},
                                {"big", integer(12, 1, false, false, true)},
                                {"rest", integer(4, 1, false, false, true)}},
                               8});
  const auto columns = read(trace, file, {0, 1, 2, 3}).columns;
  EXPECT(columns[0][0] == 3 && columns[2][0] == 0xABC && columns[3][0] == 0xD);
  EXPECT(static_cast<std::int8_t>(columns[1][0]) == -10);
}

void texts_and_sequences() {
  const auto trace = trace_of(
      {{{"s", checked({String{}})}, {"n", integer(8)}, {"bytes", array(integer(8), "n", false)}},
       8});
  File good;
  append_packet(good,
                "\x01"
                "abc\0"
                "\x02"
                "xy"
                "\x02"
                "\0"
                "\x01"
                "q"
                "\x03"
                "abc\0"
                "\0"s);
  const auto whole = read(trace, good, {0, 2});
  EXPECT((whole.texts == std::vector<std::string>{"abc", "xy", "", "q"}));
  EXPECT((whole.columns[0] == std::vector<std::int64_t>{0, 2, 0}));
  EXPECT((whole.columns[1] == std::vector<std::int64_t>{1, 3, 2}));
}

void variants_take_the_option_of_their_tag() {
  Integer tag{8, 8, true, false, false, {}};
  tag.labels["small"] = {{tag.ordered(static_cast<std::uint64_t>(-2)), tag.ordered(0)}};
  tag.labels["large"] = {{tag.ordered(5), tag.ordered(6)}};
  const Variant variant{"tag", {{"small", integer(8)}, {"_large", integer(32)}}};
  const auto trace =
      trace_of({{{"tag", checked({tag})}, {"v", checked({variant})}, {"last", integer(8)}}, 8});
  File file;
  append_packet(file,
                "\x01\xFE\x07\x11\x02\x06"
                "1234"
                "\x12\x03\x09\x13"s);
  const auto result = read(trace, file, {2});
  EXPECT((result.columns[0] == std::vector<std::int64_t>{0x11, 0x12}));
  EXPECT(result.bad_events.size() == 1 && result.bad_events[0].failure == Failure::no_option);
  EXPECT(result.bad_events[0].offset == 12 + 4 + 7);
}

void packets_behind_damage_are_found() {
  File file;
  append_packet(file, "\x01\x01"s);
  file.insert(file.end(), 5, 0x55);
  append_packet(file, "\x02\x02"s);
  append(file, packet_magic);
  append(file, 8 * 100);
  append(file, 8 * 100);
  const auto result = read(trace_of({{{"x", integer(8)}}, 8}), file, {0});
  EXPECT((result.columns[0] == std::vector<std::int64_t>{1, 2}));
  EXPECT(result.search.damaged.size() == 2);
  EXPECT(result.search.damaged[0].damage == Damage::bad_magic);
  EXPECT(result.search.damaged[0].offset == 14 && result.search.damaged[0].following == 19);
  EXPECT(result.search.damaged[1].damage == Damage::cut);
  EXPECT(result.search.packets.size() == 3 && result.search.packets[2].size == 12);
}

void rows_are_sorted_by_time_and_stay_in_order() {
  std::vector<std::int64_t> times_ns{1, 4, 4, 2, 4, 5, 0};
  std::vector<std::uint8_t> values{0, 1, 2, 3, 4, 5, 6};
  sort_by_time({times_ns, {}, {{values.data(), 1, values.size()}}});
  EXPECT((times_ns == std::vector<std::int64_t>{0, 1, 2, 4, 4, 4, 5}));
  EXPECT((values == std::vector<std::uint8_t>{6, 0, 3, 1, 2, 4, 5}));
}

// Rows of a time that is not theirs, or that are not in their order, would not be where a stable
// sort puts them.
void expect_sorted(std::vector<std::int64_t> times_ns) {
  std::vector<std::uint32_t> rows(times_ns.size());
  std::iota(rows.begin(), rows.end(), 0U);
  auto expected = rows;
  std::stable_sort(expected.begin(), expected.end(),
                   [&](auto left, auto right) { return times_ns[left] < times_ns[right]; });
  sort_by_time({times_ns, {}, {{reinterpret_cast<std::uint8_t *>(rows.data()), 4, rows.size()}}});
  EXPECT(rows == expected);
  EXPECT(std::is_sorted(times_ns.begin(), times_ns.end()));
}

void many_rows_are_sorted_in_blocks() {
  std::mt19937_64 chance(1);
  const auto below = [&](std::int64_t limit) {
    return static_cast<std::int64_t>(chance() % static_cast<std::uint64_t>(limit));
  };
  for (const std::int64_t runs : {2, 3, 8, 1000}) {
    std::vector<std::int64_t> times_ns;
    for (std::int64_t run = 0; run < runs; ++run) {
      std::int64_t now = below(1000) - 500;
      for (auto rows = below(100'000 / runs); rows >= 0; --rows)
        times_ns.push_back(now += below(3));  // many are equal
    }
    expect_sorted(times_ns);
  }
  std::vector<std::int64_t> descending(50'000);
  std::iota(descending.rbegin(), descending.rend(), 0);
  expect_sorted(descending);
  std::vector<std::int64_t> equal(50'000);
  equal.front() = 1;
  expect_sorted(equal);
}

void what_cannot_be_is_refused() {
  EXPECT_REFUSED(integer(65));
  EXPECT_REFUSED(integer(8, 3));
  EXPECT_REFUSED(array(integer(8), std::int64_t{-1}, false));
  const File file;
  EXPECT_REFUSED(read(trace_of({{{"a", array(integer(8), "absent", false)}}, 8}), file, {0}));
  EXPECT_REFUSED(read(trace_of({{{"x", integer(8)}}, 8}), file, {1}));
  const auto trace = trace_of({{{"x", integer(8)}}, 8});
  const auto layout = lay_out(std::span(&trace, 1), {});
  EXPECT_REFUSED(EventReader(layout, file, {{0, 8, 0, 0}}));
  EXPECT_REFUSED(EventReader(layout, file, {{0, 0, 1, 0}}));
}

}  // namespace

int main() {
  clocks_of_few_bits_wrap_forward();
  bits_of_both_byte_orders();
  texts_and_sequences();
  variants_take_the_option_of_their_tag();
  packets_behind_damage_are_found();
  rows_are_sorted_by_time_and_stay_in_order();
  many_rows_are_sorted_in_blocks();
  what_cannot_be_is_refused();
}
