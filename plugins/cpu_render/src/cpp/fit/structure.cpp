#include "fit/structure.hpp"

#include <cmath>

namespace gsstream_cpu {

void structure_of_line(const float* image, const TargetPixels& target, int width, int height, std::size_t first,
                       std::size_t count, float* out) {
  const std::size_t line = static_cast<std::size_t>(width), y = first / line;
  const std::size_t above = y > 0 ? line : 0, below = y + 1 < static_cast<std::size_t>(height) ? line : 0;
  for (std::size_t pixel = first; pixel < first + count; pixel++) {
    const std::size_t x = pixel % line, left = x > 0 ? 1 : 0, right = x + 1 < line ? 1 : 0;
    float xx = 0.0f, xy = 0.0f, yy = 0.0f;
    for (std::size_t channel = 0; channel < 3; channel++) {
      const std::size_t at = 3 * pixel + channel;
      const float error = image[at] - target[at];
      const float weight = 1.0f / std::sqrt(error * error + LEAST_ERROR * LEAST_ERROR);
      const float across = 0.5f * (image[at + 3 * right] - image[at - 3 * left]);
      const float down = 0.5f * (image[at + 3 * below] - image[at - 3 * above]);
      xx += weight * across * across;
      xy += weight * across * down;
      yy += weight * down * down;
    }
    out[3 * pixel] = xx;
    out[3 * pixel + 1] = xy;
    out[3 * pixel + 2] = yy;
  }
}

}  // namespace gsstream_cpu
