// Float vectors of the native width of the instruction set this file is compiled for: 16 lanes (AVX-512), 8 (AVX2),
// 4 (SSE4.2, NEON). Never wider than native: GCC lowers wider vectors through memory (measured: 7 times slower).
// Include only from *.kernel.cpp; everything lives in gsstream_cpu::GSS_ISA, so the sets never mix at link time.
#pragma once
#include <cstdint>
#include <cstring>
#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#ifndef GSS_ISA
#error "simd.hpp is for *.kernel.cpp files, which CMake compiles with GSS_ISA defined"
#endif
#define GSS_INLINE __attribute__((always_inline)) inline

namespace gsstream_cpu::GSS_ISA {

#if defined(__AVX512F__)
constexpr int LANES = 16;
#elif defined(__AVX2__)
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif

typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));

GSS_INLINE Floats broadcast(float x) { return x - Floats{}; }
GSS_INLINE Ints broadcast(int32_t x) { return x - Ints{}; }
GSS_INLINE Floats load(const float* p) {
  Floats r;
  std::memcpy(&r, p, sizeof r);
  return r;
}
GSS_INLINE Ints load(const int32_t* p) {
  Ints r;
  std::memcpy(&r, p, sizeof r);
  return r;
}
// Bytes of which 255 is 1.0. Divided, because a product with 1 / 255 would be another number.
GSS_INLINE Floats load(const uint8_t* p) {
  typedef uint8_t Bytes __attribute__((vector_size(LANES)));
  Bytes bytes;
  std::memcpy(&bytes, p, sizeof bytes);
  return __builtin_convertvector(__builtin_convertvector(bytes, Ints), Floats) / 255.0f;
}
// Codes of 16 bits as floats.
GSS_INLINE Floats load(const uint16_t* p) {
  typedef uint16_t Shorts __attribute__((vector_size(2 * LANES)));
  Shorts codes;
  std::memcpy(&codes, p, sizeof codes);
  return __builtin_convertvector(__builtin_convertvector(codes, Ints), Floats);
}
// Rounded to the nearest code; what no code stands for, NaN included, becomes the nearest that there is, or 0.
GSS_INLINE void store(uint16_t* p, Floats v);
GSS_INLINE void store(float* p, Floats v) { std::memcpy(p, &v, sizeof v); }
GSS_INLINE void store(int32_t* p, Ints v) { std::memcpy(p, &v, sizeof v); }

// ---- comparisons and selection. Comparisons with NaN are false. min/max(x, y) return y when x is NaN.
#if defined(__AVX512F__)
typedef __mmask16 Mask;
GSS_INLINE Mask greater_equal(Floats a, Floats b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ); }
GSS_INLINE Mask greater(Floats a, Floats b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ); }
GSS_INLINE Mask greater_equal(Ints a, Ints b) { return _mm512_cmpge_epi32_mask((__m512i)a, (__m512i)b); }
GSS_INLINE Mask both(Mask a, Mask b) { return static_cast<Mask>(a & b); }
GSS_INLINE bool any(Mask m) { return m != 0; }
GSS_INLINE uint32_t bits_of(Mask m) { return m; }
GSS_INLINE Floats select(Mask m, Floats a, Floats b) { return (Floats)_mm512_mask_mov_ps((__m512)b, m, (__m512)a); }
GSS_INLINE Ints select(Mask m, Ints a, Ints b) { return (Ints)_mm512_mask_mov_epi32((__m512i)b, m, (__m512i)a); }
GSS_INLINE Floats select_or_zero(Mask m, Floats a) { return (Floats)_mm512_maskz_mov_ps(m, (__m512)a); }
GSS_INLINE Floats min(Floats a, Floats b) { return (Floats)_mm512_min_ps((__m512)a, (__m512)b); }
GSS_INLINE Floats max(Floats a, Floats b) { return (Floats)_mm512_max_ps((__m512)a, (__m512)b); }
GSS_INLINE Floats sqrt(Floats a) { return (Floats)_mm512_sqrt_ps((__m512)a); }
#else
typedef Ints Mask;
GSS_INLINE Mask greater_equal(Floats a, Floats b) { return a >= b; }
GSS_INLINE Mask greater(Floats a, Floats b) { return a > b; }
GSS_INLINE Mask greater_equal(Ints a, Ints b) { return a >= b; }
GSS_INLINE Mask both(Mask a, Mask b) { return a & b; }
GSS_INLINE Floats select(Mask m, Floats a, Floats b) { return (Floats)(((Ints)a & m) | ((Ints)b & ~m)); }
GSS_INLINE Ints select(Mask m, Ints a, Ints b) { return (a & m) | (b & ~m); }
GSS_INLINE Floats select_or_zero(Mask m, Floats a) { return (Floats)((Ints)a & m); }
#if defined(__AVX2__)
GSS_INLINE bool any(Mask m) { return !_mm256_testz_si256((__m256i)m, (__m256i)m); }
GSS_INLINE uint32_t bits_of(Mask m) { return static_cast<uint32_t>(_mm256_movemask_ps((__m256)m)); }
GSS_INLINE Floats min(Floats a, Floats b) { return (Floats)_mm256_min_ps((__m256)a, (__m256)b); }
GSS_INLINE Floats max(Floats a, Floats b) { return (Floats)_mm256_max_ps((__m256)a, (__m256)b); }
GSS_INLINE Floats sqrt(Floats a) { return (Floats)_mm256_sqrt_ps((__m256)a); }
#elif defined(__x86_64__)
GSS_INLINE bool any(Mask m) { return _mm_movemask_ps((__m128)m) != 0; }
GSS_INLINE uint32_t bits_of(Mask m) { return static_cast<uint32_t>(_mm_movemask_ps((__m128)m)); }
GSS_INLINE Floats min(Floats a, Floats b) { return (Floats)_mm_min_ps((__m128)a, (__m128)b); }
GSS_INLINE Floats max(Floats a, Floats b) { return (Floats)_mm_max_ps((__m128)a, (__m128)b); }
GSS_INLINE Floats sqrt(Floats a) { return (Floats)_mm_sqrt_ps((__m128)a); }
#else
GSS_INLINE bool any(Mask m) { return vmaxvq_u32((uint32x4_t)m) != 0; }
GSS_INLINE uint32_t bits_of(Mask m) {
  const uint32x4_t weight = {1, 2, 4, 8};
  return vaddvq_u32(vandq_u32((uint32x4_t)m, weight));
}
GSS_INLINE Floats min(Floats a, Floats b) { return select(a < b, a, b); }
GSS_INLINE Floats max(Floats a, Floats b) { return select(a > b, a, b); }
GSS_INLINE Floats sqrt(Floats a) { return (Floats)vsqrtq_f32((float32x4_t)a); }
#endif
#endif

