#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <initializer_list>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "fit/comparison_arrays.hpp"
#include "fit/view_loss_grad.hpp"
#include "runtime/bindings.hpp"
#include "raster/gradient_arrays.hpp"
#include "raster/rasterizer.hpp"
#include "raster/scene_arrays.hpp"
#include "raster/view_arrays.hpp"

namespace nb = nanobind;

namespace gsstream_cpu {
namespace {

class PyRasterizer {
 public:
  uint32_t forward(const SceneArrays& scene, ConstFloatArray viewmat, ConstFloatArray K, int width, int height,
                   float near, ConstFloatArray background, std::optional<ByteArray> tile_mask, FloatArray image,
                   FloatArray transmittance) {
    const Camera camera = make_camera(viewmat, K, width, height, near);
    const uint8_t* mask = mask_data(tile_mask, width, height);
    const Target target = make_target(background, image, transmittance, width, height);
    return keep(scene, [&](const Scene& s) { return rasterizer_.forward(s, camera, mask, target); });
  }

  uint32_t forward_active(const SceneArrays& rows, ConstFloatArray background, FloatArray image,
                          FloatArray transmittance, bool touched_only) {
    require(rows.scene.count == rasterizer_.active_count(), "expected one row per active id");
    const Target target = make_target(background, image, transmittance, rasterizer_.width(), rasterizer_.height());
    return keep(rows, [&](const Scene& s) { return rasterizer_.forward_active(s, target, touched_only); });
  }

  uint32_t update(IndexArray changed, const SceneArrays& rows, ConstFloatArray background, FloatArray image,
                  FloatArray transmittance) {
    require(changed.ndim() == 1 && changed.shape(0) == rows.scene.count, "expected one row per changed id");
    const Target target = make_target(background, image, transmittance, rasterizer_.width(), rasterizer_.height());
    hold({});
    const nb::gil_scoped_release release;
    return rasterizer_.update(changed.data(), rows.scene, target);
  }

  void backward_cached(const SceneArrays& scene, ConstFloatArray v_image, FloatArray v_means2d) {
    require_shape(v_means2d, {scene.scene.count, 2}, "v_means2d");
    upstream(v_image, std::nullopt);
    const nb::gil_scoped_release release;
    rasterizer_.backward_cached(scene.scene, v_image.data(), v_means2d.data());
  }

  std::size_t backward_cached_rows(const SceneArrays& scene, ConstFloatArray v_image) {
    upstream(v_image, std::nullopt);
    const nb::gil_scoped_release release;
    return rasterizer_.backward_cached_rows(scene.scene, v_image.data());
  }

  void reached_rows(RowOutArray rows, FloatArray v_means2d) const {
    require_shape(rows, {rasterizer_.reached_count()}, "rows");
    require_shape(v_means2d, {rasterizer_.reached_count(), 2}, "v_means2d");
    rasterizer_.reached_rows(rows.data(), v_means2d.data());
  }

  void visible_in_cache(ByteOutArray out) const {
    require_shape(out, {rasterizer_.scene_count()}, "out");
    rasterizer_.visible_in_cache(out.data());
  }

  void contributing_in_cache(std::optional<ByteArray> tile_mask, ByteOutArray out) {
    require_shape(out, {rasterizer_.scene_count()}, "out");
    const uint8_t* mask = mask_data(tile_mask, rasterizer_.width(), rasterizer_.height());
    const nb::gil_scoped_release release;
    rasterizer_.contributing_in_cache(mask, out.data());
  }

  void limit_pairs(std::size_t most) { rasterizer_.limit_pairs(most); }

  void free_scratch() {
    rasterizer_.free_scratch();
    hold({});
  }

  void forward_cached(ConstFloatArray background, std::optional<ByteArray> tile_mask, FloatArray image,
                      FloatArray transmittance) {
    const uint8_t* mask = mask_data(tile_mask, rasterizer_.width(), rasterizer_.height());
    const Target target = make_target(background, image, transmittance, rasterizer_.width(), rasterizer_.height());
    const nb::gil_scoped_release release;
    rasterizer_.forward_cached(mask, target);
  }

  void backward(ConstFloatArray v_image, std::optional<ConstFloatArray> v_alpha, FloatArray v_means, FloatArray v_quats,
                FloatArray v_scales, FloatArray v_opacities, FloatArray v_sh0, FloatArray v_shN, FloatArray v_means2d,
                bool compact) {
    const std::size_t rows = compact ? rasterizer_.visible().count : current_.scene.count;
    const GradientArrays out = gradients(rows, v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN, v_means2d);
    const float* alpha = upstream(v_image, v_alpha);
    const nb::gil_scoped_release release;
    rasterizer_.backward(v_image.data(), alpha, out, compact);
  }

  void forget() {
    rasterizer_.forget();
    hold({});
  }

