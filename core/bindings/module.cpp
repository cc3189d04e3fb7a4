// chainshaper._core: the native library, for Python. One function per folder of the library.

#include <nanobind/nanobind.h>

namespace chainshaper::bindings {

void bind_bands(nanobind::module_ & module);
void bind_columns(nanobind::module_ & module);
void bind_control(nanobind::module_ & module);
void bind_ctf(nanobind::module_ & module);
void bind_matching(nanobind::module_ & module);
void bind_simulation(nanobind::module_ & module);

}  // namespace chainshaper::bindings

NB_MODULE(_core, module) {
  // When the interpreter ends, notebooks, debuggers and test runners may still hold results. That
  // is no fault of theirs, and users read nanobind's list of these objects as an error.
  nanobind::set_leak_warnings(false);
  module.doc() =
      "The native library (C++): trace decoder, joins, band placement, simulator,"
      " covariances of control loops.";
  chainshaper::bindings::bind_bands(module);
  chainshaper::bindings::bind_columns(module);
  chainshaper::bindings::bind_control(module);
  chainshaper::bindings::bind_ctf(module);
  chainshaper::bindings::bind_matching(module);
  chainshaper::bindings::bind_simulation(module);
}
