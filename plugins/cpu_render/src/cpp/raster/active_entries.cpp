#include "raster/active_entries.hpp"

#include <algorithm>

#include "runtime/parallel.hpp"

namespace gsstream_cpu {

constexpr std::size_t SEARCH_GRAIN = 16;  // tiles

void ActiveEntries::find(const TileListsView& lists, const std::vector<uint8_t>& marked,
                         const std::vector<uint8_t>& is_active) {
  tiles_.resize(marked.size());
  parallel_for(marked.size(), SEARCH_GRAIN, [&](std::size_t begin, std::size_t end) {
    for (std::size_t tile = begin; tile < end; tile++) {
      tiles_[tile].clear();
      if (!marked[tile]) continue;
      const TileEntry* entries = lists.entries + lists.begin[tile];
      const uint32_t count = lists.end[tile] - lists.begin[tile];
      for (uint32_t e = 0; e < count; e++)
        if (is_active[entries[e].record]) tiles_[tile].push_back(e);
    }
  });
}

void ActiveEntries::clear() {
  tiles_.clear();
  tiles_.shrink_to_fit();
}

void ActiveEntries::keep(const TileListsView& lists, const std::vector<uint8_t>& is_active) {
  for (std::size_t tile = 0; tile < tiles_.size(); tile++) {
    const TileEntry* entries = lists.entries + lists.begin[tile];
    std::erase_if(tiles_[tile], [&](uint32_t e) { return !is_active[entries[e].record]; });
  }
}

void ActiveEntries::touched(const TileListsView& lists, std::vector<uint32_t>& blocks) const {
  blocks.assign(tiles_.size(), 0);
  for (std::size_t tile = 0; tile < tiles_.size(); tile++)
    for (uint32_t e : tiles_[tile]) blocks[tile] |= lists.blocks[lists.begin[tile] + e];
}

std::size_t ActiveEntries::bytes() const {
  std::size_t bytes = tiles_.capacity() * sizeof tiles_[0];
  for (const auto& tile : tiles_) bytes += tile.capacity() * sizeof tile[0];
  return bytes;
}

}  // namespace gsstream_cpu
