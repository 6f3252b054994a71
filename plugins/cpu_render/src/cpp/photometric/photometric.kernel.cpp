// The formulas, in the images' difference d = I - G. With dm = blur(d), q = blur(d^2) - dm^2 (variance of d):
//   b1 - a1 = dm^2,  b2 - a2 = q,  1 - SSIM = (a1 q + dm^2 b2) / (b1 b2)
// where a1, b1 compare means and a2, b2 variances, as in Wang et al. 2004, eq. 13. So neither the loss nor its gradient
// is a difference of large numbers, and where the images agree both are exactly 0. The target's moments are taken
// about a constant per strip and channel, which keeps E[x^2] - E[x]^2 accurate where an image is flat and bright; at
// the image's rim the zero padding makes the window's weight W less than 1, and exact correction terms carry 1 - W.
#include "photometric/photometric.hpp"
#include "photometric/photometric_strip.hpp"
#include "runtime/simd.hpp"

namespace gsstream_cpu::GSS_ISA {
namespace {

constexpr float kC1 = 0.01f * 0.01f;
constexpr float kC2 = 0.03f * 0.03f;

void load_target(const PhotometricJob& job, const Strip& s, Scratch& t) {
  if (job.target.bytes)
    load_strip(job, s, job.target.bytes, t.target);
  else
    load_strip(job, s, job.target.floats, t.target);
  find_centre(job, s, t.target, t.centre);
  fill_outside(job, s, t.centre, t.target);
}

void target_statistics(const PhotometricJob& job, const Strip& s, const Window& window, Scratch& t) {
  for (int v = 0; v < s.vectors; ++v) {
    Floats x[kRows], xx[kRows];
    const Floats centre = load(t.centre + v * LANES);
    for (int r = 0; r < kRows; ++r) {
      x[r] = load(t.target + r * kStripStride + v * LANES) - centre;
      xx[r] = x[r] * x[r];
    }
    vertical(x, window, t.blurred[3] + v * LANES);
    vertical(xx, window, t.blurred[4] + v * LANES);
  }
  for (int r = 0; r < s.rows; ++r) {
    for (int j = 0; j < s.floats; j += LANES) {
      const int at = r * kStripStride + kPad + j;
      const Floats mean = horizontal(t.blurred[3] + at, window);
      Floats variance = horizontal(t.blurred[4] + at, window) - mean * mean;
      Floats shift = load(t.centre + kPad + j);
      if (s.border) {
        const Floats weight = inside_weight(job, s, r, j);
        variance += (1.0f - weight) * shift * (2.0f * mean + shift * weight);
        shift *= weight;
      }
      store(t.mean + at, mean + shift);
      store(t.variance + at, variance);
    }
  }
}

void blur_difference(const Strip& s, const Window& window, Scratch& t) {
  for (int v = 0; v < s.vectors; ++v) {
    Floats d[kRows], dd[kRows], dg[kRows];
    const Floats centre = load(t.centre + v * LANES);
    for (int r = 0; r < kRows; ++r) {
      const Floats g = load(t.target + r * kStripStride + v * LANES);
      d[r] = load(t.image + r * kStripStride + v * LANES) - g;
      dd[r] = d[r] * d[r];
      dg[r] = d[r] * (g - centre);
    }
    vertical(d, window, t.blurred[0] + v * LANES);
    vertical(dd, window, t.blurred[1] + v * LANES);
    vertical(dg, window, t.blurred[2] + v * LANES);
  }
}

// The gradient is blur(plain) + 2 I blur(by_image) + (G - I) blur(by_difference).
struct Similarity {
  Floats loss, plain, by_image, by_difference;
};

GSS_INLINE Similarity similarity(const Window& window, const Scratch& t, int r, int j) {
  const int at = r * kStripStride + kPad + j;
  const Floats dm = horizontal(t.blurred[0] + at, window), p = dm * dm;
  const Floats q = horizontal(t.blurred[1] + at, window) - p;
  const Floats centre = load(t.centre + kPad + j);
  const Floats mean2 = load(t.mean + at), variance2 = load(t.variance + at);
  // Of d and the target. d is 0 outside the image, so the zero padding needs no correction for the centre here.
  const Floats covariance = horizontal(t.blurred[2] + at, window) - (mean2 - centre) * dm;
  const Floats mean1 = mean2 + dm;
  const Floats b2 = 2.0f * (variance2 + covariance) + q + kC2, a2 = b2 - q;
  const Floats a1 = 2.0f * mean1 * mean2 + kC1, b1 = a1 + p;
  const Floats inverse = reciprocal(b1 * b2);
  Similarity result;
  result.loss = (a1 * q + p * b2) * inverse;
  result.by_image = (result.loss * b1 - p) * inverse;
  result.by_difference = 2.0f * a1 * inverse;
  result.plain = 2.0f * inverse * (mean1 * (result.loss * b2 - q) - dm * a2) - 2.0f * mean1 * result.by_image +
                 dm * result.by_difference;
  return result;
}

void forward_pointwise(const PhotometricJob& job, const Strip& s, const Window& window, const Scratch& t, double* sums) {
  for (int r = 0; r < s.rows; ++r) {
    const std::ptrdiff_t map = static_cast<std::ptrdiff_t>(s.y0 + r) * job.map_stride + 3 * s.x0;
    Floats l1 = {}, dssim = {};
    for (int j = 0; j < s.floats; j += LANES) {
      Similarity f = similarity(window, t, r, j);
      const int at = (r + kReach) * kStripStride + kPad + j;
      const Floats difference = load(t.image + at) - load(t.target + at);
      Floats distance = max(difference, -difference);
      if (s.floats - j < LANES) {  // lanes right of the image: the maps must stay zero there
        const Mask mask = first_lanes(s.floats - j);
        f.loss = select_or_zero(mask, f.loss);
        f.plain = select_or_zero(mask, f.plain);
        f.by_image = select_or_zero(mask, f.by_image);
        f.by_difference = select_or_zero(mask, f.by_difference);
        distance = select_or_zero(mask, distance);
      }
      l1 += distance;
      dssim += f.loss;
      if (job.maps[0] == nullptr) continue;
      store(job.maps[0] + map + j, f.plain);
      store(job.maps[1] + map + j, f.by_image);
      store(job.maps[2] + map + j, f.by_difference);
    }
    sums[0] += static_cast<double>(sum(l1));
    sums[1] += static_cast<double>(sum(dssim));
  }
}

void backward_strip(const PhotometricJob& job, const Strip& s, bool active, const Window& window, Scratch& t) {
  for (int m = 0; m < 3; ++m) {
    const float* map = job.maps[m] + (s.y0 - kReach) * job.map_stride + 3 * s.x0 - kPad;
    for (int v = 0; v < s.vectors; ++v) {
      Floats x[kRows];
      for (int r = 0; r < kRows; ++r) x[r] = load(map + r * job.map_stride + v * LANES);
      vertical(x, window, t.blurred[m] + v * LANES);
    }
  }
  const float l1_scale = active ? job.l1_scale : 0.0f;
  const Floats zero = {}, plus = broadcast(l1_scale), minus = broadcast(-l1_scale);
  for (int r = 0; r < s.rows; ++r) {
    const std::ptrdiff_t pixel = (static_cast<std::ptrdiff_t>(s.y0 + r) * job.width + s.x0) * 3;
    for (int j = 0; j < s.floats; j += LANES) {
      const int at = r * kStripStride + kPad + j, left = s.floats - j;
      const Floats image = load_first(job.image + pixel + j, left);
      const Floats target = job.target.bytes ? load_first(job.target.bytes + pixel + j, left)
                                             : load_first(job.target.floats + pixel + j, left);
      const Floats plain = horizontal(t.blurred[0] + at, window);
      const Floats by_image = horizontal(t.blurred[1] + at, window);
      const Floats by_difference = horizontal(t.blurred[2] + at, window);
      const Floats similarity = plain + 2.0f * image * by_image + (target - image) * by_difference;
      const Floats sign = select(greater(image, target), plus, select(greater(target, image), minus, zero));
      store_first(job.gradient + pixel + j, job.ssim_scale * similarity + sign, left);
    }
  }
}

void zero_maps(const PhotometricJob& job, int tile_row, int tile) {
  for (int m = 0; m < 3; ++m)
    for (int r = 0; r < kTile; ++r)
      std::memset(job.maps[m] + (tile_row * kTile + r) * job.map_stride + 3 * kTile * tile, 0, sizeof(float) * 3 * kTile);
}

bool near_wanted(const PhotometricJob& job, int tile_row, int tile) {
  for (int y = tile_row - 1; y <= tile_row + 1; ++y)
    for (int x = tile - 1; x <= tile + 1; ++x)
      if (y >= 0 && y < job.tile_rows && x >= 0 && x < job.tile_columns && job.wanted[y * job.tile_columns + x]) return true;
  return false;
}

// Length of the run of tiles from `first` on which both masks stay as they are at `first`, at most kStripTiles.
int run_length(const PhotometricJob& job, const uint8_t* mask, int tile_row, int first) {
  const uint8_t *m = mask + tile_row * job.tile_columns, *active = job.active + tile_row * job.tile_columns;
  int end = first + 1;
  while (end < job.tile_columns && end - first < kStripTiles && !m[end] == !m[first] && !active[end] == !active[first]) ++end;
  return end - first;
}

// Codes of a mean in [0, 1] and of the root of a variance, which is at most 1 / 4 there. The root, because SSIM compares
// the variance with C2 = 9e-4: a step of 1 / 131,070 of the root changes their sum by at most 1 part in 5,000.
constexpr float kMeanCodes = 65535.0f, kRootCodes = 131070.0f;

// Visits the vectors of a tile, which is the i-th of the strip: fn(place in the strip's scratch, place of the mean in
// the statistics, that of the variance).
template <class Fn>
GSS_INLINE void for_tile(const PhotometricJob& job, const Strip& s, int tile, int i, Fn&& fn) {
  const std::size_t first =
      (static_cast<std::size_t>(s.y0 / kTile) * job.tile_columns + tile) * 2 * kTile * kTileFloats;
  const int floats = s.floats - i * kTileFloats < kTileFloats ? s.floats - i * kTileFloats : kTileFloats;
  for (int r = 0; r < s.rows; ++r)
    for (int j = 0; j < floats; j += LANES) {
      const std::size_t mean = first + static_cast<std::size_t>(r * kTileFloats + j);
      fn(r * kStripStride + kPad + i * kTileFloats + j, mean, mean + kTile * kTileFloats);
    }
}

void keep_statistics(const PhotometricJob& job, const Strip& s, int tile, int i, const Scratch& t) {
  float* floats = job.statistics.floats;
  uint16_t* codes = job.statistics.codes;
  for_tile(job, s, tile, i, [&](int at, std::size_t mean, std::size_t variance) {
    const Floats m = load(t.mean + at), v = load(t.variance + at);
    if (codes) {
      store(codes + mean, m * kMeanCodes);
      store(codes + variance, sqrt(max(v, Floats{})) * kRootCodes);
    } else {
      store(floats + mean, m);
      store(floats + variance, v);
    }
  });
}

void recall_statistics(const PhotometricJob& job, const Strip& s, int tile, int i, const Scratch& t) {
  const float* floats = job.statistics.floats;
  const uint16_t* codes = job.statistics.codes;
  for_tile(job, s, tile, i, [&](int at, std::size_t mean, std::size_t variance) {
    if (codes) {
      const Floats root = load(codes + variance) * (1.0f / kRootCodes);
      store(t.mean + at, load(codes + mean) * (1.0f / kMeanCodes));
      store(t.variance + at, root * root);
    } else {
      store(t.mean + at, load(floats + mean));
      store(t.variance + at, load(floats + variance));
    }
  });
}

// Makes the statistics of those strips from tile `first` to `end` of a row where they are not known.
void fill_statistics(const PhotometricJob& job, int tile_row, int first, int end, const Window& window, Scratch& t) {
  uint8_t* known = job.statistics.known + tile_row * strips_of(job.tile_columns);
  for (int strip = first / kStripTiles; strip * kStripTiles < end; ++strip) {
    if (known[strip]) continue;
    const int tile = strip * kStripTiles;
    const int tiles = job.tile_columns - tile < kStripTiles ? job.tile_columns - tile : kStripTiles;
    const Strip s = make_strip(job, tile_row, tile, tiles);
    load_target(job, s, t);
    target_statistics(job, s, window, t);
    for (int i = 0; i < tiles; ++i) keep_statistics(job, s, tile + i, i, t);
    known[strip] = 1;
  }
}

void forward_row(const PhotometricJob& job, int tile_row, float* scratch) {
  const Window window = load_window(job.window);
  Scratch t(scratch);
  for (int tile = 0, tiles; tile < job.tile_columns; tile += tiles) {
    if (!job.active[tile_row * job.tile_columns + tile]) {
      tiles = 1;
      if (job.maps[0] && near_wanted(job, tile_row, tile)) zero_maps(job, tile_row, tile);
      continue;
    }
    tiles = run_length(job, job.active, tile_row, tile);
    if (job.statistics.known) fill_statistics(job, tile_row, tile, tile + tiles, window, t);
    const Strip s = make_strip(job, tile_row, tile, tiles);
    load_target(job, s, t);
    load_strip(job, s, job.image, t.image);
    fill_outside(job, s, t.centre, t.image);
    blur_difference(s, window, t);
    if (job.statistics.known)
      for (int i = 0; i < tiles; ++i) recall_statistics(job, s, tile + i, i, t);
    else
      target_statistics(job, s, window, t);
    double* sums = job.partial + 2 * (tile_row * job.tile_columns + tile);
    forward_pointwise(job, s, window, t, sums);
  }
}

void backward_row(const PhotometricJob& job, int tile_row, float* scratch) {
  const Window window = load_window(job.window);
  Scratch t(scratch);
  for (int tile = 0, tiles; tile < job.tile_columns; tile += tiles) {
    tiles = run_length(job, job.wanted, tile_row, tile);
    const int index = tile_row * job.tile_columns + tile;
    if (job.wanted[index]) backward_strip(job, make_strip(job, tile_row, tile, tiles), job.active[index], window, t);
  }
}

}  // namespace

const PhotometricKernels& photometric_kernels() {
  static const PhotometricKernels table{forward_row, backward_row};
  return table;
}

}  // namespace gsstream_cpu::GSS_ISA
