// The log of events, as columns of numbers: an entry for each trace point that a process passes.
//
// Entries and fields have the same names as in logs of live runs
// (chainshaper/workload/event_log.py).

#pragma once

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <vector>

#include "simulation/description.hpp"

namespace chainshaper::simulation {

// The value of a field that is not known or does not apply.
inline constexpr std::int64_t absent = -1;

enum class TracePoint : std::size_t {
  callback_start,
  callback_end,
  publish,
  take,
  execute,
  wait,
  release,
  send,
  context_switch,
  sleep,
  wake,
};

struct EntryNames {
  const char * entry;
  std::vector<const char *> fields;  // that follow time and thread
};

// The names of all entries, in the order of `TracePoint`.
const std::vector<EntryNames> & log_layout();

// Numbers that are given to Python later on, without being copied.
template <typename Number>
using Column = std::unique_ptr<Number[]>;

// The entries of a kind, column by column.
struct EntryColumns {
  std::size_t count{0};  // entries
  std::size_t room{0};   // entries for which the columns have room
  Column<Nanoseconds> times;
  Column<std::int32_t> threads;  // places; `absent`: the idle thread
  std::vector<Column<std::int64_t>> fields;
};

class EventLog {
public:
  // `rows`: the room for entries of each kind, which doubles when it is full.
  explicit EventLog(std::size_t rows);

  // Adds an entry; returns how many entries of its kind the log has now.
  std::size_t add(TracePoint point, Nanoseconds time, std::int32_t thread,
                  std::initializer_list<std::int64_t> fields) {
    EntryColumns & columns = entries_[static_cast<std::size_t>(point)];
    if (columns.count == columns.room) grow(columns);
    const std::size_t row = columns.count++;
    columns.times[row] = time;
    columns.threads[row] = thread;
    auto column = columns.fields.begin();
    for (const auto field : fields) (*column++)[row] = field;
    return columns.count;
  }

  // Returns all entries, in the order of `TracePoint`, and empties the log.
  std::vector<EntryColumns> take_all();

private:
  void grow(EntryColumns & columns) const;

  std::size_t rows_;
  std::vector<EntryColumns> entries_;
};

// Outcomes of an asynchronous publication, in the order of `WORDS["outcome"]` in event_log.py.
enum class SendOutcome : std::int64_t { sent, expired, overwritten };

}  // namespace chainshaper::simulation
