// Instruction-set dispatch. The vector width is fixed at compile time, so every *.kernel.cpp is compiled once per
// set, inside namespace gsstream_cpu::GSS_ISA, and the strongest set that this processor supports is chosen at run
// time.
//
// How a kernel family plugs in (say `adam`):
//   adam.hpp         struct AdamKernels { void (*step)(const AdamJob&, std::size_t begin, std::size_t end); };
//                    GSS_KERNEL_TABLE(AdamKernels, adam_kernels)      // in namespace gsstream_cpu
//   adam.kernel.cpp  #include "runtime/simd.hpp"  ... namespace gsstream_cpu::GSS_ISA { static void step(...) {...}
//                    const AdamKernels& adam_kernels() { static const AdamKernels table{step}; return table; } }
//   anywhere         gsstream_cpu::adam_kernels().step(job, begin, end);      // the table of the selected set
// Kernel files should use no standard containers or algorithms: instances of such templates that were compiled for a
// strong set must never be the ones the linker keeps for everybody.
#pragma once
#include <string>
#include <vector>

namespace gsstream_cpu {

enum class Isa { baseline, avx2, avx512, neon };

const char* isa_name(Isa isa);
// Sets that were compiled in and that this processor runs, weakest first.
std::vector<Isa> supported_isas();
// Selected set: GSSTREAM_ISA if set, else the strongest. Throws std::invalid_argument when GSSTREAM_ISA names
// an unknown set or one this processor cannot run.
Isa active_isa();
// Selects by name; for tests and comparisons. Not to be called while kernels run.
void select_isa(const std::string& name);

}  // namespace gsstream_cpu

#if defined(__x86_64__)
#define GSS_KERNEL_TABLE(Table, getter)     \
  namespace baseline {                      \
  const Table& getter();                    \
  }                                         \
  namespace avx2 {                          \
  const Table& getter();                    \
  }                                         \
  namespace avx512 {                        \
  const Table& getter();                    \
  }                                         \
  inline const Table& getter() {            \
    switch (::gsstream_cpu::active_isa()) { \
      case ::gsstream_cpu::Isa::avx512:     \
        return avx512::getter();            \
      case ::gsstream_cpu::Isa::avx2:       \
        return avx2::getter();              \
      default:                              \
        return baseline::getter();          \
    }                                       \
  }
#else
#define GSS_KERNEL_TABLE(Table, getter) \
  namespace neon {                      \
  const Table& getter();                \
  }                                     \
  inline const Table& getter() { return neon::getter(); }
#endif
