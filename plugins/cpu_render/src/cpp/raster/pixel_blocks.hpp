// Moving 4x4 blocks of pixels between row-major images and block order. Four pixels of a row at a time; pixels outside
// the image (last column or row of blocks) read as zero and are not written.
#pragma once
#include "raster/raster_types.hpp"
#include "runtime/simd.hpp"

namespace gsstream_cpu::GSS_ISA {

typedef float Quad __attribute__((vector_size(16)));

struct BlockPlace {
  std::size_t first;   // index of the block's first pixel in the image
  std::size_t stride;  // pixels per image row
  int columns, rows;   // pixels of the block inside the image
};

GSS_INLINE BlockPlace place_of(int block, int tile_x, int tile_y, int width, int height) {
  const int x = tile_x + block % BLOCKS_X * BLOCK_SIDE, y = tile_y + block / BLOCKS_X * BLOCK_SIDE;
  const int right = width - x, below = height - y;
  return {static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x),
          static_cast<std::size_t>(width), right < BLOCK_SIDE ? right : BLOCK_SIDE,
          below < BLOCK_SIDE ? below : BLOCK_SIDE};
}

GSS_INLINE Quad load_quad(const float* p) {
  Quad r;
  std::memcpy(&r, p, sizeof r);
  return r;
}
GSS_INLINE void store_quad(float* p, Quad v) { std::memcpy(p, &v, sizeof v); }

GSS_INLINE void write_rgb(const BlockPlace& place, const float* red, const float* green, const float* blue,
                          float* image) {
  for (int row = 0; row < place.rows; row++) {
    float* out = image + 3 * (place.first + row * place.stride);
    if (place.columns == BLOCK_SIDE) {
      const Quad r = load_quad(red + 4 * row), g = load_quad(green + 4 * row), b = load_quad(blue + 4 * row);
      const Quad rg = __builtin_shufflevector(r, g, 0, 4, 1, 5), gb = __builtin_shufflevector(g, b, 1, 5, 2, 6),
                 br = __builtin_shufflevector(b, r, 2, 7, 3, 3);
      store_quad(out, __builtin_shufflevector(rg, __builtin_shufflevector(b, r, 0, 5, 0, 0), 0, 1, 4, 5));
      store_quad(out + 4, __builtin_shufflevector(gb, r, 0, 1, 6, 2));
      store_quad(out + 8, __builtin_shufflevector(br, __builtin_shufflevector(g, b, 3, 7, 3, 3), 0, 1, 4, 5));
    } else {
      for (int i = 0; i < place.columns; i++) {
        out[3 * i] = red[4 * row + i];
        out[3 * i + 1] = green[4 * row + i];
        out[3 * i + 2] = blue[4 * row + i];
      }
    }
  }
}

GSS_INLINE void read_rgb(const BlockPlace& place, const float* image, float* red, float* green, float* blue) {
  for (int row = 0; row < BLOCK_SIDE; row++) {
    float *r = red + 4 * row, *g = green + 4 * row, *b = blue + 4 * row;
    if (row < place.rows && place.columns == BLOCK_SIDE) {
      const float* in = image + 3 * (place.first + row * place.stride);
      const Quad u = load_quad(in), v = load_quad(in + 4), w = load_quad(in + 8);  // rgbr gbrg brgb
      const Quad r3g2 = __builtin_shufflevector(v, w, 2, 5, 3, 6);                 // r2 r3 g2 g3
      const Quad low = __builtin_shufflevector(u, v, 1, 4, 2, 5);                  // g0 g1 b0 b1
      store_quad(r, __builtin_shufflevector(u, r3g2, 0, 3, 4, 5));
      store_quad(g, __builtin_shufflevector(low, r3g2, 0, 1, 6, 7));
      store_quad(b, __builtin_shufflevector(low, w, 2, 3, 4, 7));
      continue;
    }
    for (int i = 0; i < BLOCK_SIDE; i++) {
      const bool inside = row < place.rows && i < place.columns;
      const float* in = image + 3 * (place.first + row * place.stride + i);
      r[i] = inside ? in[0] : 0.0f;
      g[i] = inside ? in[1] : 0.0f;
      b[i] = inside ? in[2] : 0.0f;
    }
  }
}

GSS_INLINE void write_scalar(const BlockPlace& place, const float* values, float* image) {
  for (int row = 0; row < place.rows; row++) {
    float* out = image + place.first + row * place.stride;
    if (place.columns == BLOCK_SIDE)
      store_quad(out, load_quad(values + 4 * row));
    else
      for (int i = 0; i < place.columns; i++) out[i] = values[4 * row + i];
  }
}

GSS_INLINE void read_scalar(const BlockPlace& place, const float* image, float* values) {
  for (int row = 0; row < BLOCK_SIDE; row++)
    for (int i = 0; i < BLOCK_SIDE; i++)
      values[4 * row + i] = row < place.rows && i < place.columns ? image[place.first + row * place.stride + i] : 0.0f;
}

}  // namespace gsstream_cpu::GSS_ISA
