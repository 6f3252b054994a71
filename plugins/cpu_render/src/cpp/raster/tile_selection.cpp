#include "raster/tile_selection.hpp"

#include <algorithm>
#include <cstddef>

namespace gsstream_cpu {

// Blocks of the cells of the caller's mask (16x16) that lie in one raster tile (32x16), inside the image.
static uint32_t wanted_blocks(int tile_x, int tile_y, int width, int height, const uint8_t* mask) {
  const int mask_columns = (width + MASK_TILE - 1) / MASK_TILE;
  uint32_t blocks = 0;
  for (int b = 0; b < BLOCKS; b++) {
    const int x = tile_x * TILE_WIDTH + b % BLOCKS_X * BLOCK_SIDE, y = tile_y * TILE_HEIGHT + b / BLOCKS_X * BLOCK_SIDE;
    if (x >= width || y >= height) continue;
    if (!mask || mask[y / MASK_TILE * mask_columns + x / MASK_TILE]) blocks |= 1u << b;
  }
  return blocks;
}

void TileSelection::build(int width, int height, const uint8_t* mask) {
  tiles_x = (width + TILE_WIDTH - 1) / TILE_WIDTH;
  tiles_y = (height + TILE_HEIGHT - 1) / TILE_HEIGHT;
  blocks.assign(static_cast<std::size_t>(tiles_x) * tiles_y, 0);
  sum.assign(static_cast<std::size_t>(tiles_x + 1) * (tiles_y + 1), 0);
  active.clear();
  for (int y = 0; y < tiles_y; y++)
    for (int x = 0; x < tiles_x; x++) {
      const std::size_t tile = static_cast<std::size_t>(y) * tiles_x + x;
      blocks[tile] = wanted_blocks(x, y, width, height, mask);
      if (blocks[tile]) active.push_back(static_cast<uint32_t>(tile));
      int32_t* cell = &sum[static_cast<std::size_t>(y + 1) * (tiles_x + 1) + x + 1];
      cell[0] = cell[-1] + cell[-(tiles_x + 1)] - cell[-(tiles_x + 2)] + (blocks[tile] != 0);
    }
}

void TileSelection::restrict(const TileSelection& within, const std::vector<uint32_t>& wanted) {
  tiles_x = within.tiles_x;
  tiles_y = within.tiles_y;
  sum.clear();
  active.clear();
  blocks.assign(within.blocks.size(), 0);
  for (uint32_t tile : within.active) {
    blocks[tile] = within.blocks[tile] & wanted[tile];
    if (blocks[tile]) active.push_back(tile);
  }
}

void TileSelection::write_mask(int width, int height, uint8_t* mask) const {
  const int columns = (width + MASK_TILE - 1) / MASK_TILE, rows = (height + MASK_TILE - 1) / MASK_TILE;
  std::fill_n(mask, static_cast<std::size_t>(rows) * columns, uint8_t{0});
  for (uint32_t tile : active) {
    const int left = static_cast<int>(tile) % tiles_x * TILE_WIDTH, top = static_cast<int>(tile) / tiles_x * TILE_HEIGHT;
    for (int b = 0; b < BLOCKS; b++)
      if (blocks[tile] >> b & 1u) {
        const int x = left + b % BLOCKS_X * BLOCK_SIDE, y = top + b / BLOCKS_X * BLOCK_SIDE;
        mask[y / MASK_TILE * columns + x / MASK_TILE] = 1;
      }
  }
}

bool TileSelection::contains(const TileSelection& other) const {
  for (std::size_t tile = 0; tile < blocks.size(); tile++)
    if (other.blocks[tile] & ~blocks[tile]) return false;
  return true;
}

}  // namespace gsstream_cpu
