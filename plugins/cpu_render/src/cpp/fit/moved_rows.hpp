// Rows that move in rigid groups, rendered from where they are now, and the gradient by the groups' transforms: what
// every iteration of a fit of motions does. The arithmetic is that of gsstream.core.changes.motion.transformed and of
// gsstream.parts.render.transforms, float64 in the same order, so that the results are the same bits, and that of
// gsstream.parts.motion.curvature.
#pragma once
#include <cstddef>
#include <cstdint>

#include "fit/view_loss_grad.hpp"

namespace gsstream_cpu {

struct MovedRows {
  Scene rows;            // the active rows before they move
  const int64_t* place;  // [A] group of each, below `groups`
  std::size_t groups;
  const double *centre, *shift, *turn;  // [K, 3]; turn: axis * tan(angle / 2)
};

// grad [K, 6]: by the groups' shift and by a small turn in front of theirs, as a turn counts there. curvature [K, 6, 6]: of
// the sum over all values of the picture; null: not wanted. Nothing is written where there is a fault.
ViewLossGrad transform_loss_and_grad(Rasterizer& rasterizer, const MovedRows& moved, const ViewComparison& view, double* grad,
                    double* curvature = nullptr);

}  // namespace gsstream_cpu
