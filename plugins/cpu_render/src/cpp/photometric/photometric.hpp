// Photometric loss and its gradient: (1 - w) mean|I - G| + w mean(1 - SSIM), SSIM with the 11x11 Gaussian window of
// sigma 1.5 and zero padding (the convention of 3DGS), over interleaved [H, W, 3] float images, on a mask of tiles.
#pragma once
#include <cstddef>
#include <cstdint>

#include "runtime/isa.hpp"

namespace gsstream_cpu {

constexpr int kTile = 16;          // pixels of a tile's side
constexpr int kReach = 5;          // the window covers -5..5
constexpr int kStripTiles = 8;     // longest run of tiles processed at once: its buffers stay in the L2 cache
constexpr int kPad = 16;           // floats beside a strip; at least 3 * kReach and a multiple of every vector width
constexpr int kRows = kTile + 2 * kReach;

// Row strides are odd multiples of 64 bytes: walking down a column must not hit the same cache set at every row.
constexpr int odd_lines(int floats) {
  const int lines = (floats + 15) / 16;
  return 16 * (lines | 1);
}
constexpr int kStripStride = odd_lines(3 * kTile * kStripTiles + 2 * kPad);
// raw image, raw target, its centre, five vertically blurred maps, two maps of target statistics
constexpr std::size_t kScratchFloats = static_cast<std::size_t>(kStripStride) * (2 * kRows + 1 + 7 * kTile);

// A target [H, W, 3]: floats, or bytes of which 255 is 1.0. The other one is null.
struct TargetPixels {
  const float* floats;
  const uint8_t* bytes;
  float operator[](std::size_t i) const { return bytes ? static_cast<float>(bytes[i]) / 255.0f : floats[i]; }
};

// Blurred target and its windowed variance, tile by tile [tile_rows, tile_columns, 2, kTile, kTileFloats], so that only
// the memory of tiles that were needed is ever touched. Where `codes` is given, 16-bit codes of the mean and of the root
// of the variance, for targets in [0, 1]. All null: computed on the way.
constexpr int kTileFloats = 3 * kTile;
struct TargetStatistics {
  float* floats;
  uint16_t* codes;
  uint8_t* known;  // [tile_rows, strips of kStripTiles] where they are known; the others are made where they are needed
};

struct PhotometricJob {
  int height, width, tile_rows, tile_columns;
  const float* image;
  TargetPixels target;
  TargetStatistics statistics;
  const uint8_t* active;       // [tile_rows, tile_columns] tiles in the sum
  const uint8_t* wanted;       // tiles whose gradient is written; contains active
  const float* window;         // 6 weights, from the rim to the centre
  const float* column_weight;  // [3 * 16 * tile_columns] sum of the window's weights inside the image, per float column
  const float* row_weight;     // [16 * tile_rows]
  float* maps[3];                // derivatives of SSIM at pixel (0, 0), padded with zeros; or null
  std::ptrdiff_t map_stride;
  float* gradient;               // [H, W, 3]
  float l1_scale, ssim_scale;    // factors of sign(I - G) and of dS/dI in the gradient
  double* partial;               // [tile_rows * tile_columns, 2] sums of |I - G| and of 1 - SSIM, by first tile of a strip
};

struct PhotometricKernels {
  // Sums and derivative maps of the active tiles of a row; zeroes the maps of inactive neighbours of wanted tiles.
  void (*forward_row)(const PhotometricJob&, int tile_row, float* scratch);
  // Gradient of the wanted tiles of a row. Needs the maps of the rows above and below.
  void (*backward_row)(const PhotometricJob&, int tile_row, float* scratch);
};
GSS_KERNEL_TABLE(PhotometricKernels, photometric_kernels)

struct PhotometricSums {
  double l1, dssim;  // sums over active pixels and channels
};

// Runs the kernels over all tile rows. `job` comes without window, weights, maps and partial: they are filled in here.
PhotometricSums photometric_run(PhotometricJob job);
// Strips of tiles whose statistics are made together, in a row of tiles.
constexpr int strips_of(int tile_columns) { return (tile_columns + kStripTiles - 1) / kStripTiles; }

}  // namespace gsstream_cpu
