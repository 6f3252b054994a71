#include "raster/screen_pass.hpp"

#include <cstring>

#include "runtime/parallel.hpp"

namespace gsstream_cpu {

std::size_t RowSet::rank_all() {
  before_.resize(bits_.size());
  uint32_t total = 0;
  for (std::size_t word = 0; word < bits_.size(); word++) {
    before_[word] = total;
    total += static_cast<uint32_t>(__builtin_popcountll(bits_[word]));
  }
  return total;
}

void RowSet::list(uint32_t* out) const {
  for (std::size_t word = 0; word < bits_.size(); word++)
    for (uint64_t left = bits_[word]; left; left &= left - 1)
      *out++ = static_cast<uint32_t>(64 * word) + static_cast<uint32_t>(__builtin_ctzll(left));
}

void ScreenPass::build(const TileStore& store, const TileSelection& selection, std::size_t scene_rows) {
  reached.clear(scene_rows);
  for (uint32_t tile : selection.active)
    for (uint32_t e = store.begin[tile]; e < store.end[tile]; e++)
      if (store.contributed[e] & selection.blocks[tile]) reached.insert(store.entries[e].record);
  count = reached.rank_all();
  reached.list(rows.require(count));
  offset.require(count + 1);
  next.require(count);
  std::memset(next.data(), 0, count * sizeof(uint32_t));
  for (uint32_t tile : selection.active)
    for (uint32_t e = store.begin[tile]; e < store.end[tile]; e++)
      if (store.contributed[e] & selection.blocks[tile]) next[reached.rank(store.entries[e].record)]++;
  uint32_t total = 0;
  for (std::size_t i = 0; i < count; i++) {
    const uint32_t pairs = next[i];
    offset[i] = next[i] = total;
    total += pairs;
  }
  offset[count] = total;
  pair_count = total;
  entries.require(store.used);
  for (uint32_t tile : selection.active)
    for (uint32_t e = store.begin[tile]; e < store.end[tile]; e++) {
      const uint32_t record = store.entries[e].record;
      const bool wanted = store.contributed[e] & selection.blocks[tile];
      entries[e] = {record, wanted ? next[reached.rank(record)]++ : FROZEN};
    }
}

void select_nonzero(const float* image_gradient, int width, int height, TileSelection& out) {
  out.tiles_x = (width + TILE_WIDTH - 1) / TILE_WIDTH;
  out.tiles_y = (height + TILE_HEIGHT - 1) / TILE_HEIGHT;
  out.sum.clear();
  out.active.clear();
  out.blocks.assign(static_cast<std::size_t>(out.tiles_x) * out.tiles_y, 0);
  const std::size_t row_floats = 3 * static_cast<std::size_t>(width);
  parallel_for(static_cast<std::size_t>(out.tiles_y), 4, [&](std::size_t first, std::size_t last) {
    for (std::size_t y = first * TILE_HEIGHT; y < last * TILE_HEIGHT && y < static_cast<std::size_t>(height); y++) {
      const int block_row = static_cast<int>(y % TILE_HEIGHT) / BLOCK_SIDE;
      uint32_t* tiles = &out.blocks[y / TILE_HEIGHT * out.tiles_x];
      for (int x = 0; x < width; x += BLOCK_SIDE) {
        const float* pixels = image_gradient + y * row_floats + 3 * static_cast<std::size_t>(x);
        const int floats = 3 * (width - x < BLOCK_SIDE ? width - x : BLOCK_SIDE);
        uint32_t bits = 0;
        for (int i = 0; i < floats; i++) {
          uint32_t value;
          std::memcpy(&value, pixels + i, sizeof value);
          bits |= value << 1;  // without the sign
        }
        if (bits) tiles[x / TILE_WIDTH] |= 1u << (block_row * BLOCKS_X + x % TILE_WIDTH / BLOCK_SIDE);
      }
    }
  });
  for (std::size_t tile = 0; tile < out.blocks.size(); tile++)
    if (out.blocks[tile]) out.active.push_back(static_cast<uint32_t>(tile));
}

}  // namespace gsstream_cpu
