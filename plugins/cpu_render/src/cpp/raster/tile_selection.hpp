// From the caller's tile mask to the blocks that are rendered.
#pragma once
#include <cstdint>
#include <vector>

#include "raster/raster_types.hpp"

namespace gsstream_cpu {

// Which blocks of which raster tiles are wanted.
struct TileSelection {
  int tiles_x = 0, tiles_y = 0;
  std::vector<uint32_t> blocks;  // [tiles]; never blocks outside the image
  std::vector<uint32_t> active;  // tiles with any
  std::vector<int32_t> sum;      // summed-area table of (blocks != 0)
  // `blocks` of each tile of `within`, limited to `wanted` [tiles]. Leaves `sum` empty.
  void restrict(const TileSelection& within, const std::vector<uint32_t>& wanted);
  // mask: [ceil(height/16), ceil(width/16)], or null for everything.
  void build(int width, int height, const uint8_t* mask);
  bool contains(const TileSelection& other) const;
  // The inverse of build: 1 for every cell of the caller's mask [ceil(height/16), ceil(width/16)] with a block in it.
  void write_mask(int width, int height, uint8_t* mask) const;
};

}  // namespace gsstream_cpu
