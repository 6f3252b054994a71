// The residual of A rows: quantised latents through linear decoders, gated, added to the rows; and its gradient, with
// that of the rate. Attributes are blocks of columns: latents [A, L], decoders [L, D] (zero outside of the blocks).
#pragma once
#include <cstddef>
#include <vector>

#include "runtime/buffer.hpp"
#include "runtime/isa.hpp"

namespace gsstream_cpu {

constexpr std::size_t ROW_CHUNK = 256;     // rows whose sums are taken together, so that they do not depend on threads
constexpr std::size_t PADDING = 16;        // columns come in multiples of the widest vector
constexpr std::size_t MOST_FEATURES = 64;  // 59 with harmonics of degree 3
constexpr float LEAST_SPREAD = 0.3f;       // symbols; see gsstream.parts.update.rate.MIN_SPREAD

struct ResidualBlock {
  std::size_t latent, latents;  // columns of the latents
  std::size_t feature, width;   // columns of the features
  bool in_units;                // measured in the unit of each row
  bool trained;                 // the decoder's gradient is wanted
};

// What lies in memory of its own is padded with zeros (steps and spreads: ones) to a multiple of PADDING columns.
struct ResidualJob {
  std::size_t rows, latents, features, padded_latents, padded_features;
  const ResidualBlock* blocks;
  std::size_t count;
  std::size_t units_begin, units_end;  // features in units
  const float *latent, *units, *gates;  // [A, L], [A], [A]
  const float *matrix, *steps;          // [L, padded D], [padded L]
  float *kept, *quantised, *decoded;    // [A, padded L] latents, [A, padded L], [A, padded D]
  float* magnitudes;                    // [chunks, padded L] sums of |symbol|
  const float* const* base;             // by block: [A, width]
  float* const* out;                    // by block: [A, width]
};

struct ResidualBackwardJob {
  ResidualJob forward;
  const float* const* gradient;  // by block: [A, width]
  const float* transposed;       // [D, padded L]
  const float *spread, *scale, *tail, *cost;  // [padded L] symbols; and what the price of a latent is made of
  float weight;                  // loss per bit
  float *latent_gradient, *gate_gradient;
  float* matrix_partial;         // [chunks, L, padded D]
};

struct ResidualKernels {
  // Fills scale, tail and cost of a job from its spreads and steps.
  void (*prepare_rate)(const ResidualBackwardJob&, float* scale, float* tail, float* cost);
  void (*decode)(const ResidualJob&, std::size_t begin, std::size_t end);
  void (*backward)(const ResidualBackwardJob&, std::size_t begin, std::size_t end);
};
GSS_KERNEL_TABLE(ResidualKernels, residual_kernels)

// What one table keeps from its forward to its backward.
class ResidualTable {
 public:
  ResidualTable(std::vector<ResidualBlock> blocks, std::size_t latents, std::size_t features);
  // `job` comes with rows, latent, units, gates, base and out; the rest is filled in here. matrix [L, D], steps [L].
  void decode(ResidualJob job, const float* matrix, const float* steps);
  // After decode, of the same rows and gates. `job` comes with gradient, weight and outputs; matrix_gradient [L, D].
  void backward(ResidualBackwardJob job, float* matrix_gradient);
  const std::vector<ResidualBlock>& blocks() const { return blocks_; }
  std::size_t latents() const { return latents_; }
  std::size_t features() const { return features_; }
  std::size_t rows() const { return job_.rows; }

 private:
  std::vector<ResidualBlock> blocks_;
  std::size_t latents_, features_;
  ResidualJob job_{};  // of the last decode
  Buffer<float> kept_, quantised_, decoded_, magnitudes_, partial_, spread_, scale_, tail_, cost_, matrix_, transposed_, steps_;
};

}  // namespace gsstream_cpu
