// Stage 1: project Gaussians, find the tiles and blocks each one touches, evaluate the colour of those seen.
#include "raster/raster_kernels.hpp"
#include "raster/splats.hpp"

namespace gsstream_cpu::GSS_ISA {
namespace {

// Centres of the first pixel of each block, relative to the tile. Blocks are the lanes of touched_blocks.
struct BlockCorners {
  alignas(64) float x[BLOCKS], y[BLOCKS];
  constexpr BlockCorners() : x(), y() {
    for (int b = 0; b < BLOCKS; b++) {
      x[b] = static_cast<float>(b % BLOCKS_X * BLOCK_SIDE) + 0.5f;
      y[b] = static_cast<float>(b / BLOCKS_X * BLOCK_SIDE) + 0.5f;
    }
  }
};
constexpr BlockCorners CORNERS;
constexpr std::size_t PAIRS_UNCOUNTED = 1 << 14;  // of one chunk, before all threads hear of them

// Blocks of a tile where alpha reaches 1/255 somewhere on the rectangle spanned by the block's pixel centres. Exact:
// log2(alpha) is a concave quadratic, so its maximum over the rectangle lies at the centre of the Gaussian (if
// inside) or on one of the two edges facing it, where it is the clamped maximum of a parabola.
GSS_INLINE uint32_t touched_blocks(const Record& r, float tile_x, float tile_y, float x_of_y, float y_of_x) {
  uint32_t touched = 0;
  for (int first = 0; first < BLOCKS; first += LANES) {
    const Floats x0 = load(CORNERS.x + first) + (tile_x - r.x), y0 = load(CORNERS.y + first) + (tile_y - r.y);
    const Floats x1 = x0 + (BLOCK_SIDE - 1.0f), y1 = y0 + (BLOCK_SIDE - 1.0f);
    const Floats edge_x = clamp(Floats{}, x0, x1), edge_y = clamp(Floats{}, y0, y1);
    const Floats best_y = clamp(y_of_x * edge_x, y0, y1), best_x = clamp(x_of_y * edge_y, x0, x1);
    const Floats on_x = edge_x * (r.a * edge_x + r.b * best_y) + r.c * best_y * best_y;
    const Floats on_y = best_x * (r.a * best_x + r.b * edge_y) + r.c * edge_y * edge_y;
    touched |= bits_of(greater_equal(max(on_x, on_y), broadcast(LOG2_ALPHA_CUT - r.log2_opacity))) << first;
  }
  return touched;
}

// What a group of LANES Gaussians needs after projection, lane by lane.
struct Footprints {
  alignas(64) float x[LANES], y[LANES], a[LANES], b[LANES], c[LANES], log2_opacity[LANES], depth[LANES];
  alignas(64) int32_t tile_x0[LANES], tile_x1[LANES], tile_y0[LANES], tile_y1[LANES];
};

// Fills `f` and returns the lanes whose bounding box lies in front of the camera and touches the image.
GSS_INLINE uint32_t footprints(const ProjectJob& job, const Splats& s, Footprints& f) {
  const Camera& camera = job.camera;
  const Floats x = camera.fx * s.view[0] * s.inverse_z + camera.cx, y = camera.fy * s.view[1] * s.inverse_z + camera.cy;
  const Floats log2_opacity = log2(max(s.opacity, broadcast(1e-9f)));
  // alpha >= 1/255 exactly where the Mahalanobis distance^2 is at most `reach`; its bounding box follows from xx, yy.
  const Floats reach = 2 * LN_2 * max(log2_opacity - LOG2_ALPHA_CUT, Floats{});
  const Floats extent_x = sqrt(reach * s.xx), extent_y = sqrt(reach * s.yy);
  store(f.x, x);
  store(f.y, y);
  store(f.a, -0.5f * LOG2_E * s.yy * s.inverse_det);
  store(f.b, LOG2_E * s.xy * s.inverse_det);
  store(f.c, -0.5f * LOG2_E * s.xx * s.inverse_det);
  store(f.log2_opacity, log2_opacity);
  store(f.depth, s.view[2]);
  // Limited as floats: a huge Gaussian's box overflows an int.
  const float last_x = static_cast<float>(job.tiles_x - 1), last_y = static_cast<float>(job.tiles_y - 1);
  const auto tile_index = [](Floats pixel, float per_pixel, float last) {
    return __builtin_convertvector(clamp(pixel * per_pixel, Floats{}, broadcast(last)), Ints);
  };
  store(f.tile_x0, tile_index(x - extent_x, 1.0f / TILE_WIDTH, last_x));
  store(f.tile_x1, tile_index(x + extent_x, 1.0f / TILE_WIDTH, last_x));
  store(f.tile_y0, tile_index(y - extent_y, 1.0f / TILE_HEIGHT, last_y));
  store(f.tile_y1, tile_index(y + extent_y, 1.0f / TILE_HEIGHT, last_y));
  Mask seen = both(greater(s.view[2], broadcast(camera.near)), greater(log2_opacity, broadcast(LOG2_ALPHA_CUT)));
  seen = both(seen, both(greater(x + extent_x, Floats{}), greater(y + extent_y, Floats{})));
  seen = both(seen, greater(broadcast(static_cast<float>(camera.width)), x - extent_x));
  seen = both(seen, greater(broadcast(static_cast<float>(camera.height)), y - extent_y));
  return bits_of(seen);
}

GSS_INLINE bool touches_active_tile(const ProjectJob& job, const Footprints& f, int lane) {
  const int stride = job.tiles_x + 1;
  const int32_t *top = job.active_sum + f.tile_y0[lane] * stride,
                *bottom = job.active_sum + (f.tile_y1[lane] + 1) * stride;
  const int left = f.tile_x0[lane], right = f.tile_x1[lane] + 1;
  return bottom[right] - bottom[left] - top[right] + top[left] > 0;
}

// Appends the pairs of one Gaussian; returns how many.
GSS_INLINE uint32_t emit_pairs(const ProjectJob& job, const Footprints& f, int lane, const Record& r, PairList& pairs) {
  const int x0 = f.tile_x0[lane], x1 = f.tile_x1[lane], y0 = f.tile_y0[lane], y1 = f.tile_y1[lane];
  const std::size_t most = static_cast<std::size_t>(x1 - x0 + 1) * static_cast<std::size_t>(y1 - y0 + 1);
  if (pairs.size + most > pairs.capacity) pairs.reserve_more(most);
  const float x_of_y = -0.5f * r.b / r.a, y_of_x = -0.5f * r.b / r.c;
  Pair* const first = pairs.data + pairs.size;
  Pair* next = first;
  for (int ty = y0; ty <= y1; ty++)
    for (int tx = x0; tx <= x1; tx++) {
      const uint32_t tile = static_cast<uint32_t>(ty * job.tiles_x + tx);
      const uint32_t wanted = job.tile_blocks[tile];
      if (!wanted) continue;
      const uint32_t blocks = wanted & touched_blocks(r, static_cast<float>(tx * TILE_WIDTH),
                                                      static_cast<float>(ty * TILE_HEIGHT), x_of_y, y_of_x);
      if (blocks) *next++ = {tile, blocks};
    }
  pairs.size += static_cast<std::size_t>(next - first);
  return static_cast<uint32_t>(next - first);
}

// Writes the records of the candidate lanes that touch a wanted block; returns those lanes.
GSS_INLINE uint32_t emit_group(const ProjectJob& job, const Footprints& f, const uint32_t* rows, uint32_t candidates,
                               ProjectChunk& chunk) {
  uint32_t visible = 0;
  for (; candidates; candidates &= candidates - 1) {
    const int lane = __builtin_ctz(candidates);
    if (!touches_active_tile(job, f, lane)) continue;
    Record& r = job.records[rows[lane]];
    r.x = f.x[lane];
    r.y = f.y[lane];
    r.a = f.a[lane];
    r.b = f.b[lane];
    r.c = f.c[lane];
    r.log2_opacity = f.log2_opacity[lane];
    r.depth = f.depth[lane];
    r.tile_x0 = static_cast<uint16_t>(f.tile_x0[lane]);
    r.tile_y0 = static_cast<uint16_t>(f.tile_y0[lane]);
    r.tile_x1 = static_cast<uint16_t>(f.tile_x1[lane]);
    r.tile_y1 = static_cast<uint16_t>(f.tile_y1[lane]);
    const uint32_t pairs = emit_pairs(job, f, lane, r, chunk.pairs);
    if (!pairs) continue;
    visible |= 1u << lane;
    const uint32_t slot = chunk.visible++;
    chunk.row[slot] = rows[lane];
    std::memcpy(&chunk.depth_bits[slot], &r.depth, sizeof r.depth);  // positive floats order like their bits
    chunk.pair_count[slot] = pairs;
  }
  return visible;
}

template <int K>
GSS_INLINE void color_group(const ProjectJob& job, const uint32_t* rows, uint32_t visible, Splats& s,
                            ProjectChunk& chunk) {
  Harmonics<K> sh;
  Floats color[3];
  view_direction(job.camera, s);
  evaluate_color<K>(job.gaussians, rows, s, sh, color);
  alignas(64) float channels[3][LANES];
  Ints largest{};
  for (int c = 0; c < 3; c++) {
    largest = largest_magnitude(largest, color[c]);
    store(channels[c], max(color[c], Floats{}));
  }
  if (visible & ~bits_of(is_finite(largest))) chunk.faults |= FAULT_NOT_FINITE;
  for (; visible; visible &= visible - 1) {
    const int lane = __builtin_ctz(visible);
    for (int c = 0; c < 3; c++) job.records[rows[lane]].color[c] = channels[c][lane];
  }
}

GSS_INLINE uint32_t faults_of(const Splats& s, uint32_t lanes) {
  uint32_t faults = 0;
  if (lanes & ~bits_of(is_finite(s.largest))) faults |= FAULT_NOT_FINITE;
  const Mask usable =
      both(greater(s.quat_norm2, broadcast(QUAT_NORM2_MIN)), greater(broadcast(QUAT_NORM2_MAX), s.quat_norm2));
  if (lanes & ~bits_of(usable)) faults |= FAULT_QUATERNION;
  return faults;
}

// Whether the pairs of all chunks are still within the limit; adds those of this chunk that are not counted yet.
GSS_INLINE bool within_limit(const ProjectJob& job, std::size_t fresh) {
  return __atomic_add_fetch(job.pair_count, fresh, __ATOMIC_RELAXED) <= job.most_pairs;
}

template <int K>
void project_chunk(const ProjectJob& job, std::size_t first, std::size_t end, ProjectChunk& chunk) {
  chunk.visible = 0;
  chunk.faults = 0;
  chunk.pairs.size = 0;
  std::size_t counted = 0;
  if (!within_limit(job, 0)) {
    chunk.faults |= FAULT_PAIRS;
    return;
  }
  for (std::size_t i = first; i < end; i += LANES) {
    const int valid = static_cast<int>(end - i < LANES ? end - i : LANES);
    const uint32_t lanes = (1u << valid) - 1;
    alignas(64) uint32_t rows[LANES];
    for (int lane = 0; lane < LANES; lane++) rows[lane] = static_cast<uint32_t>(i) + (lane < valid ? lane : 0);
    Splats s;
    Footprints f;
    load_and_activate(job.gaussians, rows, s);
    chunk.faults |= faults_of(s, lanes);
    to_view_space(job.camera, s);
    covariance_2d(job.camera, s);
    const uint32_t candidates = lanes & footprints(job, s, f);
    const uint32_t visible = emit_group(job, f, rows, candidates, chunk);
    if (visible) color_group<K>(job, rows, visible, s, chunk);
    const std::size_t fresh = chunk.pairs.size - counted;
    if (fresh < PAIRS_UNCOUNTED && i + LANES < end) continue;
    counted = chunk.pairs.size;
    if (!within_limit(job, fresh)) {
      chunk.faults |= FAULT_PAIRS;
      return;
    }
  }
}

template <int K>
void project(const ProjectJob& job, std::size_t first_chunk, std::size_t end_chunk) {
  for (std::size_t c = first_chunk; c < end_chunk; c++) {
    const std::size_t first = c * PROJECT_CHUNK, end = first + PROJECT_CHUNK;
    project_chunk<K>(job, first, end < job.count ? end : job.count, job.chunks[c]);
  }
}

}  // namespace

const ProjectKernels& project_kernels() {
  static const ProjectKernels table{{project<1>, project<4>, project<9>, project<16>}};
  return table;
}

}  // namespace gsstream_cpu::GSS_ISA
