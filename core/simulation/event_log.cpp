#include "simulation/event_log.hpp"

#include <algorithm>
#include <utility>

namespace chainshaper::simulation {

const std::vector<EntryNames> & log_layout() {
  static const std::vector<EntryNames> names{
      {"callback_start", {"callback", "thread_time", "is_intra_process"}},
      {"callback_end", {"callback", "thread_time"}},
      {"publish", {"publisher_handle", "rmw_publisher_handle", "message", "timestamp"}},
      {"take", {"rmw_subscription_handle", "message", "source_timestamp", "taken"}},
      {"execute", {"handle"}},
      {"rclcpp_executor_wait_for_work", {"timeout"}},
      {"gate_release",
       {"callback", "source_timestamp", "arrival", "origin", "release", "slot", "cycles_waited",
        "anchor", "overrun", "mode", "dropped", "moved"}},
      {"asynchronous_send", {"rmw_publisher_handle", "timestamp", "outcome", "duration"}},
      {"context_switch", {"core", "previous", "runnable"}},
      {"thread_sleep", {"until", "call", "thread_time"}},
      {"thread_wake", {"call", "thread_time"}},
  };
  return names;
}

EventLog::EventLog(std::size_t rows) : rows_(rows) {
  for (const auto & names : log_layout()) {
    entries_.emplace_back();
    entries_.back().fields.resize(names.fields.size());
  }
}

std::vector<EntryColumns> EventLog::take_all() {
  return std::exchange(entries_, EventLog(rows_).entries_);
}

namespace {

template <typename Number>
void move_to_larger(Column<Number> & column, std::size_t count, std::size_t room) {
  auto larger = std::make_unique_for_overwrite<Number[]>(room);
  std::copy_n(column.get(), count, larger.get());
  column = std::move(larger);
}

}  // namespace

void EventLog::grow(EntryColumns & columns) const {
  constexpr std::size_t spare =
      1024;  // entries that may still come before the caller takes the log
  columns.room = columns.room == 0 ? rows_ + spare : 2 * columns.room;
  move_to_larger(columns.times, columns.count, columns.room);
  move_to_larger(columns.threads, columns.count, columns.room);
  for (auto & field : columns.fields) move_to_larger(field, columns.count, columns.room);
}

}  // namespace chainshaper::simulation