  void backward_active(ConstFloatArray v_image, std::optional<ConstFloatArray> v_alpha, FloatArray v_means,
                       FloatArray v_quats, FloatArray v_scales, FloatArray v_opacities, FloatArray v_sh0,
                       FloatArray v_shN, FloatArray v_means2d) {
    const GradientArrays out =
        gradients(rasterizer_.active_count(), v_means, v_quats, v_scales, v_opacities, v_sh0, v_shN, v_means2d);
    const float* alpha = upstream(v_image, v_alpha);
    const nb::gil_scoped_release release;
    rasterizer_.backward_active(v_image.data(), alpha, out);
  }

  // (fault bits, sum of |I - G|, sum of 1 - SSIM); the gradients are written unless there is a fault.
  std::tuple<uint32_t, double, double> loss_and_grad_active(const SceneArrays& rows, const ComparisonArrays& comparison,
                                                   FloatArray v_means, FloatArray v_quats, FloatArray v_scales,
                                                   FloatArray v_opacities, FloatArray v_sh0, FloatArray v_shN) {
    require(rows.scene.count == rasterizer_.active_count(), "expected one row per active id");
    const ViewComparison view = comparison.view(rasterizer_.width(), rasterizer_.height());
    hold(rows);
    means2d_.require(2 * rows.scene.count);
    GradientArrays out = gradient_arrays(rows.scene.count, rows.scene.sh_degree, v_means, v_quats, v_scales, v_opacities,
                                         v_sh0, v_shN);
    out.means2d = means2d_.data();
    const nb::gil_scoped_release release;
    const ViewLossGrad found = view_loss_and_grad(rasterizer_, rows.scene, view, out);
    return {found.faults, found.sums.l1, found.sums.dssim};
  }

  void freeze(std::optional<ByteArray> tile_mask, IndexArray active_ids) {
    require(active_ids.ndim() == 1, "active_ids must be [A]");
    const uint8_t* mask = mask_data(tile_mask, rasterizer_.width(), rasterizer_.height());
    const nb::gil_scoped_release release;
    rasterizer_.freeze(mask, active_ids.data(), active_ids.shape(0));
  }

  void visible_rows(IndexOutArray out) const {
    require_shape(out, {rasterizer_.visible().count}, "out");
    std::copy_n(rasterizer_.visible().rows.data(), rasterizer_.visible().count, out.data());
  }

  void touched_tiles(ByteOutArray out) const {
    const auto cells = [](int pixels) { return static_cast<std::size_t>((pixels + MASK_TILE - 1) / MASK_TILE); };
    require_shape(out, {cells(rasterizer_.height()), cells(rasterizer_.width())}, "out");
    rasterizer_.touched().write_mask(rasterizer_.width(), rasterizer_.height(), out.data());
  }

  const Rasterizer& rasterizer() const { return rasterizer_; }
  Rasterizer& rasterizer() { return rasterizer_; }

 private:
  template <class Pass>
  uint32_t keep(const SceneArrays& arrays, Pass&& pass) {
    uint32_t faults = 0;
    {
      const nb::gil_scoped_release release;
      faults = pass(arrays.scene);
    }
    hold(arrays);
    return faults;
  }

  GradientArrays gradients(std::size_t n, const FloatArray& means, const FloatArray& quats, const FloatArray& scales,
                           const FloatArray& opacities, const FloatArray& sh0, const FloatArray& shN,
                           const FloatArray& means2d) const {
    GradientArrays out = gradient_arrays(n, current_.scene.sh_degree, means, quats, scales, opacities, sh0, shN);
    require_shape(means2d, {n, 2}, "v_means2d");
    out.means2d = means2d.data();
    return out;
  }

  const float* upstream(const ConstFloatArray& v_image, const std::optional<ConstFloatArray>& v_alpha) const {
    if (rasterizer_.width() == 0) throw std::invalid_argument("backward: expected a forward pass before, got none.");
    const std::size_t w = static_cast<std::size_t>(rasterizer_.width()),
                      h = static_cast<std::size_t>(rasterizer_.height());
    require_shape(v_image, {h, w, 3}, "v_image");
    if (v_alpha) require_shape(*v_alpha, {h, w}, "v_alpha");
    return v_alpha ? v_alpha->data() : nullptr;
  }

  Rasterizer rasterizer_;
  // The arrays of the last pass. Letting go of old ones may let another thread run Python, which must not find this object
  // half assigned: so they are swapped out whole, and go at the end of the call.
  void hold(SceneArrays arrays) { std::swap(current_, arrays); }

