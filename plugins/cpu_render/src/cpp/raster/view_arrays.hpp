// Arrays of one view as they come from Python: tiles that are asked about, and where a render goes. Checked here.
#pragma once
#include <optional>

#include "raster/rasterizer.hpp"
#include "raster/scene_arrays.hpp"

namespace gsstream_cpu {

inline const uint8_t* mask_data(const std::optional<ByteArray>& mask, int width, int height) {
  if (!mask) return nullptr;
  const auto cells = [](int pixels) { return static_cast<std::size_t>((pixels + MASK_TILE - 1) / MASK_TILE); };
  require_shape(*mask, {cells(height), cells(width)}, "tile_mask");
  return mask->data();
}

// Without `transmittance` it is not written.
inline Target make_target(const ConstFloatArray& background, const FloatArray& image,
                          const std::optional<FloatArray>& transmittance, int width, int height) {
  const std::size_t w = static_cast<std::size_t>(width), h = static_cast<std::size_t>(height);
  require_shape(background, {3}, "background");
  require_shape(image, {h, w, 3}, "image");
  if (transmittance) require_shape(*transmittance, {h, w}, "transmittance");
  const float* b = background.data();
  return {{b[0], b[1], b[2]}, image.data(), transmittance ? transmittance->data() : nullptr};
}

}  // namespace gsstream_cpu
