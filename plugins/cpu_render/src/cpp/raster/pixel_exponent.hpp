// log2(alpha) of one Gaussian at the pixels of a block: the one expression that forward and backward share.
#pragma once
#include "raster/raster_types.hpp"
#include "runtime/simd.hpp"

namespace gsstream_cpu::GSS_ISA {

struct PixelCentres {
  alignas(64) float x[BLOCKS][BLOCK_PIXELS], y[BLOCKS][BLOCK_PIXELS];
  constexpr PixelCentres() : x(), y() {
    for (int b = 0; b < BLOCKS; b++)
      for (int i = 0; i < BLOCK_PIXELS; i++) {
        x[b][i] = static_cast<float>(b % BLOCKS_X * BLOCK_SIDE + i % BLOCK_SIDE) + 0.5f;
        y[b][i] = static_cast<float>(b / BLOCKS_X * BLOCK_SIDE + i / BLOCK_SIDE) + 0.5f;
      }
  }
};
constexpr PixelCentres CENTRES;

// A record broadcast to all lanes, with the centre relative to the tile.
struct Kernel {
  Floats x, y, a, b, c, log2_opacity, red, green, blue;
  GSS_INLINE Kernel(const Record& r, float tile_x, float tile_y)
      : x(broadcast(tile_x - r.x)),
        y(broadcast(tile_y - r.y)),
        a(broadcast(r.a)),
        b(broadcast(r.b)),
        c(broadcast(r.c)),
        log2_opacity(broadcast(r.log2_opacity)),
        red(broadcast(r.color[0])),
        green(broadcast(r.color[1])),
        blue(broadcast(r.color[2])) {}
};

struct Exponent {
  Floats dx, dy, log2_alpha;
};
GSS_INLINE Exponent exponent_at(const Kernel& k, int block, int lane) {
  Exponent e;
  e.dx = load(CENTRES.x[block] + lane) + k.x;
  e.dy = load(CENTRES.y[block] + lane) + k.y;
  e.log2_alpha = e.dx * (k.a * e.dx + k.b * e.dy) + (k.c * e.dy * e.dy + k.log2_opacity);
  return e;
}

}  // namespace gsstream_cpu::GSS_ISA
