#include "simulation/event_log.hpp"

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
  };
  return names;
}

EventLog::EventLog(std::size_t rows) : rows_(rows) {
  for (const auto & names : log_layout())
    entries_.push_back({{}, {}, std::vector<std::vector<std::int64_t>>(names.fields.size())});
}

std::vector<EntryColumns> EventLog::take_all() {
  return std::exchange(entries_, EventLog(rows_).entries_);
}

void EventLog::reserve(EntryColumns & columns) const {
  columns.times.reserve(rows_);
  columns.threads.reserve(rows_);
  for (auto & field : columns.fields) field.reserve(rows_);
}

}  // namespace chainshaper::simulation
