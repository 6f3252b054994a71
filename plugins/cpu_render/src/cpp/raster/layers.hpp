// Layers of what stands still: for every block, the frozen Gaussians in front of all that may change there, and those
// behind it, blended once instead of in every pass.
//
// The cached list of a tile is cut, block by block, at two places: entries before front_end are in the front layer,
// those from back_begin on in the back layer, and only those between them are blended again and again. Both layers keep
// clear of every active Gaussian that touches the block, where it is now and where it is in the cache; so they stay as
// they are when a freeze lets fewer rows change, and may then grow.
//
// The front layer holds what blending its entries one by one gives, bit by bit, so it may end anywhere: where an active
// Gaussian moves into it, it starts anew and leaves more entries to be blended. The back layer starts from
// transmittance 1 and not from what is left there: its light is the sum of the same terms, rounded otherwise, and it
// does not end where a pixel's transmittance falls to TRANSMITTANCE_MIN. So that a pass is a function of the scene and
// the active rows all the same, and not of the passes before it, back_begin is in every pass the first multiple of CELL
// behind the last active Gaussian, and the layer is put together cell by cell, from the hindmost to the foremost.
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "runtime/buffer.hpp"
#include "raster/active_entries.hpp"
#include "raster/raster_kernels.hpp"
#include "raster/raster_types.hpp"
#include "raster/tile_lists.hpp"

namespace gsstream_cpu {

struct TileLayers {
  LayerPixels pixels;
  uint32_t settled = 0;                            // blocks that have layers
  uint32_t current = 0;                            // those of them that were cut since the last freeze
  uint32_t front_end[BLOCKS], back_begin[BLOCKS];  // counted from the first entry of the tile's cached list
  uint32_t spare[BLOCKS];                          // entries of the tile's list to leave in front of the active ones
  float front_depth[BLOCKS];                       // of the hindmost entry in front: active ones must be farther
  float cell_depth[BLOCKS], back_depth[BLOCKS];    // the last active one must be in [cell_depth, back_depth)
  std::size_t size = 0;                            // entries between the layers
  Buffer<TileEntry> entries;
  Buffer<uint32_t> blocks;
  std::size_t bytes() const { return sizeof *this + entries.bytes() + blocks.bytes(); }
};

// What layers are made of.
struct LayerSource {
  const CompositeKernels* kernels;
  const Record* records;
  TileListsView cached;
  const ActiveEntries* in_cache;  // the active Gaussians as they are in the cache
  const TileLists* active;        // and as they are now
  int tiles_x;
  float background[3];
};

class Layers {
 public:
  // From now on layers of another scene, whose image has so many tiles. Keeps the memory of tiles that had layers in the
  // scene before: frame by frame it would be asked for again.
  void clear(std::size_t tiles);
  // There are no layers until the next clear().
  void drop() { valid_ = false; }
  // As drop, and gives the memory back.
  void release();
  // Fewer rows may change from now on.
  void freeze();
  bool valid() const { return valid_; }
  // Makes the layers of these blocks of a tile those for the active lists. Different tiles may be settled at once.
  void settle(const LayerSource& source, std::size_t tile, uint32_t touched);
  const TileLayers& operator[](std::size_t tile) const { return *tiles_[tile]; }
  std::size_t bytes() const;

 private:
  std::vector<std::unique_ptr<TileLayers>> tiles_;  // null: never touched
  bool valid_ = false;
};

}  // namespace gsstream_cpu
