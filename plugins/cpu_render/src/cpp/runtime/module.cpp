// The extension module gsstream_cpu_render._native: one bind_* call per kernel family. Each family has a folder.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "runtime/bindings.hpp"
#include "runtime/isa.hpp"

namespace nb = nanobind;

NB_MODULE(_native, module) {
  // Rasterisers in module globals outlive the interpreter's last look; nanobind would report them as leaks.
  nb::set_leak_warnings(false);
  module.doc() = "Native kernels of gsstream-cpu-render.";
  module.def(
      "active_isa", [] { return std::string(gsstream_cpu::isa_name(gsstream_cpu::active_isa())); },
      "Name of the selected instruction set (GSSTREAM_ISA, else the strongest supported).");
  module.def(
      "supported_isas",
      [] {
        std::vector<std::string> names;
        for (gsstream_cpu::Isa isa : gsstream_cpu::supported_isas()) names.emplace_back(gsstream_cpu::isa_name(isa));
        return names;
      },
      "Names of the instruction sets this build and processor support, weakest first.");
  module.def("select_isa", &gsstream_cpu::select_isa, nb::arg("name"),
             "Select an instruction set by name (tests, comparisons). Raises ValueError if unsupported.");
  gsstream_cpu::bind_rasterizer(module);
  gsstream_cpu::bind_photometric(module);
  gsstream_cpu::bind_adam(module);
  gsstream_cpu::bind_residual(module);
  gsstream_cpu::bind_moved(module);
  gsstream_cpu::bind_whole(module);
  gsstream_cpu::bind_views(module);
  gsstream_cpu::bind_threads(module);
}
