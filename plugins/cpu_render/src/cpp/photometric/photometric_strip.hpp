// Strips of tiles: loading, the separable blur, partial vectors at the image's right edge. Kernel files only.
//
// Order of work: vertical pass first (rows of a strip are shared by the whole strip, so no blur is computed twice),
// then the horizontal pass straight into the pointwise formulas. Interleaved channels stay interleaved: a horizontal
// neighbour is three floats away.
#pragma once
#include <cstring>

#include "photometric/photometric.hpp"
#include "runtime/simd.hpp"

namespace gsstream_cpu::GSS_ISA {
namespace {

struct Window {
  Floats w[kReach + 1];
};

struct Strip {
  int y0, x0, rows;      // first pixel; rows inside the image
  int tiles;
  int floats;            // interleaved columns inside the image
  int vectors;           // of the padded strip: 2 * kPad + 48 * tiles floats
  bool border;           // some window leaves the image
};

GSS_INLINE Window load_window(const float* weights) {
  Window window;
  for (int k = 0; k <= kReach; ++k) window.w[k] = broadcast(weights[k]);
  return window;
}

GSS_INLINE Strip make_strip(const PhotometricJob& job, int tile_row, int first, int tiles) {
  Strip s;
  s.y0 = tile_row * kTile;
  s.x0 = first * kTile;
  s.tiles = tiles;
  s.rows = job.height - s.y0 < kTile ? job.height - s.y0 : kTile;
  const int columns = job.width - s.x0 < tiles * kTile ? job.width - s.x0 : tiles * kTile;
  s.floats = 3 * columns;
  s.vectors = (2 * kPad + 3 * kTile * tiles) / LANES;
  s.border = s.y0 < kReach || s.x0 < kReach || s.y0 + kTile + kReach > job.height ||
             s.x0 + tiles * kTile + kReach > job.width;
  return s;
}

GSS_INLINE void copy_values(float* to, const float* from, int count) { std::memcpy(to, from, sizeof(float) * count); }
GSS_INLINE void copy_values(float* to, const uint8_t* from, int count) {
  int i = 0;
  for (; i + LANES <= count; i += LANES) store(to + i, load(from + i));
  for (; i < count; ++i) to[i] = static_cast<float>(from[i]) / 255.0f;
}

// Copies rows y0-5 .. y0+20 and floats 3*x0-16 .. of an image; zeros right and left of it. Rows above and below the
// image are left alone.
template <class Value>
GSS_INLINE void load_strip(const PhotometricJob& job, const Strip& s, const Value* image, float* raw) {
  const int width = 3 * job.width, left = 3 * s.x0 - kPad, all = s.vectors * LANES;
  const int low = left < 0 ? -left : 0;
  const int high = width - left < all ? width - left : all;
  for (int r = 0; r < kRows; ++r) {
    const int y = s.y0 - kReach + r;
    if (y < 0 || y >= job.height) continue;
    float* row = raw + r * kStripStride;
    for (int j = 0; j < low; ++j) row[j] = 0.0f;
    copy_values(row + low, image + static_cast<std::ptrdiff_t>(y) * width + left + low, high - low);
    for (int j = high; j < all; ++j) row[j] = 0.0f;
  }
}

// Rows above and below the image become `centre`, so that raw - centre is 0 wherever the image is not.
GSS_INLINE void fill_outside(const PhotometricJob& job, const Strip& s, const float* centre, float* raw) {
  for (int r = 0; r < kRows; ++r) {
    const int y = s.y0 - kReach + r;
    if (y < 0 || y >= job.height)
      std::memcpy(raw + r * kStripStride, centre, sizeof(float) * s.vectors * LANES);
  }
}

// About the mean colour of a loaded strip (a sample of its rows) at columns inside the image, 0 outside.
GSS_INLINE void find_centre(const PhotometricJob& job, const Strip& s, const float* raw, float* centre) {
  const int left = 3 * s.x0 - kPad, all = s.vectors * LANES;
  const int low = left < 0 ? -left : 0;
  const int high = 3 * job.width - left < all ? 3 * job.width - left : all;
  Floats sums[3] = {};
  int sampled = 0;
  for (int r = kReach % 4; r < kRows; r += 4) {  // contains row 5, which is always inside
    const int y = s.y0 - kReach + r;
    if (y < 0 || y >= job.height) continue;
    ++sampled;
    for (int v = 0; v < s.vectors; ++v) sums[v % 3] += load(raw + r * kStripStride + v * LANES);
  }
  float mean[3] = {};
  for (int v = 0; v < 3; ++v)
    for (int lane = 0; lane < LANES; ++lane) mean[(v * LANES + lane + 2) % 3] += sums[v][lane];  // -16 = 2 (mod 3)
  for (float& m : mean) m /= static_cast<float>(sampled) * static_cast<float>(high - low) / 3.0f;
  int channel = 2;
  for (int j = 0; j < all; ++j) {
    centre[j] = j >= low && j < high ? mean[channel] : 0.0f;
    channel = channel == 2 ? 0 : channel + 1;
  }
}

GSS_INLINE void vertical(const Floats* x, const Window& window, float* out) {
#pragma GCC unroll 16
  for (int r = 0; r < kTile; ++r) {
    Floats sum = window.w[kReach] * x[r + kReach];
#pragma GCC unroll 5
    for (int k = 0; k < kReach; ++k) sum += window.w[k] * (x[r + k] + x[r + 2 * kReach - k]);
    store(out + r * kStripStride, sum);
  }
}

GSS_INLINE Floats horizontal(const float* s, const Window& window) {
  Floats sum = window.w[kReach] * load(s);
#pragma GCC unroll 5
  for (int k = 0; k < kReach; ++k) {
    const int distance = 3 * (kReach - k);
    sum += window.w[k] * (load(s - distance) + load(s + distance));
  }
  return sum;
}

GSS_INLINE Mask first_lanes(int count) {
  static const int32_t index[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  return greater_equal(broadcast(static_cast<int32_t>(count - 1)), load(index));
}

template <class Value>
GSS_INLINE Floats load_first(const Value* p, int count) {
  if (count >= LANES) return load(p);
  Value part[LANES] = {};
  for (int i = 0; i < count; ++i) part[i] = p[i];
  return load(part);
}

GSS_INLINE void store_first(float* p, Floats v, int count) {
  if (count >= LANES) return store(p, v);
  float part[LANES];
  store(part, v);
  for (int i = 0; i < count; ++i) p[i] = part[i];
}

struct Scratch {
  float *image, *target, *centre, *mean, *variance;
  float* blurred[5];  // vertically: difference, its square, its product with the target, target, target^2; or three maps

  GSS_INLINE explicit Scratch(float* p) {
    image = p;
    target = image + kRows * kStripStride;
    centre = target + kRows * kStripStride;
    p = centre + kStripStride;
    for (float*& b : blurred) {
      b = p;
      p += kTile * kStripStride;
    }
    mean = p;
    variance = mean + kTile * kStripStride;
  }
};

// The window's weight inside the image at vector j of row y, for border strips.
GSS_INLINE Floats inside_weight(const PhotometricJob& job, const Strip& s, int r, int j) {
  return load(job.column_weight + 3 * s.x0 + j) * job.row_weight[s.y0 + r];
}

}  // namespace
}  // namespace gsstream_cpu::GSS_ISA
