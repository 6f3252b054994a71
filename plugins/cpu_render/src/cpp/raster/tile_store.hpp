// The depth-sorted lists of the cached scene, kept tile by tile so that a change rewrites only the tiles it touches.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "runtime/buffer.hpp"
#include "raster/raster_types.hpp"
#include "raster/tile_lists.hpp"

namespace gsstream_cpu {

// entries[begin[t], end[t]) belong to tile t; behind end[t] there may be room left. `contributed` lies beside them.
struct TileStore {
  std::vector<uint32_t> begin, end, room;  // [tiles]; room: entries that fit from begin on
  Buffer<TileEntry> entries;
  Buffer<uint32_t> blocks, contributed;
  std::size_t used = 0;  // entries of the buffers that some tile has claimed

  std::size_t tiles() const { return begin.size(); }
  TileListsView view() const { return {begin.data(), end.data(), entries.data(), blocks.data()}; }
  std::size_t bytes() const {
    return entries.bytes() + blocks.bytes() + contributed.bytes() + 3 * begin.capacity() * sizeof(uint32_t);
  }
  // Takes over the memory of `lists`, which is left with unspecified contents.
  void adopt(TileLists& lists);
  // Makes the list of a tile these entries.
  void replace(std::size_t tile, const std::vector<TileEntry>& fresh, const std::vector<uint32_t>& fresh_blocks,
               const std::vector<uint32_t>& fresh_contributed);

 private:
  void compact();
};

}  // namespace gsstream_cpu
