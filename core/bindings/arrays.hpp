// NumPy arrays as spans: the only form in which rows cross the border to Python.

#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace chainshaper::bindings {

namespace nb = nanobind;

// A contiguous array of one dimension in the machine's memory; `const T` for one that is only read.
template <typename T>
using Array = nb::ndarray<T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

template <typename T>
std::span<T> span_of(const Array<T> & array) {
  return {array.data(), array.size()};
}

// Throws std::invalid_argument (ValueError in Python) if an array has not the expected length.
inline void check_length(const char * name, std::size_t length, std::size_t expected) {
  if (length != expected)
    throw std::invalid_argument(std::string(name) + " has " + std::to_string(length) +
                                " entries where " + std::to_string(expected) + " are needed");
}

// Moves a vector into a NumPy array, which owns the memory.
template <typename T>
nb::ndarray<nb::numpy, T, nb::ndim<1>> array_of(std::vector<T> && rows) {
  auto * owned = new std::vector<T>(std::move(rows));
  const nb::capsule owner(owned, [](void * vector) noexcept {
    delete static_cast<std::vector<T> *>(vector);  // NOLINT(cppcoreguidelines-owning-memory)
  });
  return {owned->data(), {owned->size()}, owner};
}

// Calls `work` without Python's lock, so that other threads can run, and returns its result.
template <typename Work>
auto without_lock(Work && work) {
  const nb::gil_scoped_release released;
  return std::forward<Work>(work)();
}

}  // namespace chainshaper::bindings
