#include "fit/view_loss_grad.hpp"

#include <algorithm>
#include <cstring>
#include <vector>

#include "fit/colour_map.hpp"
#include "fit/structure.hpp"
#include "raster/claim.hpp"
#include "runtime/buffer.hpp"
#include "runtime/parallel.hpp"

namespace gsstream_cpu {
namespace {

constexpr std::size_t FILL_GRAIN = 8;  // rows of blocks
constexpr float SH0 = 0.28209479177387814f;  // colour per unit of sh0

// Memory of one calling thread, kept between calls.
struct Workspace {
  Buffer<float> image, recorded, gradient, structure;
  PassMemory pass;
  std::vector<uint8_t> touched, around, read, counted;  // by tiles of 16 x 16 pixels
};

Workspace& workspace() {
  thread_local Workspace own;
  return own;
}

struct Grid {
  int width, height, columns, rows;
};

void dilate(const Grid& grid, const std::vector<uint8_t>& from, std::vector<uint8_t>& to) {
  to.assign(from.size(), 0);
  for (int y = 0; y < grid.rows; y++)
    for (int x = 0; x < grid.columns; x++) {
      if (!from[static_cast<std::size_t>(y) * grid.columns + x]) continue;
      for (int v = std::max(0, y - 1); v <= std::min(grid.rows - 1, y + 1); v++)
        for (int u = std::max(0, x - 1); u <= std::min(grid.columns - 1, x + 1); u++)
          to[static_cast<std::size_t>(v) * grid.columns + u] = 1;
    }
}

// The pixels of marked tiles, row by row: fn(first pixel, number of pixels).
template <class Fn>
void for_marked(const Grid& grid, const std::vector<uint8_t>& marked, Fn&& fn) {
  parallel_for(static_cast<std::size_t>(grid.rows), 2, [&](std::size_t begin, std::size_t end) {
    for (std::size_t row = begin; row < end; row++) {
      const uint8_t* marks = &marked[row * static_cast<std::size_t>(grid.columns)];
      const int top = static_cast<int>(row) * kTile, bottom = std::min(grid.height, top + kTile);
      for (int first = 0; first < grid.columns;) {
        int last = first;
        while (last < grid.columns && marks[last]) last++;
        if (last > first) {
          const int left = first * kTile, right = std::min(grid.width, last * kTile);
          for (int y = top; y < bottom; y++)
            fn(static_cast<std::size_t>(y) * grid.width + left, static_cast<std::size_t>(right - left));
        }
        first = std::max(last, first + 1);
      }
    }
  });
}

// What lies around the blocks that were rendered, as far as windows of the loss reach: it is as in the cache.
void fill_around(const Grid& grid, const TileSelection& rendered, const std::vector<uint8_t>& read, const float* cached,
                 float* image) {
  const int columns = (grid.width + BLOCK_SIDE - 1) / BLOCK_SIDE, rows = (grid.height + BLOCK_SIDE - 1) / BLOCK_SIDE;
  parallel_for(static_cast<std::size_t>(rows), FILL_GRAIN, [&](std::size_t begin, std::size_t end) {
    for (int row = static_cast<int>(begin); row < static_cast<int>(end); row++) {
      const uint32_t* tiles = &rendered.blocks[static_cast<std::size_t>(row / BLOCKS_Y) * rendered.tiles_x];
      const uint8_t* marks = &read[static_cast<std::size_t>(row * BLOCK_SIDE / kTile) * grid.columns];
      const auto missing = [&](int column) {
        const int block = row % BLOCKS_Y * BLOCKS_X + column % BLOCKS_X;
        return marks[column * BLOCK_SIDE / kTile] && !(tiles[column / BLOCKS_X] >> block & 1u);
      };
      for (int first = 0; first < columns; first++) {
        int last = first;
        while (last < columns && missing(last)) last++;
        if (last == first) continue;
        const int left = first * BLOCK_SIDE, right = std::min(grid.width, last * BLOCK_SIDE);
        for (int y = row * BLOCK_SIDE; y < std::min(grid.height, (row + 1) * BLOCK_SIDE); y++) {
          const std::size_t at = 3 * (static_cast<std::size_t>(y) * grid.width + left);
          std::memcpy(image + at, cached + at, 3 * static_cast<std::size_t>(right - left) * sizeof(float));
        }
        first = last;
      }
    }
  });
}

// Tiles that are not left out; null where all count.
const uint8_t* counted(const float* weights, std::size_t tiles, std::vector<uint8_t>& mask) {
  if (!weights) return nullptr;
  mask.resize(tiles);
  for (std::size_t tile = 0; tile < tiles; tile++) mask[tile] = weights[tile] > 0.0f;
  return mask.data();
}

// gradient = gradient times the weight of its tile.
void weigh(const Grid& grid, const float* weights, const std::vector<uint8_t>& marked, float* gradient) {
  for (int row = 0; row < grid.rows; row++)
    for (int column = 0; column < grid.columns; column++) {
      const std::size_t tile = static_cast<std::size_t>(row) * grid.columns + column;
      if (!marked[tile] || weights[tile] == 1.0f) continue;
      const int right = std::min(grid.width, (column + 1) * kTile), bottom = std::min(grid.height, (row + 1) * kTile);
      for (int y = row * kTile; y < bottom; y++) {
        float* line = gradient + 3 * (static_cast<std::size_t>(y) * grid.width + column * kTile);
        for (int i = 0; i < 3 * (right - column * kTile); i++) line[i] *= weights[tile];
      }
    }
}

// The gradient of a pixel by a row's colour is the share that the row has of its light: so the pass that gives gradients
// sums up structure, too. `out` is written over.
void structure_backward(Rasterizer& rasterizer, const Grid& grid, const ViewComparison& view, const float* recorded,
                    const GradientArrays& out, std::size_t rows, float* structure) {
  Workspace& work = workspace();
  float* picture = work.structure.require(3 * static_cast<std::size_t>(grid.width) * grid.height);
  for_marked(grid, work.touched, [&](std::size_t first, std::size_t count) {
    structure_of_line(recorded, view.target, grid.width, grid.height, first, count, picture);
  });
  rasterizer.backward_layered(picture, out);
  for (std::size_t i = 0; i < 3 * rows; i++) structure[i] = out.sh0[i] / SH0;
}

}  // namespace

PhotometricJob photometric_job(int width, int height, const ViewComparison& view, const float* recorded) {
  PhotometricJob job{};
  job.height = height;
  job.width = width;
  job.tile_rows = (height + kTile - 1) / kTile;
  job.tile_columns = (width + kTile - 1) / kTile;
  job.image = recorded;
  job.target = view.target;
  job.statistics = view.statistics;
  job.l1_scale = view.l1_scale;
  job.ssim_scale = view.ssim_scale;
  return job;
}

ViewLossGrad view_loss_and_grad(Rasterizer& rasterizer, const Scene& rows, const ViewComparison& view, const GradientArrays& out,
                   float* structure) {
  Workspace& work = workspace();
  const Rasterizer::Loan loan(rasterizer, work.pass);
  const Grid grid{rasterizer.width(), rasterizer.height(), (rasterizer.width() + kTile - 1) / kTile,
                  (rasterizer.height() + kTile - 1) / kTile};
  const std::size_t pixels = static_cast<std::size_t>(grid.width) * grid.height;
  const std::size_t tiles = static_cast<std::size_t>(grid.columns) * grid.rows;
  float* image = work.image.require(3 * pixels);
  const Target target{{view.background[0], view.background[1], view.background[2]}, image, nullptr};
  ViewLossGrad result{};
  result.faults = rasterizer.forward_layered(rows, target, counted(view.weights, tiles, work.counted));
  if (result.faults) return result;
  work.touched.resize(tiles);
  rasterizer.touched().write_mask(grid.width, grid.height, work.touched.data());
  dilate(grid, work.touched, work.around);
  dilate(grid, work.around, work.read);
  fill_around(grid, rasterizer.touched(), work.read, view.cached_image, image);
  const float* recorded = image;
  if (view.matrix) {
    float* mapped = work.recorded.require(3 * pixels);
    for_marked(grid, work.read, [&](std::size_t first, std::size_t count) {
      apply_exposure(view.matrix, view.offset, image + 3 * first, mapped + 3 * first, count);
    });
    recorded = mapped;
  }
  PhotometricJob job = photometric_job(grid.width, grid.height, view, recorded);
  job.active = work.around.data();
  job.wanted = work.touched.data();
  job.gradient = work.gradient.require(3 * pixels);
  result.sums = photometric_run(job);
  if (view.matrix)
    for_marked(grid, work.touched, [&](std::size_t first, std::size_t count) {
      exposure_vjp(view.matrix, job.gradient + 3 * first, count);
    });
  if (view.weights) weigh(grid, view.weights, work.touched, job.gradient);
  if (structure) structure_backward(rasterizer, grid, view, recorded, out, rows.count, structure);
  rasterizer.backward_layered(job.gradient, out);
  return result;
}

}  // namespace gsstream_cpu
