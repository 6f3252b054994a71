// Where the active Gaussians are in the cached lists.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "raster/raster_types.hpp"

namespace gsstream_cpu {

// For every tile, in ascending order, the entries whose Gaussian is active, counted from the tile's first entry.
class ActiveEntries {
 public:
  // is_active: by record of the lists. marked [tiles]: where to look; in no other tile is an active Gaussian.
  void find(const TileListsView& lists, const std::vector<uint8_t>& marked, const std::vector<uint8_t>& is_active);
  void clear();
  // False after clear().
  bool any() const { return !tiles_.empty(); }
  // As find, where all that are active now were so at the last call.
  void keep(const TileListsView& lists, const std::vector<uint8_t>& is_active);
  // The blocks of the entries of every tile.
  void touched(const TileListsView& lists, std::vector<uint32_t>& blocks) const;
  const std::vector<uint32_t>& operator[](std::size_t tile) const { return tiles_[tile]; }
  std::size_t bytes() const;

 private:
  std::vector<std::vector<uint32_t>> tiles_;
};

}  // namespace gsstream_cpu
