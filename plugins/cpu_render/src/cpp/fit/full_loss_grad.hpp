// A view of a scene in which every Gaussian moves, rendered, compared and differentiated in one call: an iteration of
// frame 0. The same kernels as forward, photometric_run and backward one after the other; no array of a whole image is
// allocated, and the colour map of the camera takes two passes over the pixels instead of six.
#pragma once
#include "fit/view_loss_grad.hpp"

namespace gsstream_cpu {

// `view.cached_image` and `view.weights` are null. `out` has one row per Gaussian; means2d must be there. `colours` [12]:
// the gradient of the loss by the colour map's matrix and offset; null: not wanted, as without a map. No backward may
// follow. Results do not depend on the number of threads.
ViewLossGrad full_loss_and_grad(Rasterizer& rasterizer, const Scene& scene, const Camera& camera, const ViewComparison& view,
                    const GradientArrays& out, float* colours);

}  // namespace gsstream_cpu
