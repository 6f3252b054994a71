#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>

#include "fit/comparison_arrays.hpp"
#include "fit/moved_rows.hpp"

namespace nb = nanobind;

namespace gsstream_cpu {
namespace {

using Places = nb::ndarray<const int64_t, nb::c_contig, nb::device::cpu>;
using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using DoublesOut = nb::ndarray<double, nb::c_contig, nb::device::cpu>;

// (fault bits, sum of |I - G|, sum of 1 - SSIM); grad and curvature are written unless there is a fault.
std::tuple<uint32_t, double, double> loss_and_grad(nb::handle object, const SceneArrays& rows, const ComparisonArrays& comparison,
                                          Places place, Doubles centre, Doubles shift, Doubles turn, DoublesOut grad,
                                          std::optional<DoublesOut> curvature) {
  Rasterizer& rasterizer = native_rasterizer(object);
  require(rows.scene.count == rasterizer.active_count(), "expected one row per active id");
  const std::size_t groups = grad.shape(0);
  for (const Doubles* array : {&centre, &shift, &turn}) require_shape(*array, {groups, 3}, "centre, shift or turn");
  require_shape(grad, {groups, 6}, "grad");
  if (curvature) require_shape(*curvature, {groups, 6, 6}, "curvature");
  require_shape(place, {rows.scene.count}, "place");
  for (std::size_t i = 0; i < rows.scene.count; i++)
    require(place.data()[i] >= 0 && static_cast<std::size_t>(place.data()[i]) < groups, "a row of no group");
  const MovedRows moved{rows.scene, place.data(), groups, centre.data(), shift.data(), turn.data()};
  const ViewComparison view = comparison.view(rasterizer.width(), rasterizer.height());
  double *out = grad.data(), *blocks = curvature ? curvature->data() : nullptr;
  const nb::gil_scoped_release released;
  const ViewLossGrad found = transform_loss_and_grad(rasterizer, moved, view, out, blocks);
  return {found.faults, found.sums.l1, found.sums.dssim};
}

}  // namespace

void bind_moved(nb::module_& module) {
  const auto strict = [](const char* name) { return nb::arg(name).noconvert(); };
  module.def("transform_loss_and_grad", &loss_and_grad, nb::arg("rasterizer"), nb::arg("rows"), nb::arg("comparison"), strict("place"),
             strict("centre"), strict("shift"), strict("turn"), strict("grad"), strict("curvature").none() = nb::none(),
             "Render rows that move in groups, compare, and return the gradient by the groups' transforms.");
}

}  // namespace gsstream_cpu
