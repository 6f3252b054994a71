// Where the layers of a tile have to end.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

#include "raster/layers.hpp"

namespace gsstream_cpu {

constexpr float NEAREST = -std::numeric_limits<float>::infinity(), FARTHEST = std::numeric_limits<float>::infinity();
constexpr uint32_t CELL = 32;  // entries of a cached list

template <class Visit>
void for_blocks(uint32_t blocks, Visit&& visit) {
  for (; blocks; blocks &= blocks - 1) visit(__builtin_ctz(blocks));
}

// The cached list of one tile.
struct CachedTile {
  const Record* records;
  const TileEntry* entries;
  const uint32_t* blocks;
  uint32_t count;
  const std::vector<uint32_t>& active;

  CachedTile(const LayerSource& source, std::size_t tile)
      : records(source.records),
        entries(source.cached.entries + source.cached.begin[tile]),
        blocks(source.cached.blocks + source.cached.begin[tile]),
        count(source.cached.end[tile] - source.cached.begin[tile]),
        active((*source.in_cache)[tile]) {}
  float depth(uint32_t entry) const { return records[entries[entry].record].depth; }
  // Number of entries nearer than this depth; `least`: a number that there are at any rate, near which it is looked for.
  uint32_t nearer(float depth, uint32_t least) const {
    const auto is_before = [&](const TileEntry& e, float d) { return records[e.record].depth < d; };
    uint32_t low = least, step = 1;
    while (low + step <= count && is_before(entries[low + step - 1], depth)) {
      low += step;
      step *= 2;
    }
    const TileEntry* end = entries + std::min(count, low + step - 1);
    return static_cast<uint32_t>(std::lower_bound(entries + low, end, depth, is_before) - entries);
  }
  // Number of entries that are not farther; `most`: a number that it does not exceed, near which it is looked for.
  uint32_t not_farther(float depth, uint32_t most) const {
    const auto is_behind = [&](float d, const TileEntry& e) { return d < records[e.record].depth; };
    uint32_t high = most, step = 1;
    while (high >= step && is_behind(depth, entries[high - step])) {
      high -= step;
      step *= 2;
    }
    const TileEntry* begin = entries + (high >= step ? high - step + 1 : 0);
    return static_cast<uint32_t>(std::upper_bound(begin, entries + high, depth, is_behind) - entries);
  }
};

// Blocks that an active entry is the first or the last to touch.
struct End {
  uint32_t blocks;
  float depth;
};
struct Ends {
  End first[BLOCKS], last[BLOCKS];
  int firsts = 0, lasts = 0;
  uint32_t reached = 0;
};
// Of the active Gaussians as they are now, in these blocks of a tile.
Ends find_ends(const LayerSource& source, std::size_t tile, uint32_t touched);

// Blocks whose front layer an active Gaussian has moved into, and blocks whose back layer has to begin elsewhere.
uint32_t find_crossed_fronts(const TileLayers& tile, const Ends& ends);
uint32_t find_other_backs(const TileLayers& tile, const Ends& ends, uint32_t touched);

// For every block, the last place at which its front layer may end and the one at which its back layer has to begin.
struct Limits {
  uint32_t front[BLOCKS], back[BLOCKS];
};
// Also notes in `tile` between which depths the back layer begins there.
Limits find_limits(const CachedTile& cached, const Ends& ends, uint32_t blocks, TileLayers& tile);

}  // namespace gsstream_cpu
