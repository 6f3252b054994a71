#include "fit/residual_table.hpp"

#include <cstring>

#include "runtime/simd.hpp"

namespace gsstream_cpu::GSS_ISA {
namespace {

constexpr float LN_TWO = 0.69314718056f, LOG2_OF_E = 1.44269504089f;

GSS_INLINE Floats rounded(Floats x) {
#if defined(__AVX512F__)
  return (Floats)_mm512_roundscale_ps((__m512)x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
#elif defined(__AVX2__)
  return (Floats)_mm256_round_ps((__m256)x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
#elif defined(__x86_64__)
  return (Floats)_mm_round_ps((__m128)x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
#else
  return (Floats)vrndnq_f32((float32x4_t)x);
#endif
}

// Keeps one row's latents, padded, and rounds them to steps; adds the magnitudes of its symbols.
GSS_INLINE void quantise_row(const ResidualJob& job, std::size_t i, float* magnitudes) {
  float *kept = job.kept + i * job.padded_latents, *quantised = job.quantised + i * job.padded_latents;
  std::memcpy(kept, job.latent + i * job.latents, job.latents * sizeof(float));
  for (std::size_t l = job.latents; l < job.padded_latents; l++) kept[l] = 0.0f;
  for (std::size_t l = 0; l < job.padded_latents; l += LANES) {
    const Floats step = load(job.steps + l), symbol = rounded(load(kept + l) / step);
    store(magnitudes + l, load(magnitudes + l) + max(symbol, -symbol));
    store(quantised + l, symbol * step);
  }
}

// decoded = latents matrix, then in the units of the row.
GSS_INLINE void decode_row(const ResidualJob& job, std::size_t i) {
  const float* quantised = job.quantised + i * job.padded_latents;
  float* decoded = job.decoded + i * job.padded_features;
  for (std::size_t d = 0; d < job.padded_features; d += LANES) store(decoded + d, Floats{});
  for (std::size_t l = 0; l < job.latents; l++) {
    const float value = quantised[l];
    if (value == 0.0f) continue;
    const float* weights = job.matrix + l * job.padded_features;
    for (std::size_t d = 0; d < job.padded_features; d += LANES)
      store(decoded + d, load(decoded + d) + value * load(weights + d));
  }
  for (std::size_t d = job.units_begin; d < job.units_end; d++) decoded[d] *= job.units[i];
}

void decode(const ResidualJob& job, std::size_t begin, std::size_t end) {
  float* magnitudes = job.magnitudes + begin / ROW_CHUNK * job.padded_latents;
  std::memset(magnitudes, 0, job.padded_latents * sizeof(float));
  for (std::size_t i = begin; i < end; i++) {
    quantise_row(job, i, magnitudes);
    decode_row(job, i);
    const float *decoded = job.decoded + i * job.padded_features, gate = job.gates[i];
    for (std::size_t b = 0; b < job.count; b++) {
      const ResidualBlock& block = job.blocks[b];
      const float *base = job.base[b] + i * block.width, *change = decoded + block.feature;
      float* out = job.out[b] + i * block.width;
      for (std::size_t d = 0; d < block.width; d++) out[d] = base[d] + gate * change[d];
    }
  }
}

// What the price of a latent is made of and is the same in every row.
void prepare_rate(const ResidualBackwardJob& job, float* scales, float* tails, float* costs) {
  for (std::size_t l = 0; l < job.forward.padded_latents; l += LANES) {
    const Floats step = load(job.forward.steps + l), spread = load(job.spread + l), half = broadcast(0.5f);
    const Floats scale = LOG2_OF_E / spread;
    store(scales + l, scale);
    store(tails + l, exp2(-half * scale));
    store(costs + l, spread * step * LN_TWO);
  }
}

// Derivative by the latent of `weight` times the bits of its symbol; see gsstream.parts.update.rate.laplace_gradient.
GSS_INLINE Floats rate_grad(const ResidualBackwardJob& job, std::size_t l, Floats latent) {
  const Floats half = broadcast(0.5f), scale = load(job.scale + l), tail = load(job.tail + l);
  const Floats u = latent / load(job.forward.steps + l), magnitude = max(u, -u);
  const Floats grown = exp2(min(magnitude, half) * scale), shrunk = 1.0f / grown;
  const Floats inside = (grown - shrunk) * tail / (2.0f - (grown + shrunk) * tail);
  const Floats grad = select(greater(half, magnitude), inside, broadcast(1.0f));
  // At u = 0 the grad inside is 0, whatever the sign.
  const Floats sign = select(greater(u, Floats{}), broadcast(1.0f), broadcast(-1.0f));
  return job.weight * grad * sign / load(job.cost + l);
}

// Gathers the upstream gradient of one row; returns that of its gate, and leaves the gated one in `upstream`.
GSS_INLINE float gate_row(const ResidualBackwardJob& job, std::size_t i, float* upstream) {
  const ResidualJob& forward = job.forward;
  for (std::size_t b = 0; b < forward.count; b++) {
    const ResidualBlock& block = forward.blocks[b];
    std::memcpy(upstream + block.feature, job.gradient[b] + i * block.width, block.width * sizeof(float));
  }
  const float* decoded = forward.decoded + i * forward.padded_features;
  Floats by_gate{};
  for (std::size_t d = 0; d < forward.padded_features; d += LANES) {
    const Floats value = load(upstream + d);
    by_gate += value * load(decoded + d);
    store(upstream + d, value * forward.gates[i]);
  }
  for (std::size_t d = forward.units_begin; d < forward.units_end; d++) upstream[d] *= forward.units[i];
  return sum(by_gate);
}

GSS_INLINE void row_backward(const ResidualBackwardJob& job, std::size_t i, const float* upstream, float* partial) {
  const ResidualJob& forward = job.forward;
  const bool has_rate = job.weight != 0.0f && forward.gates[i] > 0.0f;
  const float *quantised = forward.quantised + i * forward.padded_latents,
              *kept = forward.kept + i * forward.padded_latents;
  float* out = job.latent_gradient + i * forward.latents;
  for (std::size_t l = 0; l < forward.latents; l += LANES) {
    Floats total{};
    const float* weights = job.transposed + l;
    for (std::size_t d = 0; d < forward.features; d++) total += upstream[d] * load(weights + d * forward.padded_latents);
    if (has_rate) total += rate_grad(job, l, load(kept + l));
    const std::size_t left = forward.latents - l;
    if (left >= LANES) {
      store(out + l, total);
    } else {
      float values[LANES];
      store(values, total);
      for (std::size_t k = 0; k < left; k++) out[l + k] = values[k];
    }
  }
  for (std::size_t l = 0; l < forward.latents; l++) {
    const float value = quantised[l];
    if (value == 0.0f) continue;
    float* sums = partial + l * forward.padded_features;
    for (std::size_t d = 0; d < forward.padded_features; d += LANES)
      store(sums + d, load(sums + d) + value * load(upstream + d));
  }
}

void backward(const ResidualBackwardJob& job, std::size_t begin, std::size_t end) {
  const ResidualJob& forward = job.forward;
  const std::size_t cells = forward.latents * forward.padded_features;
  float* partial = job.matrix_partial + begin / ROW_CHUNK * cells;
  std::memset(partial, 0, cells * sizeof(float));
  alignas(64) float upstream[MOST_FEATURES] = {};
  for (std::size_t i = begin; i < end; i++) {
    job.gate_gradient[i] = gate_row(job, i, upstream);
    row_backward(job, i, upstream, partial);
  }
}

}  // namespace

const ResidualKernels& residual_kernels() {
  static const ResidualKernels table{prepare_rate, decode, backward};
  return table;
}

}  // namespace gsstream_cpu::GSS_ISA
