// Stage 2b: the depth-sorted lists of the tiles, and the list operations of the incremental mode.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "runtime/buffer.hpp"
#include "raster/depth_sort.hpp"
#include "raster/raster_types.hpp"

namespace gsstream_cpu {

// Result of stage 1, chunks joined: visible Gaussians in memory order and their pairs, contiguous per Gaussian.
struct VisibleSet {
  std::size_t count = 0, pair_count = 0;
  Buffer<uint32_t> rows;         // [count]
  Buffer<uint32_t> pair_offset;  // [count+1]
  Buffer<Pair> pairs;            // [pair_count]
  Buffer<DepthItem> by_depth;    // [count], slots; memory order until sorted
  std::size_t bytes() const { return rows.bytes() + pair_offset.bytes() + pairs.bytes() + by_depth.bytes(); }
  void release();
};

// The list of one tile.
struct ListSlice {
  const TileEntry* entries;
  const uint32_t* blocks;
  std::size_t size;
};

struct TileLists {
  std::size_t tiles = 0, size = 0;
  Buffer<uint32_t> offset;  // [tiles+1]
  Buffer<TileEntry> entries;
  Buffer<uint32_t> blocks;
  TileListsView view() const { return {offset.data(), offset.data() + 1, entries.data(), blocks.data()}; }
  ListSlice slice(std::size_t tile) const {
    return {entries.data() + offset[tile], blocks.data() + offset[tile], offset[tile + 1] - offset[tile]};
  }
  std::size_t bytes() const { return offset.bytes() + entries.bytes() + blocks.bytes(); }
  void resize(std::size_t tile_count, std::size_t entry_count);
  void release();
  void swap(TileLists& other);
};

// Distributes the pairs of a depth-sorted visible set. record = record_base + row.
void build_tile_lists(const VisibleSet& visible, std::size_t tiles, uint32_t record_base, TileLists& out);

// Entries of `from` in wanted tiles whose Gaussian is not marked in is_active, all FROZEN.
void filter_tile_lists(const TileListsView& from, const std::vector<uint32_t>& tile_blocks,
                       const std::vector<uint8_t>& is_active, TileLists& out);

// Adds the blocks of the entries of every tile to `touched` [tiles].
void add_touched_blocks(const TileLists& lists, std::vector<uint32_t>& touched);

// What orders frozen and active entries: entries of frozen lists refer to record = row; those of active lists to
// record = base + index into `active_rows`.
struct DepthOrder {
  const Record* records;
  uint32_t base;
  const uint32_t* active_rows;
};

// Merges two depth-sorted lists of a tile by (depth, row), to `place` and following of `out`.
void merge_tile(const ListSlice& frozen, const ListSlice& active, const DepthOrder& order, TileLists& out,
                std::size_t place);

// Merges two families of lists, in wanted tiles.
void merge_tile_lists(const TileLists& frozen, const TileLists& active, const std::vector<uint32_t>& tile_blocks,
                      const DepthOrder& order, TileLists& out);

}  // namespace gsstream_cpu
