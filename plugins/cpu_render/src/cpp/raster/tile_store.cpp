#include "raster/tile_store.hpp"

#include <algorithm>
#include <cstring>

namespace gsstream_cpu {

void TileStore::adopt(TileLists& lists) {
  begin.assign(lists.offset.data(), lists.offset.data() + lists.tiles);
  end.assign(lists.offset.data() + 1, lists.offset.data() + lists.tiles + 1);
  room.resize(lists.tiles);
  for (std::size_t tile = 0; tile < lists.tiles; tile++) room[tile] = end[tile] - begin[tile];
  entries.swap(lists.entries);
  blocks.swap(lists.blocks);
  used = lists.size;
  contributed.require(used);
}

void TileStore::replace(std::size_t tile, const std::vector<TileEntry>& fresh,
                        const std::vector<uint32_t>& fresh_blocks,
                        const std::vector<uint32_t>& fresh_contributed) {
  const std::size_t count = fresh.size();
  if (count > room[tile]) {
    end[tile] = begin[tile];  // what it held is not moved
    std::size_t live = 0;
    for (std::size_t t = 0; t < tiles(); t++) live += end[t] - begin[t];
    const std::size_t claim = count + count / 8 + 8;
    if (used + claim > 2 * (live + claim) + 4096) compact();
    entries.require_keeping(used + claim, used);
    blocks.require_keeping(used + claim, used);
    contributed.require_keeping(used + claim, used);
    begin[tile] = static_cast<uint32_t>(used);
    room[tile] = static_cast<uint32_t>(claim);
    used += claim;
  }
  end[tile] = begin[tile] + static_cast<uint32_t>(count);
  if (!count) return;
  std::memcpy(&entries[begin[tile]], fresh.data(), count * sizeof(TileEntry));
  std::memcpy(&blocks[begin[tile]], fresh_blocks.data(), count * sizeof(uint32_t));
  std::memcpy(&contributed[begin[tile]], fresh_contributed.data(), count * sizeof(uint32_t));
}

void TileStore::compact() {
  TileStore packed;
  std::size_t live = 0;
  for (std::size_t t = 0; t < tiles(); t++) live += end[t] - begin[t];
  packed.entries.require(live);
  packed.blocks.require(live);
  packed.contributed.require(live);
  uint32_t next = 0;
  for (std::size_t t = 0; t < tiles(); t++) {
    const std::size_t count = end[t] - begin[t];
    if (count) {
      std::memcpy(&packed.entries[next], &entries[begin[t]], count * sizeof(TileEntry));
      std::memcpy(&packed.blocks[next], &blocks[begin[t]], count * sizeof(uint32_t));
      std::memcpy(&packed.contributed[next], &contributed[begin[t]], count * sizeof(uint32_t));
    }
    begin[t] = next;
    next += static_cast<uint32_t>(count);
    end[t] = next;
    room[t] = static_cast<uint32_t>(count);
  }
  entries.swap(packed.entries);
  blocks.swap(packed.blocks);
  contributed.swap(packed.contributed);
  used = live;
}

}  // namespace gsstream_cpu
