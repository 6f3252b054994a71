// Where gradients by the raw parameters go, as it comes from Python. Checked here.
#pragma once
#include "raster/scene_arrays.hpp"

namespace gsstream_cpu {

// One row for each of n Gaussians; without means2d, which is to be added.
inline GradientArrays gradient_arrays(std::size_t n, int sh_degree, const FloatArray& means, const FloatArray& quats,
                                      const FloatArray& scales, const FloatArray& opacities, const FloatArray& sh0,
                                      const FloatArray& shN) {
  const std::size_t degree = static_cast<std::size_t>(sh_degree), bases = (degree + 1) * (degree + 1);
  require_shape(means, {n, 3}, "v_means");
  require_shape(quats, {n, 4}, "v_quats");
  require_shape(scales, {n, 3}, "v_scales");
  require_shape(opacities, {n}, "v_opacities");
  require_shape(sh0, {n, 1, 3}, "v_sh0");
  require_shape(shN, {n, bases - 1, 3}, "v_shN");
  return {means.data(), quats.data(), scales.data(), opacities.data(), sh0.data(), shN.data(), nullptr};
}

}  // namespace gsstream_cpu
