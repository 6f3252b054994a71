#include "adam/adam.hpp"

#include <cmath>
#include <initializer_list>

#include "runtime/simd.hpp"

namespace gsstream_cpu::GSS_ISA {
namespace {

constexpr float MAX_GRADIENT = 1e18f;

struct Factors {
  Floats beta1, rest1, beta2, rest2, eps, size, root2;  // size = lr / (1 - beta1^t), root2 = 1 / sqrt(1 - beta2^t)
  Floats kept, now;  // shares of the mean and of the gradient in a step: 1 and 0, or beta1 and rest1 where it looks ahead
};

// `size` is the step already multiplied by the learning rate of each lane.
GSS_INLINE void update_lanes(Floats& param, Floats grad, Floats& m, Floats& v, const Factors& f, Floats size) {
  m = f.beta1 * m + f.rest1 * grad;
  v = f.beta2 * v + f.rest2 * (grad * grad);
  const Floats bottom = GSS_ISA::sqrt(v) * f.root2 + f.eps;
  param -= size * ((f.kept * m + f.now * grad) / bottom);
}

// The first `count` < LANES floats; other lanes are 0 and are not touched in memory.
GSS_INLINE Floats load_part(const float* p, std::size_t count) {
#if defined(__AVX512F__)
  return (Floats)_mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << count) - 1u), p);
#else
  float part[LANES] = {};
  for (std::size_t i = 0; i < count; ++i) part[i] = p[i];
  return load(part);
#endif
}

GSS_INLINE void store_part(float* p, Floats v, std::size_t count) {
#if defined(__AVX512F__)
  _mm512_mask_storeu_ps(p, static_cast<__mmask16>((1u << count) - 1u), (__m512)v);
#else
  float part[LANES];
  store(part, v);
  for (std::size_t i = 0; i < count; ++i) p[i] = part[i];
#endif
}

void update_row(float* param, const float* grad, float* m, float* v, std::size_t columns, const Factors& f,
                const float* rates) {
  std::size_t i = 0;
  for (; i + LANES <= columns; i += LANES) {
    Floats p = load(param + i), first = load(m + i), second = load(v + i);
    update_lanes(p, load(grad + i), first, second, f, rates ? f.size * load(rates + i) : f.size);
    store(param + i, p);
    store(m + i, first);
    store(v + i, second);
  }
  const std::size_t left = columns - i;
  if (left == 0) return;
  Floats p = load_part(param + i, left), first = load_part(m + i, left), second = load_part(v + i, left);
  // Idle lanes would divide 0 by 0 without eps; the result is thrown away.
  update_lanes(p, load_part(grad + i, left), first, second, f, rates ? f.size * load_part(rates + i, left) : f.size);
  store_part(param + i, p, left);
  store_part(m + i, first, left);
  store_part(v + i, second, left);
}

// Corrections of step t. Neighbouring rows mostly share their count, so the caller keeps the last result.
struct Correction {
  int64_t step = 0;
  double size = 0.0, root2 = 0.0;

  GSS_INLINE void set(const AdamJob& job, int64_t t) {
    if (t == step) return;
    step = t;
    const double power = static_cast<double>(t);
    size = 1.0 / (1.0 - std::pow(job.beta1, job.ahead ? power + 1.0 : power));
    root2 = 1.0 / std::sqrt(1.0 - std::pow(job.beta2, power));
  }
};

GSS_INLINE void set_step(Factors& f, const Correction& c, double lr) {
  f.size = broadcast(static_cast<float>(lr * c.size));
  f.root2 = broadcast(static_cast<float>(c.root2));
}

GSS_INLINE bool alike(const AdamJob& job, std::size_t a, std::size_t b) {
  return job.step[a] == job.step[b] && (!job.lr_rows || job.lr_rows[a] == job.lr_rows[b]);
}

void update(const AdamJob& job, std::size_t begin, std::size_t end) {
  Factors f;
  f.beta1 = broadcast(static_cast<float>(job.beta1));
  f.rest1 = broadcast(static_cast<float>(1.0 - job.beta1));
  f.beta2 = broadcast(static_cast<float>(job.beta2));
  f.rest2 = broadcast(static_cast<float>(1.0 - job.beta2));
  f.eps = broadcast(static_cast<float>(job.eps));
  f.kept = job.ahead ? f.beta1 : broadcast(1.0f);
  f.now = job.ahead ? f.rest1 : broadcast(0.0f);
  Correction correction;
  const std::size_t d = job.columns;
  const double common = job.lr_columns ? 1.0 : job.lr;
  for (std::size_t row = begin; row < end;) {
    // Neighbours that share count and rate form one long row, so that narrow rows fill the vectors.
    std::size_t run = 1;
    if (!job.lr_columns)
      while (row + run < end && alike(job, row, row + run)) ++run;
    const int64_t step = static_cast<int64_t>(job.step[row]) + 1;
    for (std::size_t k = 0; k < run; ++k) job.step[row + k] = static_cast<int32_t>(step);
    correction.set(job, step);
    set_step(f, correction, job.lr_rows ? static_cast<double>(job.lr_rows[row]) : common);
    const std::size_t at = row * d;
    update_row(job.param + at, job.grad + at, job.exp_avg + at, job.exp_avg_sq + at, run * d, f, job.lr_columns);
    row += run;
  }
}

// The first value that is not finite, or whose square leaves float32: its mean would stay infinite for good.
std::size_t first_bad(const float* values, std::size_t count) {
  std::size_t i = 0;
  constexpr std::size_t block = 16 * LANES;
  for (; i + block <= count; i += block) {
    Ints largest{};
    for (std::size_t k = 0; k < block; k += LANES) largest = largest_magnitude(largest, load(values + i + k));
    // As integers, NaN and infinity are the largest magnitudes.
    if (any(greater_equal(largest, (Ints)broadcast(MAX_GRADIENT) + 1))) break;
  }
  for (; i < count; ++i)
    if (!(std::fabs(values[i]) <= MAX_GRADIENT)) return i;
  return count;
}

}  // namespace

const AdamKernels& adam_kernels() {
  static const AdamKernels table{update, first_bad};
  return table;
}

}  // namespace gsstream_cpu::GSS_ISA
