#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <tuple>

#include "fit/comparison_arrays.hpp"
#include "fit/full_loss_grad.hpp"
#include "raster/gradient_arrays.hpp"

namespace nb = nanobind;

namespace gsstream_cpu {
namespace {

// (fault bits, sum of |I - G|, sum of 1 - SSIM); the gradients are written unless there is a fault.
std::tuple<uint32_t, double, double> loss_and_grad(nb::handle object, const SceneArrays& scene, ConstFloatArray viewmat,
                                          ConstFloatArray K, int width, int height, float near,
                                          const ComparisonArrays& comparison, FloatArray v_means, FloatArray v_quats,
                                          FloatArray v_scales, FloatArray v_opacities, FloatArray v_sh0,
                                          FloatArray v_shN, FloatArray v_means2d, std::optional<FloatArray> colours) {
  Rasterizer& rasterizer = native_rasterizer(object);
  const Camera camera = make_camera(viewmat, K, width, height, near);
  const ViewComparison view = comparison.whole_view(width, height);
  require(!view.weights, "full_loss_and_grad: weights of tiles are for active rows");
  if (colours) require_shape(*colours, {12}, "colours");
  const std::size_t count = scene.scene.count;
  GradientArrays out =
      gradient_arrays(count, scene.scene.sh_degree, v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN);
  require_shape(v_means2d, {count, 2}, "v_means2d");
  out.means2d = v_means2d.data();
  float* grad = colours ? colours->data() : nullptr;
  const nb::gil_scoped_release released;
  const ViewLossGrad found = full_loss_and_grad(rasterizer, scene.scene, camera, view, out, grad);
  return {found.faults, found.sums.l1, found.sums.dssim};
}

}  // namespace

void bind_whole(nb::module_& module) {
  const auto strict = [](const char* name) { return nb::arg(name).noconvert(); };
  module.def("full_loss_and_grad", &loss_and_grad, nb::arg("rasterizer"), nb::arg("scene"), strict("viewmat"), strict("K"),
             nb::arg("width"), nb::arg("height"), nb::arg("near"), nb::arg("comparison"), strict("v_means"),
             strict("v_quats"), strict("v_scales"), strict("v_opacities"), strict("v_sh0"), strict("v_shN"),
             strict("v_means2d"), strict("colours").none(),
             "Render a scene of which every row moves, compare, and return the gradient by all of it.");
}

}  // namespace gsstream_cpu