  SceneArrays current_;
  Buffer<float> means2d_;  // gradients that the caller does not request
};

}  // namespace

Rasterizer& native_rasterizer(nb::handle object) { return nb::cast<PyRasterizer&>(object).rasterizer(); }

// Named arguments, none of which may be converted (see bindings.hpp).
static auto strict(const char* name) { return nb::arg(name).noconvert(); }

#define GSS_TARGET strict("image"), strict("transmittance")
#define GSS_GRADIENTS                                                                                                \
  strict("v_means"), strict("v_quats"), strict("v_scales"), strict("v_opacities"), strict("v_sh0"), strict("v_shN"), \
      strict("v_means2d")

void bind_rasterizer(nb::module_& module) {
  module.attr("FAULT_NOT_FINITE") = static_cast<uint32_t>(FAULT_NOT_FINITE);
  module.attr("FAULT_QUATERNION") = static_cast<uint32_t>(FAULT_QUATERNION);
  module.attr("FAULT_PAIRS") = static_cast<uint32_t>(FAULT_PAIRS);
  nb::class_<SceneArrays>(module, "Scene", "Raw parameters of N Gaussians, float32 and contiguous; not copied.")
      .def(nb::init<ConstFloatArray, ConstFloatArray, ConstFloatArray, ConstFloatArray, ConstFloatArray,
                    ConstFloatArray>(),
           strict("means"), strict("quats"), strict("scales"), strict("opacities"), strict("sh0"), strict("shN"));
  nb::class_<ComparisonArrays>(module, "Comparison", "What a render of one view is compared with; not copied.")
      .def(nb::init<ConstFloatArray, std::optional<ConstFloatArray>, const TargetArrays&, std::optional<ConstFloatArray>,
                    std::optional<ConstFloatArray>, double, double, std::optional<ConstFloatArray>>(),
           strict("background"), strict("cached_image").none(), nb::arg("target"), strict("matrix").none(),
           strict("offset").none(), nb::arg("l1_scale"), nb::arg("ssim_scale"), strict("tile_weights").none());
  nb::class_<PyRasterizer>(module, "Rasterizer",
                           "Rasteriser of one camera; see gsstream_cpu_render.rasterizer for the checked interface.")
      .def(nb::init<>())
      .def("expect", [](const PyRasterizer& r, const std::string& operation) { r.rasterizer().expect(operation); },
           nb::arg("operation"), "Raises ValueError unless this operation may follow now; see rasterizer.hpp.")
      .def("forward", &PyRasterizer::forward, nb::arg("scene"), strict("viewmat"), strict("K"), nb::arg("width"),
           nb::arg("height"), nb::arg("near"), strict("background"), strict("tile_mask").none(), GSS_TARGET,
           "Returns FAULT_* bits; 0 means rendered.")
      .def("backward", &PyRasterizer::backward, strict("v_image"), strict("v_alpha").none(), GSS_GRADIENTS,
           nb::arg("compact"))
      .def("forget", &PyRasterizer::forget, "Drop the arrays kept for backward.")
      .def("freeze", &PyRasterizer::freeze, strict("tile_mask").none(), strict("active_ids"))
      .def("forward_active", &PyRasterizer::forward_active, nb::arg("scene"), strict("background"), GSS_TARGET,
           nb::arg("touched_only"))
      .def("backward_active", &PyRasterizer::backward_active, strict("v_image"), strict("v_alpha").none(),
           GSS_GRADIENTS)
      .def("loss_and_grad_active", &PyRasterizer::loss_and_grad_active, nb::arg("scene"), nb::arg("comparison"), strict("v_means"),
           strict("v_quats"), strict("v_scales"), strict("v_opacities"), strict("v_sh0"), strict("v_shN"))
      .def("update", &PyRasterizer::update, strict("changed"), nb::arg("scene"), strict("background"), GSS_TARGET)
      .def("backward_cached", &PyRasterizer::backward_cached, nb::arg("scene"), strict("v_image"), strict("v_means2d"))
      .def("backward_cached_rows", &PyRasterizer::backward_cached_rows, nb::arg("scene"), strict("v_image"))
      .def("reached_rows", &PyRasterizer::reached_rows, strict("rows"), strict("v_means2d"))
      .def("visible_in_cache", &PyRasterizer::visible_in_cache, strict("out"))
      .def("contributing_in_cache", &PyRasterizer::contributing_in_cache, strict("tile_mask").none(), strict("out"))
      .def("free_scratch", &PyRasterizer::free_scratch)
      .def("limit_pairs", &PyRasterizer::limit_pairs, nb::arg("most"), "Forward passes of more pairs give FAULT_PAIRS.")
      .def("forward_cached", &PyRasterizer::forward_cached, strict("background"), strict("tile_mask").none(),
           GSS_TARGET)
      .def("visible_rows", &PyRasterizer::visible_rows, strict("out"))
      .def("touched_tiles", &PyRasterizer::touched_tiles, strict("out"))
      .def_prop_ro("visible_count", [](const PyRasterizer& r) { return r.rasterizer().visible().count; })
      .def_prop_ro("active_count", [](const PyRasterizer& r) { return r.rasterizer().active_count(); })
      .def_prop_ro("scene_count", [](const PyRasterizer& r) { return r.rasterizer().scene_count(); })
      .def_prop_ro("pair_count", [](const PyRasterizer& r) { return r.rasterizer().pair_count(); })
      .def_prop_ro("entry_count", [](const PyRasterizer& r) { return r.rasterizer().entry_count(); })
      .def_prop_ro("isa", [](const PyRasterizer& r) { return std::string(isa_name(r.rasterizer().isa())); })
      .def_prop_ro("passes", [](const PyRasterizer& r) { return r.rasterizer().passes(); })
      .def("cache_bytes", [](const PyRasterizer& r) { return r.rasterizer().cache_bytes(); })
      .def("memory_bytes", [](const PyRasterizer& r) { return r.rasterizer().memory_bytes(); });
}

}  // namespace gsstream_cpu
