// How the nine moments of a pair lie in its MOMENT_STRIDE floats: private to the kernels of one instruction set.
#pragma once
#include "raster/raster_types.hpp"
#include "runtime/simd.hpp"

namespace gsstream_cpu::GSS_ISA {

#if defined(__AVX512F__)

GSS_INLINE constexpr int moment_slot(int k) { return 4 * (k & 3) + (k >> 2); }

// Horizontal sums of nine vectors at once, as a transposition: 13 additions and one store instead of nine reductions.
// Value k lands in moment_slot(k).
GSS_INLINE void store_moments(const Floats* v, float* out) {
  const auto fold_halves = [](Floats a, Floats b) {  // 128-bit quarters: [a0+a2, a1+a3, b0+b2, b1+b3]
    return (Floats)_mm512_shuffle_f32x4((__m512)a, (__m512)b, 0x44) +
           (Floats)_mm512_shuffle_f32x4((__m512)a, (__m512)b, 0xEE);
  };
  const auto fold_quarters = [](Floats a, Floats b) {  // one quarter left per input vector
    return (Floats)_mm512_shuffle_f32x4((__m512)a, (__m512)b, 0x88) +
           (Floats)_mm512_shuffle_f32x4((__m512)a, (__m512)b, 0xDD);
  };
  const auto fold_pairs = [](Floats a, Floats b) {
    return (Floats)_mm512_unpacklo_ps((__m512)a, (__m512)b) + (Floats)_mm512_unpackhi_ps((__m512)a, (__m512)b);
  };
  const auto fold_last = [](Floats a, Floats b) {
    const __m512d x = _mm512_castps_pd((__m512)a), y = _mm512_castps_pd((__m512)b);
    return (Floats)_mm512_castpd_ps(_mm512_unpacklo_pd(x, y)) + (Floats)_mm512_castpd_ps(_mm512_unpackhi_pd(x, y));
  };
  const Floats zero{};
  const Floats q0 = fold_quarters(fold_halves(v[0], v[1]), fold_halves(v[2], v[3]));
  const Floats q1 = fold_quarters(fold_halves(v[4], v[5]), fold_halves(v[6], v[7]));
  const Floats q2 = fold_quarters(fold_halves(v[8], zero), zero);
  store(out, fold_last(fold_pairs(q0, q1), fold_pairs(q2, zero)));
}

#else

GSS_INLINE constexpr int moment_slot(int k) { return k; }

GSS_INLINE void store_moments(const Floats* v, float* out) {
  for (int k = 0; k < MOMENTS; k++) out[k] = sum(v[k]);
  for (int k = MOMENTS; k < MOMENT_STRIDE; k++) out[k] = 0.0f;
}

#endif

}  // namespace gsstream_cpu::GSS_ISA
