// Arrays of a scene and a camera as they come from Python, checked.
#pragma once
#include <initializer_list>
#include <stdexcept>
#include <string>
#include <vector>

#include "runtime/bindings.hpp"
#include "raster/rasterizer.hpp"

namespace gsstream_cpu {

// The Python side checks with messages for people; these checks keep memory safe whatever comes.
inline void require(bool good, const char* what) {
  if (!good) throw std::invalid_argument(std::string("Rasterizer: ") + what);
}

template <class Array>
void require_shape(const Array& array, std::initializer_list<std::size_t> shape, const char* name) {
  bool good = array.ndim() == shape.size();
  std::size_t axis = 0;
  for (std::size_t side : shape) good = good && array.shape(axis++) == side;
  require(good, (std::string(name) + " has the wrong shape").c_str());
}

// Keeps the arrays of a forward pass alive until the backward that reads them again.
struct SceneArrays {
  std::vector<ConstFloatArray> held;
  Scene scene;

  SceneArrays() = default;
  SceneArrays(ConstFloatArray means, ConstFloatArray quats, ConstFloatArray scales, ConstFloatArray opacities,
              ConstFloatArray sh0, ConstFloatArray shN)
      : held{means, quats, scales, opacities, sh0, shN} {
    require(means.ndim() == 2 && shN.ndim() == 3, "means must be [N,3] and shN [N,K-1,3]");
    const std::size_t n = means.shape(0), rest = shN.shape(1);
    require(n < FROZEN / 2, "too many Gaussians");
    require(rest == 0 || rest == 3 || rest == 8 || rest == 15, "shN must have 0, 3, 8 or 15 coefficients");
    require_shape(means, {n, 3}, "means");
    require_shape(quats, {n, 4}, "quats");
    require_shape(scales, {n, 3}, "scales");
    require_shape(opacities, {n}, "opacities");
    require_shape(sh0, {n, 1, 3}, "sh0");
    require_shape(shN, {n, rest, 3}, "shN");
    scene.arrays = {means.data(), quats.data(), scales.data(), opacities.data(), sh0.data(), shN.data()};
    scene.count = n;
    scene.sh_degree = rest == 0 ? 0 : rest == 3 ? 1 : rest == 8 ? 2 : 3;
  }
};

inline Camera make_camera(const ConstFloatArray& viewmat, const ConstFloatArray& intrinsics, int width, int height,
                   float near) {
  require_shape(viewmat, {4, 4}, "viewmat");
  require_shape(intrinsics, {3, 3}, "K");
  require(width >= 1 && height >= 1 && width <= 65536 && height <= 65536, "image sides must be 1 to 65536");
  Camera c{};
  const float *v = viewmat.data(), *k = intrinsics.data();
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) c.rotation[3 * i + j] = v[4 * i + j];
    c.translation[i] = v[4 * i + 3];
  }
  for (int j = 0; j < 3; j++)
    c.position[j] = -(c.rotation[j] * c.translation[0] + c.rotation[3 + j] * c.translation[1] +
                      c.rotation[6 + j] * c.translation[2]);
  c.fx = k[0];
  c.fy = k[4];
  c.cx = k[2];
  c.cy = k[5];
  c.near = near;
  require(near > 0, "near must be positive");
  require(c.fx > 0 && c.fy > 0, "K must have positive focal lengths");
  const float margin_x = 0.15f * static_cast<float>(width) / c.fx, margin_y = 0.15f * static_cast<float>(height) / c.fy;
  c.x_low = -c.cx / c.fx - margin_x;
  c.x_high = (static_cast<float>(width) - c.cx) / c.fx + margin_x;
  c.y_low = -c.cy / c.fy - margin_y;
  c.y_high = (static_cast<float>(height) - c.cy) / c.fy + margin_y;
  c.width = width;
  c.height = height;
  return c;
}

}  // namespace gsstream_cpu
