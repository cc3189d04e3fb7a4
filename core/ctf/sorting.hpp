// Rows of a table in order of time.

#pragma once

#include "ctf/events.hpp"

namespace chainshaper::ctf {

// Sorts a table's rows by time, in place; rows of equal times stay in their order. Files of a trace
// stand behind each other, each one mostly sorted, so runs of rows are merged.
void sort_by_time(const TableColumns & table);

}  // namespace chainshaper::ctf
