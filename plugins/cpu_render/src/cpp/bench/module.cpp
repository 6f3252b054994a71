// The extension module gsstream_cpu_render._bench: what this machine can do at most. Only measurements load it.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include "bench/peak.hpp"
#include "runtime/isa.hpp"

namespace nb = nanobind;

NB_MODULE(_bench, module) {
  module.doc() = "Peaks of this machine, for gsstream bench.";
  // This module has a selected instruction set of its own; the caller hands over that of the renderer.
  module.def("select_isa", &gsstream_cpu::select_isa, nb::arg("name"),
             "Select an instruction set by name. Raises ValueError if unsupported.");
  module.def("fma_peak", &gsstream_cpu::fma_peak, nb::arg("threads"), nb::arg("seconds"),
             nb::call_guard<nb::gil_scoped_release>(),
             "10^9 floating-point operations per second in registers, of the selected instruction set.");
  module.def("copy_peak", &gsstream_cpu::copy_peak, nb::arg("threads"), nb::arg("megabytes"),
             nb::call_guard<nb::gil_scoped_release>(),
             "10^9 bytes per second read plus written by copying buffers of that many 10^6 bytes a thread.");
}
