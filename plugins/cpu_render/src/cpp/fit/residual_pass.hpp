// Some iterations of a frame's residual in one call: gates, residual, rendering, loss, their gradients, the price of open
// gates, and Adam. The kernels are those of the calls that it stands for, in the same order (gsstream.api.FitPass).
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "adam/adam.hpp"
#include "fit/residual_table.hpp"
#include "fit/view_loss_grad.hpp"

namespace gsstream_cpu {

// Gates are sigmoid(logit / temperature + shift), rounded to steps of 1 / levels; open with probability sigmoid(logit - margin).
struct GateRule {
  float temperature, shift, levels, margin, bound;
  float open_weight, motion;  // per row behind an open gate; per squared position residual there
  float divisor;        // of both: the Gaussians of the scene, or 1
};

struct PassView {
  Rasterizer* rasterizer;    // frozen to the rows of the pass
  ViewComparison comparison;
  const uint8_t* waiting;    // [A] 1: the row takes no part yet; or null
  double lr_factor;          // of latents and decoders
};

struct ResidualPass {
  ResidualTable* table;
  std::size_t rows, nodes;
  const float* base[ATTRIBUTES];           // [A, ...] each
  std::vector<std::size_t> attribute;      // of each block of the table
  int sh_degree;
  const float *units, *steps;              // [A], [L]
  const int64_t* node_of;                  // [A], below `nodes`
  GateRule rule;
  float weight;                            // loss per bit
  std::ptrdiff_t position;                 // first column of the latents of means, or -1
  AdamJob logits, latents, matrix;         // rates of latents by column and of the matrix by row, before lr_factor
};

// Losses of the iterations that were made. Fewer than there are views where the next one has a fault (values that are
// not finite, or a gradient that Adam refuses): nothing of it was done.
std::vector<double> run_pass(const ResidualPass& pass, const std::vector<PassView>& views);

}  // namespace gsstream_cpu