// Running largest |x| as an integer, in which NaN and infinity are the largest. (A sum of x * 0 would do, but GCC folds
// it to 0 for vectors as soon as signed zeros are off.)
GSS_INLINE Ints largest_magnitude(Ints so_far, Floats x) {
  const Ints magnitude = (Ints)x & INT32_MAX;
  return select(greater_equal(magnitude, so_far), magnitude, so_far);
}
GSS_INLINE Mask is_finite(Ints magnitude) { return greater_equal(broadcast(0x7f7fffff), magnitude); }

// x limited to [low, high]; a NaN becomes `low`.
GSS_INLINE Floats clamp(Floats x, Floats low, Floats high) { return min(max(x, low), high); }

GSS_INLINE void store(uint16_t* p, Floats v) {
  typedef uint16_t Shorts __attribute__((vector_size(2 * LANES)));
  const Ints code = __builtin_convertvector(clamp(v, Floats{}, broadcast(65535.0f)) + 0.5f, Ints);
  const Shorts codes = __builtin_convertvector(code, Shorts);
  std::memcpy(p, &codes, sizeof codes);
}

// 1/x for finite x of ordinary size, to about 2 ulp; exact for x = 1 (AVX-512's guess is exact for powers of two, the
// older guesses are not, and their divisions are cheaper).
GSS_INLINE Floats reciprocal(Floats x) {
#if defined(__AVX512F__)
  const Floats guess = (Floats)_mm512_rcp14_ps((__m512)x);
  return guess * (2.0f - x * guess);
#else
  return 1.0f / x;
#endif
}

// 2^x for |x| < 126: degree-5 minimax polynomial on [-1/2, 1/2], relative error about 2e-7.
GSS_INLINE Floats exp2(Floats x) {
#if defined(__AVX512F__)
  const Floats whole = (Floats)_mm512_roundscale_ps((__m512)x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
#else
  const Ints power = __builtin_convertvector(x + select(x < 0, broadcast(-0.5f), broadcast(0.5f)), Ints);
  const Floats whole = __builtin_convertvector(power, Floats);
#endif
  const Floats f = x - whole;
  Floats p = f * 1.3333558e-3f + 9.6181291e-3f;
  p = p * f + 5.5504109e-2f;
  p = p * f + 2.4022651e-1f;
  p = p * f + 6.9314718e-1f;
  p = p * f + 1.0f;
#if defined(__AVX512F__)
  return (Floats)_mm512_scalef_ps((__m512)p, (__m512)whole);
#else
  return (Floats)((Ints)p + (power << 23));
#endif
}

// log2(x) for normal x > 0: atanh series of the mantissa in [sqrt(1/2), sqrt(2)).
GSS_INLINE Floats log2(Floats x) {
  const Ints raw = (Ints)x;
  const Ints exponent = (raw - 0x3f3504f3) >> 23;
  const Floats mantissa = (Floats)(raw - (exponent << 23));
  const Floats y = (mantissa - 1.0f) / (mantissa + 1.0f), y2 = y * y;
  Floats p = y2 * (2.0f / 9) + (2.0f / 7);
  p = p * y2 + (2.0f / 5);
  p = p * y2 + (2.0f / 3);
  p = p * y2 + 2.0f;
  return __builtin_convertvector(exponent, Floats) + y * p * 1.44269504f;
}

// Sum of all lanes, in a fixed order.
GSS_INLINE float sum(Floats v) {
#if defined(__AVX512F__)
  return _mm512_reduce_add_ps((__m512)v);
#elif defined(__AVX2__)
  __m128 q = _mm_add_ps(_mm256_castps256_ps128((__m256)v), _mm256_extractf128_ps((__m256)v, 1));
  q = _mm_add_ps(q, _mm_movehl_ps(q, q));
  return _mm_cvtss_f32(_mm_add_ss(q, _mm_movehdup_ps(q)));
#elif defined(__aarch64__)
  return vaddvq_f32((float32x4_t)v);
#else
  return (v[0] + v[2]) + (v[1] + v[3]);
#endif
}

}  // namespace gsstream_cpu::GSS_ISA
