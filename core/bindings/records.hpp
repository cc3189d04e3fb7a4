// Structs of the library as Python classes: made with keyword arguments, one for each field.

#pragma once

#include <nanobind/nanobind.h>

#include <memory>
#include <new>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "bindings/arrays.hpp"

namespace chainshaper::bindings {

// Binds a class whose constructor takes any bound fields by name; other fields have their defaults.
template <typename Struct>
nb::class_<Struct> record(nb::module_ & module, const char * name, const char * description) {
  return nb::class_<Struct>(module, name, description)
      .def("__init__", [](nb::pointer_and_handle<Struct> self, const nb::kwargs & fields) {
        new (self.p) Struct();
        nb::inst_mark_ready(self.h);
        for (const auto & [field, value] : fields) nb::setattr(self.h, field, value);
      });
}

// Returns the value of an enumeration for a word. The words are in the order of the values.
template <typename Value, typename Words>
Value value_of(const Words & words, const std::string & word) {
  for (std::size_t place = 0; place < words.size(); ++place)
    if (word == words[place]) return static_cast<Value>(place);
  throw std::invalid_argument("'" + word + "' is not a word that is known here");
}

// Gives a column to Python, which owns its memory then.
template <typename Number>
nb::object column_of(std::vector<Number> && numbers) {
  return nb::cast(array_of(std::move(numbers)));
}

// Gives the first `count` numbers of an array to Python, as a column.
template <typename Number>
nb::object column_of(std::unique_ptr<Number[]> && numbers, std::size_t count) {
  Number * column = numbers.release();
  const nb::capsule owner(column,
                          [](void * memory) noexcept { delete[] static_cast<Number *>(memory); });
  return nb::cast(nb::ndarray<nb::numpy, Number, nb::ndim<1>>(column, {count}, owner));
}

}  // namespace chainshaper::bindings
