// What this machine can do at most: the yardstick for every kernel's time.
#pragma once
#include <cstddef>

#include "runtime/isa.hpp"

namespace gsstream_cpu {

struct PeakKernels {
  // Floating-point operations (multiply and add counted as two) done by `rounds` rounds of independent multiply-adds;
  // `result` keeps the compiler honest.
  double (*multiply_add)(std::size_t rounds, float* result);
  // Copies `count` floats.
  void (*copy)(const float* from, float* to, std::size_t count);
};
GSS_KERNEL_TABLE(PeakKernels, peak_kernels)

// 10^9 operations per second of `threads` threads of their own over `seconds`.
double fma_peak(int threads, double seconds);
// 10^9 bytes per second, read and written bytes both counted, copying buffers of `megabytes` (10^6 bytes) a thread.
double copy_peak(int threads, double megabytes);

}  // namespace gsstream_cpu
