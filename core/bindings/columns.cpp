#include "bindings/arrays.hpp"
#include "columns/delta_packing.hpp"

namespace chainshaper::bindings {
namespace {

template <typename Number>
nb::bytes delta_packed(Array<const Number> numbers) {
  std::string packed;
  {
    const nb::gil_scoped_release released;
    packed = columns::delta_packed(span_of(numbers));
  }
  return nb::bytes(packed.data(), packed.size());
}

}  // namespace

void bind_columns(nb::module_ & module) {
  module.def("delta_packed", &delta_packed<std::int32_t>, nb::arg("numbers"));
  module.def("delta_packed", &delta_packed<std::int64_t>, nb::arg("numbers"),
             "A column in Parquet's encoding DELTA_BINARY_PACKED.");
}

}  // namespace chainshaper::bindings
