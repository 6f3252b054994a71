// One view rendered, compared with what its camera recorded, and differentiated, in one call: what every iteration of
// every fit does. The same kernels as forward_layered, photometric_run and backward_layered one after the other,
// without copies of whole images in between. Results are a function of the cached scene, the active rows and the
// comparison, bit by bit; against forward_active and backward_active they differ by what layers.hpp says.
#pragma once
#include <cstdint>

#include "photometric/photometric.hpp"
#include "raster/rasterizer.hpp"

namespace gsstream_cpu {

struct ViewComparison {
  const float* cached_image;               // [H, W, 3] render of the cached scene; null where nothing stands still
  TargetPixels target;                     // [H, W, 3]
  TargetStatistics statistics;             // filled in on the way
  const float *matrix, *offset;            // colour map [3, 3], [3] of the camera; or both null
  float background[3];
  float l1_scale, ssim_scale;
  const float* weights;                    // [ceil(H/16), ceil(W/16)] factors on the gradients of tiles; 0: the tile is
                                           // left out and stays as it is in the cache. Null: all count once
};

struct ViewLossGrad {
  uint32_t faults;       // Fault bits; if any is set, nothing else is written
  PhotometricSums sums;  // over the touched tiles that count and those beside them
};

// What the photometric kernels need to compare these recorded colours [H, W, 3]; tiles and gradient are to be added.
PhotometricJob photometric_job(int width, int height, const ViewComparison& view, const float* recorded);

// `rows` are the active rows of `rasterizer`, which must be frozen. `out` has one row per active row. `structure` [A, 3]:
// sums over pixels of each row's share of the light, times the structure of the picture there; null: not wanted.
ViewLossGrad view_loss_and_grad(Rasterizer& rasterizer, const Scene& rows, const ViewComparison& view, const GradientArrays& out,
                   float* structure = nullptr);

}  // namespace gsstream_cpu
