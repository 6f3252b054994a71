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
};

struct TileLists {
  std::size_t tiles = 0, size = 0;
  Buffer<uint32_t> offset;  // [tiles+1]
  Buffer<TileEntry> entries;
  Buffer<uint32_t> blocks;
  TileListsView view() const { return {offset.data(), offset.data() + 1, entries.data(), blocks.data()}; }
  std::size_t bytes() const { return offset.bytes() + entries.bytes() + blocks.bytes(); }
  void resize(std::size_t tile_count, std::size_t entry_count);
  void swap(TileLists& other);
};

// Distributes the pairs of a depth-sorted visible set. record = record_base + row.
void build_tile_lists(const VisibleSet& visible, std::size_t tiles, uint32_t record_base, TileLists& out);

// Entries of `from` in wanted tiles whose Gaussian is not marked in is_active, all FROZEN. `dropped` [tiles] becomes
// the union of the blocks of those that are.
void filter_tile_lists(const TileListsView& from, const std::vector<uint32_t>& tile_blocks,
                       const std::vector<uint8_t>& is_active, TileLists& out, std::vector<uint32_t>& dropped);

// Adds the blocks of the entries of every tile to `touched` [tiles].
void add_touched_blocks(const TileLists& lists, std::vector<uint32_t>& touched);

// Blocks of every tile that hold an entry of a Gaussian marked in is_active.
void find_active_blocks(const TileListsView& lists, const std::vector<uint8_t>& is_active,
                        std::vector<uint32_t>& touched);

// Merges two depth-sorted families of lists by (depth, row), in wanted tiles. Entries of `frozen` refer to
// record = row; those of `active` to record = record_base + index into active_rows.
void merge_tile_lists(const TileLists& frozen, const TileLists& active, const std::vector<uint32_t>& tile_blocks,
                      const Record* records, uint32_t record_base, const std::vector<uint32_t>& active_rows,
                      TileLists& out);

}  // namespace gsstream_cpu
