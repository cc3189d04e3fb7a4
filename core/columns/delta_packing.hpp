// Columns of integers in few bytes: differences between neighbours, packed bit by bit.
//
// This is Parquet's encoding DELTA_BINARY_PACKED (apache/parquet-format, Encodings.md). Times that
// ascend, and handles of a few objects, take a third of their bytes with it, faster than any
// compression does.

#pragma once

#include <cstdint>
#include <span>
#include <string>

namespace chainshaper::columns {

// The bytes of a column; `Number` is std::int32_t or std::int64_t.
template <typename Number>
std::string delta_packed(std::span<const Number> numbers);

}  // namespace chainshaper::columns
