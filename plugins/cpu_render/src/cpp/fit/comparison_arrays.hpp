// What a render of one view is compared with, as it comes from Python, checked where it meets its rasteriser.
#pragma once
#include <optional>

#include "fit/view_loss_grad.hpp"
#include "photometric/target_arrays.hpp"
#include "raster/scene_arrays.hpp"

namespace gsstream_cpu {

class ComparisonArrays {
 public:
  ComparisonArrays(ConstFloatArray background, std::optional<ConstFloatArray> cached_image, const TargetArrays& target,
                   std::optional<ConstFloatArray> matrix, std::optional<ConstFloatArray> offset, double l1_scale,
                   double ssim_scale, std::optional<ConstFloatArray> weights)
      : cached_(cached_image),
        target_(target),
        background_(background),
        matrix_(matrix),
        offset_(offset),
        weights_(weights),
        l1_scale_(static_cast<float>(l1_scale)),
        ssim_scale_(static_cast<float>(ssim_scale)) {
    require_shape(background_, {3}, "background");
    require(matrix_.has_value() == offset_.has_value(), "colour matrix and offset come together or not at all");
    if (matrix_) require_shape(*matrix_, {3, 3}, "matrix");
    if (offset_) require_shape(*offset_, {3}, "offset");
  }

  // For a rasteriser of images of this size, of which some Gaussians stand still. Valid as long as this object.
  ViewComparison view(int width, int height) const {
    require(cached_.has_value(), "a comparison of active rows needs the cached image");
    return whole_view(width, height);
  }

  // The same where every Gaussian moves.
  ViewComparison whole_view(int width, int height) const {
    const std::size_t w = static_cast<std::size_t>(width), h = static_cast<std::size_t>(height);
    const auto cells = [](std::size_t pixels) { return (pixels + MASK_TILE - 1) / MASK_TILE; };
    target_.require_size(h, w);
    if (cached_) require_shape(*cached_, {h, w, 3}, "image");
    if (weights_) require_shape(*weights_, {cells(h), cells(w)}, "tile_weights");
    const float* b = background_.data();
    return {cached_ ? cached_->data() : nullptr, target_.pixels, target_.statistics,
            matrix_ ? matrix_->data() : nullptr, offset_ ? offset_->data() : nullptr, {b[0], b[1], b[2]},
            l1_scale_, ssim_scale_, weights_ ? weights_->data() : nullptr};
  }

 private:
  std::optional<ConstFloatArray> cached_;
  TargetArrays target_;
  ConstFloatArray background_;
  std::optional<ConstFloatArray> matrix_, offset_, weights_;
  float l1_scale_, ssim_scale_;
};

// The native objects behind those of Python.
Rasterizer& native_rasterizer(nanobind::handle object);

}  // namespace gsstream_cpu
