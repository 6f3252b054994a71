#include "raster/layer_limits.hpp"

namespace gsstream_cpu {

Ends find_ends(const LayerSource& source, std::size_t tile, uint32_t touched) {
  const ListSlice active = source.active->slice(tile);
  const auto end = [&](std::size_t e, uint32_t blocks) {
    return End{blocks, source.records[active.entries[e].record].depth};
  };
  Ends ends;
  for (std::size_t e = 0; e < active.size; e++) {
    const uint32_t fresh = active.blocks[e] & touched & ~ends.reached;
    if (fresh) ends.first[ends.firsts++] = end(e, fresh);
    ends.reached |= fresh;
  }
  uint32_t missing = ends.reached;
  for (std::size_t e = active.size; missing; e--) {
    const uint32_t fresh = active.blocks[e - 1] & missing;
    if (fresh) ends.last[ends.lasts++] = end(e - 1, fresh);
    missing &= ~fresh;
  }
  return ends;
}

uint32_t find_crossed_fronts(const TileLayers& tile, const Ends& ends) {
  uint32_t crossed = 0;
  for (int i = 0; i < ends.firsts; i++)
    for_blocks(ends.first[i].blocks & tile.settled, [&](int b) {
      if (!(ends.first[i].depth > tile.front_depth[b])) crossed |= 1u << b;
    });
  return crossed;
}

uint32_t find_other_backs(const TileLayers& tile, const Ends& ends, uint32_t touched) {
  uint32_t others = 0;
  for_blocks(touched & tile.settled & ~ends.reached, [&](int b) {
    if (tile.cell_depth[b] != NEAREST) others |= 1u << b;
  });
  for (int i = 0; i < ends.lasts; i++)
    for_blocks(ends.last[i].blocks & tile.settled, [&](int b) {
      const float depth = ends.last[i].depth;
      if (!(depth >= tile.cell_depth[b] && depth < tile.back_depth[b])) others |= 1u << b;
    });
  return others;
}

Limits find_limits(const CachedTile& cached, const Ends& ends, uint32_t blocks, TileLayers& tile) {
  Limits limits;
  const auto cell_behind = [&](uint32_t place) { return std::min(cached.count, (place + CELL - 1) / CELL * CELL); };
  for_blocks(blocks, [&](int b) {
    limits.front[b] = cached.count;
    limits.back[b] = 0;
    tile.cell_depth[b] = NEAREST;
  });
  uint32_t missing = blocks;
  for (auto e = cached.active.begin(); missing && e != cached.active.end(); ++e) {
    for_blocks(cached.blocks[*e] & missing, [&](int b) { limits.front[b] = *e; });
    missing &= ~cached.blocks[*e];
  }
  missing = blocks & ~missing;
  for (auto e = cached.active.end(); missing; --e) {
    const uint32_t place = e[-1];
    for_blocks(cached.blocks[place] & missing, [&](int b) { limits.back[b] = cell_behind(place + 1); });
    missing &= ~cached.blocks[place];
  }
  uint32_t nearer = 0;  // the first ends come nearest first, the last ones farthest first
  for (int i = 0; i < ends.firsts; i++) {
    if (!(ends.first[i].blocks & blocks)) continue;
    nearer = cached.nearer(ends.first[i].depth, nearer);
    for_blocks(ends.first[i].blocks & blocks, [&](int b) {
      limits.front[b] = std::min(limits.front[b], nearer - std::min(nearer, tile.spare[b]));
    });
  }
  uint32_t farthest = cached.count;
  for (int i = 0; i < ends.lasts; i++) {
    if (!(ends.last[i].blocks & blocks)) continue;
    farthest = cached.not_farther(ends.last[i].depth, farthest);
    const uint32_t behind = cell_behind(farthest);
    for_blocks(ends.last[i].blocks & blocks, [&](int b) {
      if (behind <= limits.back[b]) return;
      limits.back[b] = behind;
      tile.cell_depth[b] = cached.depth((behind - 1) / CELL * CELL);
    });
  }
  for_blocks(blocks, [&](int b) {
    tile.back_depth[b] = limits.back[b] < cached.count ? cached.depth(limits.back[b]) : FARTHEST;
  });
  return limits;
}

}  // namespace gsstream_cpu
