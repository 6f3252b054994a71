// Stages 3 and 4: blend the depth-sorted entries of each tile front to back, and differentiate back to front.
//
// A tile's pixels live on the stack as 4x4 blocks. Forward and backward evaluate log2(alpha) by the same inline
// function: backward has to find exactly the contributors that forward counted.
#include "raster/moments.hpp"
#include "raster/pixel_blocks.hpp"
#include "raster/pixel_exponent.hpp"
#include "raster/raster_kernels.hpp"
#include "runtime/simd.hpp"

namespace gsstream_cpu::GSS_ISA {
namespace {

constexpr int PARTS = BLOCK_PIXELS / LANES;  // vectors per block
constexpr int PREFETCH = 8;                  // entries ahead

// Light from behind all entries of a list, at pixels of this transmittance. Those that take no more light see the
// background alone, as if every entry were in the list.
struct Behind {
  Floats red, green, blue;
  GSS_INLINE Behind(const CompositeJob& job, uint32_t tile, int b, int q, Floats transmittance)
      : red(broadcast(job.background[0])),
        green(broadcast(job.background[1])),
        blue(broadcast(job.background[2])) {
    if (!job.layers) return;
    const LayerPixels& layers = *job.layers[tile];
    const Mask live = greater(transmittance, broadcast(TRANSMITTANCE_MIN));
    red = select(live, load(layers.back[0][b] + q), red);
    green = select(live, load(layers.back[1][b] + q), green);
    blue = select(live, load(layers.back[2][b] + q), blue);
  }
};

// ---- forward

struct ForwardTile {
  alignas(64) float transmittance[BLOCKS][BLOCK_PIXELS], red[BLOCKS][BLOCK_PIXELS], green[BLOCKS][BLOCK_PIXELS],
      blue[BLOCKS][BLOCK_PIXELS];
  alignas(64) int32_t last[BLOCKS][BLOCK_PIXELS];
  Mask live[BLOCKS][PARTS];  // pixels that still take light
};

GSS_INLINE void start_tile(ForwardTile& tile, uint32_t blocks) {
  for (; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    for (int q = 0; q < BLOCK_PIXELS; q += LANES) {
      store(tile.transmittance[b] + q, broadcast(1.0f));
      store(tile.red[b] + q, Floats{});
      store(tile.green[b] + q, Floats{});
      store(tile.blue[b] + q, Floats{});
      store(tile.last[b] + q, broadcast(INT32_MAX));
      tile.live[b][q / LANES] = greater(broadcast(1.0f), Floats{});
    }
  }
}

// Starts from what lies in front. Returns the blocks in which some pixel still takes light.
GSS_INLINE uint32_t start_behind(ForwardTile& tile, uint32_t blocks, const LayerPixels& layers) {
  uint32_t alive = 0;
  for (; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    for (int q = 0; q < BLOCK_PIXELS; q += LANES) {
      const Floats transmittance = load(layers.transmittance[b] + q);
      const Mask live = greater(transmittance, broadcast(TRANSMITTANCE_MIN));
      store(tile.transmittance[b] + q, transmittance);
      store(tile.red[b] + q, load(layers.front[0][b] + q));
      store(tile.green[b] + q, load(layers.front[1][b] + q));
      store(tile.blue[b] + q, load(layers.front[2][b] + q));
      store(tile.last[b] + q, select(live, broadcast(INT32_MAX), Ints{}));
      tile.live[b][q / LANES] = live;
      if (any(live)) alive |= 1u << b;
    }
  }
  return alive;
}

// Retires the pixels whose transmittance fell to the minimum; true if none of the block is left.
GSS_INLINE bool retire_pixels(ForwardTile& tile, int b, int part, Mask dead, Mask survivors, int32_t next_entry) {
  int32_t* last = tile.last[b] + part * LANES;
  store(last, select(dead, broadcast(next_entry), load(last)));
  tile.live[b][part] = survivors;
  for (int p = 0; p < PARTS; p++)
    if (any(tile.live[b][p])) return false;
  return true;
}

// Blends one entry into the given blocks. Returns the blocks it added light to; removes finished blocks from `alive`.
GSS_INLINE uint32_t blend_entry(ForwardTile& tile, const Kernel& k, uint32_t blocks, int32_t next_entry,
                                uint32_t& alive) {
  uint32_t contributed = 0;
  for (; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    for (int part = 0; part < PARTS; part++) {
      const int q = part * LANES;
      const Exponent e = exponent_at(k, b, q);
      const Mask live = tile.live[b][part];
      const Mask counted = both(greater_equal(e.log2_alpha, broadcast(LOG2_ALPHA_CUT)), live);
      if (!any(counted)) continue;
      contributed |= 1u << b;
      const Floats before = load(tile.transmittance[b] + q);
      const Floats alpha = select_or_zero(counted, min(exp2(e.log2_alpha), broadcast(ALPHA_MAX)));
      const Floats weight = alpha * before, after = before - weight;
      store(tile.transmittance[b] + q, after);
      store(tile.red[b] + q, load(tile.red[b] + q) + weight * k.red);
      store(tile.green[b] + q, load(tile.green[b] + q) + weight * k.green);
      store(tile.blue[b] + q, load(tile.blue[b] + q) + weight * k.blue);
      const Mask dead = both(greater_equal(broadcast(TRANSMITTANCE_MIN), after), live);
      if (__builtin_expect(any(dead), 0))
        if (retire_pixels(tile, b, part, dead, both(live, greater(after, broadcast(TRANSMITTANCE_MIN))), next_entry))
          alive &= ~(1u << b);
    }
  }
  return contributed;
}

// Depth-sorted entries with the blocks that each touches.
struct Entries {
  const TileEntry* entries;
  const uint32_t* blocks;
  uint32_t* contributed;
  uint32_t count;
  uint32_t kept;  // blocks of which `contributed` stays as it is
};

// Not inlined: the same instructions, so the same bits, wherever a Gaussian is blended.
__attribute__((noinline)) void blend(ForwardTile& tile, const Record* records, const Entries& list, uint32_t alive,
                                     float x, float y) {
  uint32_t k = 0;
  for (; k < list.count && alive; k++) {
    if (k + PREFETCH < list.count) __builtin_prefetch(&records[list.entries[k + PREFETCH].record]);
    const uint32_t wanted = list.blocks[k] & alive;
    list.contributed[k] &= list.kept;
    if (!wanted) continue;
    const Kernel kernel(records[list.entries[k].record], x, y);
    list.contributed[k] |= blend_entry(tile, kernel, wanted, static_cast<int32_t>(k) + 1, alive);
  }
  for (; k < list.count; k++) list.contributed[k] &= list.kept;
}

GSS_INLINE void finish_tile(const CompositeJob& job, ForwardTile& tile, uint32_t index, int tile_x, int tile_y) {
  const std::size_t pixels = static_cast<std::size_t>(index) * BLOCKS * BLOCK_PIXELS;
  float* kept_transmittance = job.pixel_transmittance + pixels;
  int32_t* kept_last = job.pixel_last + pixels;
  for (uint32_t blocks = job.tile_blocks[index]; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    for (int q = 0; q < BLOCK_PIXELS; q += LANES) {
      const Floats t = load(tile.transmittance[b] + q);
      const Behind behind(job, index, b, q, t);
      store(kept_transmittance + b * BLOCK_PIXELS + q, t);
      store(kept_last + b * BLOCK_PIXELS + q, load(tile.last[b] + q));
      store(tile.red[b] + q, load(tile.red[b] + q) + t * behind.red);
      store(tile.green[b] + q, load(tile.green[b] + q) + t * behind.green);
      store(tile.blue[b] + q, load(tile.blue[b] + q) + t * behind.blue);
    }
    const BlockPlace place = place_of(b, tile_x, tile_y, job.width, job.height);
    write_rgb(place, tile.red[b], tile.green[b], tile.blue[b], job.image);
    if (job.transmittance) write_scalar(place, tile.transmittance[b], job.transmittance);
  }
}

void forward(const CompositeJob& job, std::size_t first_tile, std::size_t end_tile) {
  ForwardTile tile;
  for (std::size_t slot = first_tile; slot < end_tile; slot++) {
    const uint32_t index = job.tiles[slot], first = job.lists.begin[index];
    const int x = static_cast<int>(index) % job.tiles_x * TILE_WIDTH,
              y = static_cast<int>(index) / job.tiles_x * TILE_HEIGHT;
    const Entries list{job.lists.entries + first, job.lists.blocks + first, job.contributed + first,
                       job.lists.end[index] - first, job.keeps ? ~job.tile_blocks[index] : 0};
    uint32_t alive = job.tile_blocks[index];
    if (job.layers)
      alive = start_behind(tile, alive, *job.layers[index]);
    else
      start_tile(tile, alive);
    blend(tile, job.records, list, alive, static_cast<float>(x), static_cast<float>(y));
    finish_tile(job, tile, index, x, y);
  }
}

// ---- layers

GSS_INLINE void blend_layer(const LayerJob& job, ForwardTile& tile, uint32_t alive) {
  const Entries list{job.entries, job.blocks, job.contributed, static_cast<uint32_t>(job.count), 0};
  blend(tile, job.records, list, alive, static_cast<float>(job.x), static_cast<float>(job.y));
}

void extend_front(const LayerJob& job) {
  ForwardTile tile;
  LayerPixels& layers = *job.pixels;
  blend_layer(job, tile, start_behind(tile, job.wanted, layers));
  for (uint32_t blocks = job.wanted; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    for (int q = 0; q < BLOCK_PIXELS; q += LANES) {
      store(layers.transmittance[b] + q, load(tile.transmittance[b] + q));
      store(layers.front[0][b] + q, load(tile.red[b] + q));
      store(layers.front[1][b] + q, load(tile.green[b] + q));
      store(layers.front[2][b] + q, load(tile.blue[b] + q));
    }
  }
}

// A block that takes no light behind its front layer needs nothing behind it.
GSS_INLINE uint32_t open_blocks(const LayerPixels& layers, uint32_t wanted) {
  uint32_t open = 0;
  for (uint32_t blocks = wanted; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    for (int q = 0; q < BLOCK_PIXELS; q += LANES)
      if (any(greater(load(layers.transmittance[b] + q), broadcast(TRANSMITTANCE_MIN)))) open |= 1u << b;
  }
  return open;
}

void extend_back(const LayerJob& job) {
  ForwardTile tile;
  LayerPixels& layers = *job.pixels;
  const uint32_t open = open_blocks(layers, job.wanted);
  start_tile(tile, open);
  blend_layer(job, tile, open);
  for (uint32_t blocks = open; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    for (int q = 0; q < BLOCK_PIXELS; q += LANES) {
      const Floats t = load(tile.transmittance[b] + q);
      store(layers.back[0][b] + q, load(tile.red[b] + q) + t * load(layers.back[0][b] + q));
      store(layers.back[1][b] + q, load(tile.green[b] + q) + t * load(layers.back[1][b] + q));
      store(layers.back[2][b] + q, load(tile.blue[b] + q) + t * load(layers.back[2][b] + q));
    }
  }
}

// ---- backward

struct BackwardTile {
  alignas(64) float transmittance[BLOCKS][BLOCK_PIXELS];  // after the entry being visited
  alignas(64) float behind[BLOCKS][BLOCK_PIXELS];         // dL/d(colour) . (light from behind the entry)
  alignas(64) float red[BLOCKS][BLOCK_PIXELS], green[BLOCKS][BLOCK_PIXELS], blue[BLOCKS][BLOCK_PIXELS];  // dL/d(colour)
  alignas(64) int32_t last[BLOCKS][BLOCK_PIXELS];
};

// False if the upstream gradient is zero all over the tile (NaN is not zero).
GSS_INLINE bool start_backward_tile(const CompositeBackwardJob& job, BackwardTile& tile, uint32_t index, int tile_x,
                                    int tile_y) {
  const CompositeJob& fwd = job.forward;
  const std::size_t pixels = static_cast<std::size_t>(index) * BLOCKS * BLOCK_PIXELS;
  const float* kept_transmittance = fwd.pixel_transmittance + pixels;
  const int32_t* kept_last = fwd.pixel_last + pixels;
  Ints magnitude{};
  for (uint32_t blocks = fwd.tile_blocks[index]; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    const BlockPlace place = place_of(b, tile_x, tile_y, fwd.width, fwd.height);
    alignas(64) float alpha_gradient[BLOCK_PIXELS] = {};
    read_rgb(place, job.image_gradient, tile.red[b], tile.green[b], tile.blue[b]);
    if (job.alpha_gradient) read_scalar(place, job.alpha_gradient, alpha_gradient);
    for (int q = 0; q < BLOCK_PIXELS; q += LANES) {
      const Floats t = load(kept_transmittance + b * BLOCK_PIXELS + q), from_alpha = load(alpha_gradient + q);
      magnitude |=
          (Ints)load(tile.red[b] + q) | (Ints)load(tile.green[b] + q) | (Ints)load(tile.blue[b] + q) | (Ints)from_alpha;
      const Behind behind(fwd, index, b, q, t);
      const Floats seen = behind.red * load(tile.red[b] + q) + behind.green * load(tile.green[b] + q) +
                          behind.blue * load(tile.blue[b] + q);
      store(tile.transmittance[b] + q, t);
      store(tile.behind[b] + q, t * (seen - from_alpha));  // alpha = 1 - transmittance
      store(tile.last[b] + q, load(kept_last + b * BLOCK_PIXELS + q));
    }
  }
  return any(greater_equal(magnitude & INT32_MAX, broadcast(1)));
}

// Undoes one entry in LANES pixels of one block: transmittance and light behind become those before the entry.
// False if none of these pixels counted it.
struct Undone {
  Exponent at;
  Floats raw_alpha, alpha, weight, alpha_gradient;
};
GSS_INLINE bool undo_entry(BackwardTile& tile, const Kernel& k, int b, int q, int32_t next_entry, Undone& u) {
  u.at = exponent_at(k, b, q);
  const Mask counted = both(greater_equal(u.at.log2_alpha, broadcast(LOG2_ALPHA_CUT)),
                            greater_equal(load(tile.last[b] + q), broadcast(next_entry)));
  if (PARTS > 1 && !any(counted)) return false;  // a block of one vector is known to contribute
  u.raw_alpha = exp2(u.at.log2_alpha);
  u.alpha = select_or_zero(counted, min(u.raw_alpha, broadcast(ALPHA_MAX)));
  const Floats restore = reciprocal(1.0f - u.alpha);
  const Floats before = load(tile.transmittance[b] + q) * restore, behind = load(tile.behind[b] + q);
  const Floats shine =
      k.red * load(tile.red[b] + q) + k.green * load(tile.green[b] + q) + k.blue * load(tile.blue[b] + q);
  u.weight = u.alpha * before;
  u.alpha_gradient = before * shine - behind * restore;
  store(tile.transmittance[b] + q, before);
  store(tile.behind[b] + q, behind + u.weight * shine);
  return true;
}

GSS_INLINE void differentiate_entry(BackwardTile& tile, const Kernel& k, uint32_t blocks, int32_t next_entry,
                                    float* out) {
  Floats m[MOMENTS] = {};
  for (; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    for (int q = 0; q < BLOCK_PIXELS; q += LANES) {
      Undone u;
      if (!undo_entry(tile, k, b, q, next_entry, u)) continue;
      // Where alpha was clamped it no longer depends on the parameters.
      const Floats g = select_or_zero(greater(broadcast(ALPHA_MAX), u.raw_alpha), u.alpha_gradient * u.alpha);
      const Floats gx = g * u.at.dx, gy = g * u.at.dy;
      m[0] += g;
      m[1] += gx;
      m[2] += gy;
      m[3] += gx * u.at.dx;
      m[4] += gx * u.at.dy;
      m[5] += gy * u.at.dy;
      m[6] += u.weight * load(tile.red[b] + q);
      m[7] += u.weight * load(tile.green[b] + q);
      m[8] += u.weight * load(tile.blue[b] + q);
    }
  }
  store_moments(m, out);
}

GSS_INLINE void roll_back_entry(BackwardTile& tile, const Kernel& k, uint32_t blocks, int32_t next_entry) {
  for (; blocks; blocks &= blocks - 1) {
    const int b = __builtin_ctz(blocks);
    for (int q = 0; q < BLOCK_PIXELS; q += LANES) {
      Undone unused;
      undo_entry(tile, k, b, q, next_entry, unused);
    }
  }
}

// Entries in front of the first one that wants a gradient need no visit. Returns the index of that entry (or the
// number of entries) and clears the moments of the pairs before it.
GSS_INLINE uint32_t first_wanted(const CompositeBackwardJob& job, uint32_t first, uint32_t count, uint32_t wanted) {
  for (uint32_t k = 0; k < count; k++) {
    const uint32_t pair = job.forward.lists.entries[first + k].pair;
    if (pair == FROZEN) continue;
    if (job.forward.contributed[first + k] & wanted) return k;
    std::memset(job.moments + static_cast<std::size_t>(pair) * MOMENT_STRIDE, 0, MOMENT_STRIDE * sizeof(float));
  }
  return count;
}

GSS_INLINE void differentiate_tile(const CompositeBackwardJob& job, BackwardTile& tile, std::size_t slot) {
  const CompositeJob& fwd = job.forward;
  const uint32_t index = fwd.tiles[slot], first = fwd.lists.begin[index], count = fwd.lists.end[index] - first;
  const int x = static_cast<int>(index) % fwd.tiles_x * TILE_WIDTH,
            y = static_cast<int>(index) / fwd.tiles_x * TILE_HEIGHT;
  const TileEntry* entries = fwd.lists.entries + first;
  // Forward may have drawn more blocks than are differentiated.
  const uint32_t wanted = start_backward_tile(job, tile, index, x, y) ? fwd.tile_blocks[index] : 0;
  const int32_t front = static_cast<int32_t>(first_wanted(job, first, count, wanted));
  for (int32_t k = static_cast<int32_t>(count) - 1; k >= front; k--) {
    if (k >= PREFETCH) __builtin_prefetch(&fwd.records[entries[k - PREFETCH].record]);
    const uint32_t blocks = fwd.contributed[first + k] & wanted, pair = entries[k].pair;
    float* moments = job.moments + static_cast<std::size_t>(pair) * MOMENT_STRIDE;
    if (!blocks) {
      if (pair != FROZEN) std::memset(moments, 0, MOMENT_STRIDE * sizeof(float));
      continue;
    }
    const Kernel kernel(fwd.records[entries[k].record], static_cast<float>(x), static_cast<float>(y));
    if (pair == FROZEN)
      roll_back_entry(tile, kernel, blocks, k + 1);
    else
      differentiate_entry(tile, kernel, blocks, k + 1, moments);
  }
}

void backward(const CompositeBackwardJob& job, std::size_t first_tile, std::size_t end_tile) {
  BackwardTile tile;
  for (std::size_t slot = first_tile; slot < end_tile; slot++) differentiate_tile(job, tile, slot);
}

}  // namespace

const CompositeKernels& composite_kernels() {
  static const CompositeKernels table{forward, backward, extend_front, extend_back};
  return table;
}

}  // namespace gsstream_cpu::GSS_ISA
