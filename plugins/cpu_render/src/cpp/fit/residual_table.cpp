#include "fit/residual_table.hpp"

#include <algorithm>
#include <cstring>
#include <utility>

#include "runtime/parallel.hpp"

namespace gsstream_cpu {
namespace {

std::size_t chunks_of(std::size_t rows) { return (rows + ROW_CHUNK - 1) / ROW_CHUNK; }
std::size_t padded(std::size_t columns) { return (columns + PADDING - 1) / PADDING * PADDING; }

// fn(first row, end) of whole chunks, whatever way the pool cuts them.
template <class Fn>
void for_chunks(std::size_t rows, Fn&& fn) {
  parallel_for(chunks_of(rows), 2, [&](std::size_t begin, std::size_t end) {
    for (std::size_t chunk = begin; chunk < end; chunk++)
      fn(chunk * ROW_CHUNK, std::min(rows, (chunk + 1) * ROW_CHUNK));
  });
}

}  // namespace

ResidualTable::ResidualTable(std::vector<ResidualBlock> blocks, std::size_t latents, std::size_t features)
    : blocks_(std::move(blocks)), latents_(latents), features_(features) {
  job_.latents = latents_;
  job_.features = features_;
  job_.padded_latents = padded(latents_);
  job_.padded_features = padded(features_);
  job_.blocks = blocks_.data();
  job_.count = blocks_.size();
  for (const ResidualBlock& block : blocks_)
    if (block.in_units) {
      job_.units_begin = block.feature;
      job_.units_end = block.feature + block.width;
    }
}

void ResidualTable::decode(ResidualJob job, const float* matrix, const float* steps) {
  const std::size_t lp = job_.padded_latents, dp = job_.padded_features, chunks = chunks_of(job.rows);
  job_.rows = job.rows;
  job_.latent = job.latent;
  job_.units = job.units;
  job_.gates = job.gates;
  job_.base = job.base;
  job_.out = job.out;
  float *wide = matrix_.require(latents_ * dp), *turned = transposed_.require(features_ * lp);
  std::fill_n(wide, latents_ * dp, 0.0f);
  std::fill_n(turned, features_ * lp, 0.0f);
  for (std::size_t l = 0; l < latents_; l++)
    for (std::size_t d = 0; d < features_; d++) wide[l * dp + d] = turned[d * lp + l] = matrix[l * features_ + d];
  float* step = steps_.require(lp);
  std::fill_n(step, lp, 1.0f);
  std::copy_n(steps, latents_, step);
  job_.matrix = wide;
  job_.steps = step;
  job_.kept = kept_.require(job.rows * lp);
  job_.quantised = quantised_.require(job.rows * lp);
  job_.decoded = decoded_.require(job.rows * dp);
  job_.magnitudes = magnitudes_.require(chunks * lp);
  const ResidualKernels& kernels = residual_kernels();
  for_chunks(job.rows, [&](std::size_t begin, std::size_t end) { kernels.decode(job_, begin, end); });
}

void ResidualTable::backward(ResidualBackwardJob job, float* matrix_gradient) {
  const float *units = job.forward.units, *gates = job.forward.gates;
  job.forward = job_;
  job.forward.units = units;
  job.forward.gates = gates;
  const std::size_t lp = job_.padded_latents, dp = job_.padded_features, chunks = chunks_of(job_.rows);
  float* spread = spread_.require(lp);
  std::fill_n(spread, lp, 1.0f);
  for (std::size_t l = 0; l < latents_; l++) {
    double total = 0.0;
    for (std::size_t chunk = 0; chunk < chunks; chunk++) total += magnitudes_[chunk * lp + l];
    const double rows = static_cast<double>(std::max<std::size_t>(1, job_.rows));
    spread[l] = std::max(LEAST_SPREAD, static_cast<float>(total / rows));
  }
  job.spread = spread;
  float *scale = scale_.require(lp), *tail = tail_.require(lp), *cost = cost_.require(lp);
  job.scale = scale;
  job.tail = tail;
  job.cost = cost;
  job.transposed = transposed_.data();
  job.matrix_partial = partial_.require(chunks * latents_ * dp);
  const ResidualKernels& kernels = residual_kernels();
  kernels.prepare_rate(job, scale, tail, cost);
  for_chunks(job_.rows, [&](std::size_t begin, std::size_t end) { kernels.backward(job, begin, end); });
  std::fill_n(matrix_gradient, latents_ * features_, 0.0f);
  for (const ResidualBlock& block : blocks_) {
    if (!block.trained) continue;
    for (std::size_t l = block.latent; l < block.latent + block.latents; l++)
      for (std::size_t d = block.feature; d < block.feature + block.width; d++)
        for (std::size_t chunk = 0; chunk < chunks; chunk++)
          matrix_gradient[l * features_ + d] += partial_[(chunk * latents_ + l) * dp + d];
  }
}

}  // namespace gsstream_cpu
