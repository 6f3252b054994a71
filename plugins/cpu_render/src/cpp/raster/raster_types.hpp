// What the stages of the rasteriser hand to one another. Plain data, shared by all instruction sets.
#pragma once
#include <cstddef>
#include <cstdint>

namespace gsstream_cpu {

// An image is cut into raster tiles; a raster tile into 4x4-pixel blocks of 16 lanes (one AVX-512 vector). The mask
// that callers give is finer than the raster tile (16x16): its cells become sets of blocks.
constexpr int TILE_WIDTH = 32, TILE_HEIGHT = 16;
constexpr int BLOCK_SIDE = 4, BLOCK_PIXELS = 16;
constexpr int BLOCKS_X = TILE_WIDTH / BLOCK_SIDE, BLOCKS_Y = TILE_HEIGHT / BLOCK_SIDE;
constexpr int BLOCKS = BLOCKS_X * BLOCKS_Y;
constexpr int MASK_TILE = 16;
static_assert(BLOCKS == 32, "a set of blocks is one uint32_t");

constexpr float BLUR = 0.3f;  // pixels^2 added to the 2-D covariance (3DGS)
constexpr float ALPHA_MAX = 0.999f;
constexpr float TRANSMITTANCE_MIN = 1e-4f;      // a Gaussian counts iff the transmittance before it is above this
constexpr float LOG2_ALPHA_CUT = -7.99435344f;  // log2(1/255)
constexpr float LOG2_E = 1.44269504f, LN_2 = 0.69314718f;
constexpr float LOG2_SCALE_LIMIT = 30.0f;  // scales are kept within 2^-30..2^30 so that covariances stay finite
constexpr float QUAT_NORM2_MIN = 1e-20f, QUAT_NORM2_MAX = 1e20f;

struct Camera {
  float rotation[9], translation[3];   // world to camera, OpenCV axes
  float position[3];                   // camera centre in the world
  float fx, fy, cx, cy;                // pixels, origin at the image corner
  float near;                          // scene units; Gaussians with depth <= near are not drawn
  float x_low, x_high, y_low, y_high;  // limits of x/z and y/z inside the Jacobian (1.3 times the field of view)
  int width, height;
};

// Raw parameters, row-major: means [N,3], quats [N,4] wxyz, log scales [N,3], logit opacities [N], sh0 [N,3], shN
// [N,3(K-1)].
struct GaussianArrays {
  const float *means, *quats, *scales, *opacities, *sh0, *shN;
};
struct GradientArrays {
  float *means, *quats, *scales, *opacities, *sh0, *shN;
  float* means2d;  // [N,2], pixels
};

// A projected Gaussian, one cache line. log2(alpha) at offset (dx, dy) from its centre is
// log2_opacity + a dx^2 + b dx dy + c dy^2.
struct alignas(64) Record {
  float x, y, a, b, c, log2_opacity;
  float color[3];
  float depth;
  uint16_t tile_x0, tile_y0, tile_x1, tile_y1;  // raster tiles that it may touch lie in this box, ends included
  float padding[4];
};

// "This Gaussian touches these blocks of that tile."
struct Pair {
  uint32_t tile, blocks;
};

// Growable list of pairs; grown by common code, because kernel files use no containers.
struct PairList {
  Pair* data = nullptr;
  std::size_t size = 0, capacity = 0;
  PairList() = default;
  PairList(const PairList&) = delete;
  PairList& operator=(const PairList&) = delete;
  ~PairList();
  void reserve_more(std::size_t extra);
};

// FAULT_PAIRS: more pairs than the caller allows; the projection stops where they are too many.
enum Fault : uint32_t { FAULT_NOT_FINITE = 1, FAULT_QUATERNION = 2, FAULT_PAIRS = 4 };

// Result of projecting PROJECT_CHUNK consecutive rows.
constexpr std::size_t PROJECT_CHUNK = 256;
struct ProjectChunk {
  uint32_t visible = 0;
  uint32_t faults = 0;  // Fault bits
  uint32_t row[PROJECT_CHUNK], depth_bits[PROJECT_CHUNK], pair_count[PROJECT_CHUNK];
  PairList pairs;
};

struct ProjectJob {
  GaussianArrays gaussians;
  std::size_t count;
  Camera camera;
  int tiles_x, tiles_y;
  const uint32_t* tile_blocks;  // [tiles] blocks wanted in each tile
  const int32_t* active_sum;    // [(tiles_y+1)*(tiles_x+1)] summed-area table of tile_blocks != 0
  Record* records;              // [count], written where visible
  ProjectChunk* chunks;
  std::size_t most_pairs;   // of all chunks
  std::size_t* pair_count;  // of all chunks so far; all threads add to it
};

constexpr uint32_t FROZEN = ~0u;
struct TileEntry {
  uint32_t record;
  uint32_t pair;  // where its moments go, or FROZEN: no gradient wanted
};

// Depth-sorted entries of every tile: those of tile t are [begin[t], end[t]).
struct TileListsView {
  const uint32_t *begin, *end;
  const TileEntry* entries;
  const uint32_t* blocks;
};

// What the pixels of a raster tile see in front of and behind the entries of its list, in block order: light and
// transmittance of what lies in front, light of what lies behind, the background included.
struct LayerPixels {
  alignas(64) float transmittance[BLOCKS][BLOCK_PIXELS], front[3][BLOCKS][BLOCK_PIXELS], back[3][BLOCKS][BLOCK_PIXELS];
};

// Blends entries in front of all that a layer holds (back) or behind it (front).
struct LayerJob {
  const Record* records;
  int x, y;  // pixel at which the tile begins
  const TileEntry* entries;
  const uint32_t* blocks;
  std::size_t count;
  uint32_t* contributed;  // [count], scratch
  uint32_t wanted;        // blocks that are changed
  LayerPixels* pixels;
};

struct CompositeJob {
  const Record* records;
  TileListsView lists;
  const uint32_t* tiles;        // active tiles
  const uint32_t* tile_blocks;  // [tiles of the image]
  int tiles_x, width, height;
  float background[3];
  float *image, *transmittance;  // caller's [H,W,3] and [H,W]; only active blocks are written
  const LayerPixels* const* layers;  // by tile of the image; null: nothing in front, and the background behind
  uint32_t* contributed;         // per entry: the blocks where it added light; backward visits only these
  bool keeps;                    // what `contributed` says of blocks that are not rendered stays; else it is cleared
  float* pixel_transmittance;    // per tile of the image, block order: final transmittance
  int32_t* pixel_last;           // per tile of the image, block order: entries from this index on were not counted
};

struct CompositeBackwardJob {
  CompositeJob forward;
  const float *image_gradient, *alpha_gradient;  // [H,W,3]; [H,W] or null
  float* moments;                                // [pairs, MOMENT_STRIDE]
};

// Per pair the compositor leaves nine sums over pixels of g = dL/d(log alpha) and w = alpha * transmittance:
// g, g dx, g dy, g dx^2, g dx dy, g dy^2, w dL/dR, w dL/dG, w dL/dB. All gradients are linear in them.
constexpr int MOMENTS = 9, MOMENT_STRIDE = 16;

struct ProjectBackwardJob {
  GaussianArrays gaussians;
  Camera camera;
  std::size_t visible;
  const uint32_t* rows;         // [visible] row of each visible Gaussian
  const uint32_t* pair_offset;  // [visible+1]
  const float* moments;
  GradientArrays out;  // means null: only means2d is wanted
  bool compact;        // write row i of the output for visible Gaussian i, instead of row rows[i]
};

}  // namespace gsstream_cpu
