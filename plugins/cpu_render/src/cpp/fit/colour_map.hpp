// Affine colour maps of cameras, recorded = matrix scene + offset, over interleaved pixels of three channels.
#pragma once
#include <cstddef>
#include <cstring>

namespace gsstream_cpu {

// Three channels of a pixel, and nothing in the fourth place.
typedef float Colour __attribute__((vector_size(16)));

inline void store_colour(float* out, Colour colour) { std::memcpy(out, &colour, 3 * sizeof(float)); }

// out = matrix in + offset, pixel by pixel.
inline void apply_exposure(const float* matrix, const float* offset, const float* in, float* out, std::size_t pixels) {
  const Colour red{matrix[0], matrix[3], matrix[6], 0}, green{matrix[1], matrix[4], matrix[7], 0},
      blue{matrix[2], matrix[5], matrix[8], 0}, added{offset[0], offset[1], offset[2], 0};
  for (std::size_t i = 0; i < 3 * pixels; i += 3)
    store_colour(out + i, added + (red * in[i] + green * in[i + 1] + blue * in[i + 2]));
}

// gradient = gradient matrix, pixel by pixel.
inline void exposure_vjp(const float* matrix, float* gradient, std::size_t pixels) {
  const Colour red{matrix[0], matrix[1], matrix[2], 0}, green{matrix[3], matrix[4], matrix[5], 0},
      blue{matrix[6], matrix[7], matrix[8], 0};
  for (std::size_t i = 0; i < 3 * pixels; i += 3)
    store_colour(gradient + i, red * gradient[i] + green * gradient[i + 1] + blue * gradient[i + 2]);
}

// grad [12] = the gradient of the loss by the matrix and by the offset, of pixels of these scene colours whose recorded
// colours have this gradient.
inline void exposure_grad_of(const float* scene, const float* gradient, std::size_t pixels, double* grad) {
  Colour red{}, green{}, blue{}, sum{};
  for (std::size_t i = 0; i < 3 * pixels; i += 3) {
    const Colour colour{scene[i], scene[i + 1], scene[i + 2], 0};
    red += gradient[i] * colour;
    green += gradient[i + 1] * colour;
    blue += gradient[i + 2] * colour;
    sum += Colour{gradient[i], gradient[i + 1], gradient[i + 2], 0};
  }
  for (int channel = 0; channel < 3; channel++) {
    grad[channel] = red[channel];
    grad[3 + channel] = green[channel];
    grad[6 + channel] = blue[channel];
    grad[9 + channel] = sum[channel];
  }
}

}  // namespace gsstream_cpu
