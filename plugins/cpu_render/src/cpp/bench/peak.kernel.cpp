#include "bench/peak.hpp"

#include "runtime/simd.hpp"

namespace gsstream_cpu::GSS_ISA {
namespace {

// Enough independent chains to cover the latency of two units, few enough to stay in registers.
constexpr int kChains = LANES == 16 ? 16 : 12;

double multiply_add(std::size_t rounds, float* result) {
  Floats chain[kChains];
  for (int k = 0; k < kChains; ++k) chain[k] = broadcast(static_cast<float>(k));
  Floats factor = broadcast(0.999f), term = broadcast(0.001f);
  for (std::size_t i = 0; i < rounds; ++i) {
#pragma GCC unroll 16
    for (int k = 0; k < kChains; ++k) chain[k] = chain[k] * factor + term;
  }
  Floats total = {};
  for (int k = 0; k < kChains; ++k) total += chain[k];
  *result = sum(total);
  return 2.0 * LANES * kChains * static_cast<double>(rounds);
}

void copy(const float* from, float* to, std::size_t count) {
  std::size_t i = 0;
  for (; i + 4 * LANES <= count; i += 4 * LANES)
    for (int k = 0; k < 4; ++k) store(to + i + k * LANES, load(from + i + k * LANES));
  for (; i < count; ++i) to[i] = from[i];
}

}  // namespace

const PeakKernels& peak_kernels() {
  static const PeakKernels table{multiply_add, copy};
  return table;
}

}  // namespace gsstream_cpu::GSS_ISA
