#include "raster/tile_lists.hpp"

#include <algorithm>
#include <utility>

#include "runtime/parallel.hpp"

namespace gsstream_cpu {
namespace {

constexpr std::size_t PARALLEL_FROM = 8192;  // visible Gaussians per additional thread
constexpr std::size_t MERGE_GRAIN = 8;  // tiles
constexpr std::size_t PREFETCH = 16;

struct Slice {
  std::size_t begin, end;
};

// Calls visit(pair, visible slot, pair index) for the pairs of a slice of the depth order.
template <class Visit>
void for_pairs(const VisibleSet& visible, Slice slice, Visit&& visit) {
  for (std::size_t i = slice.begin; i < slice.end; i++) {
    const uint32_t slot = visible.by_depth[i].slot;
    if (i + PREFETCH < slice.end) __builtin_prefetch(&visible.pair_offset[visible.by_depth[i + PREFETCH].slot]);
    for (uint32_t p = visible.pair_offset[slot]; p < visible.pair_offset[slot + 1]; p++)
      visit(visible.pairs[p], slot, p);
  }
}

}  // namespace

void TileLists::resize(std::size_t tile_count, std::size_t entry_count) {
  tiles = tile_count;
  size = entry_count;
  offset.require(tile_count + 1);
  entries.require(entry_count);
  blocks.require(entry_count);
}

void TileLists::release() {
  tiles = size = 0;
  offset.release();
  entries.release();
  blocks.release();
}

void VisibleSet::release() {
  count = pair_count = 0;
  rows.release();
  pair_offset.release();
  pairs.release();
  by_depth.release();
}

void TileLists::swap(TileLists& other) {
  std::swap(tiles, other.tiles);
  std::swap(size, other.size);
  offset.swap(other.offset);
  entries.swap(other.entries);
  blocks.swap(other.blocks);
}

// A stable counting scatter by tile in depth order: every list comes out depth-sorted, without sorting per tile. Each
// part counts its slice; the running sums then give every part its own places, so the result is the same for any
// number of parts.
void build_tile_lists(const VisibleSet& visible, std::size_t tiles, uint32_t record_base, TileLists& out) {
  out.resize(tiles, visible.pair_count);
  const std::size_t threads = static_cast<std::size_t>(num_threads());
  const std::size_t parts = std::clamp<std::size_t>(visible.count / PARALLEL_FROM, 1, threads);
  const auto slice = [&](std::size_t p) { return Slice{visible.count * p / parts, visible.count * (p + 1) / parts}; };
  std::vector<uint32_t> next(parts * tiles, 0);
  parallel_for(parts, 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t p = begin; p < end; p++)
      for_pairs(visible, slice(p), [counts = &next[p * tiles]](Pair pair, uint32_t, uint32_t) { counts[pair.tile]++; });
  });
  uint32_t total = 0;
  for (std::size_t tile = 0; tile < tiles; tile++) {
    out.offset[tile] = total;
    for (std::size_t p = 0; p < parts; p++) total += std::exchange(next[p * tiles + tile], total);
  }
  out.offset[tiles] = total;
  parallel_for(parts, 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t p = begin; p < end; p++)
      for_pairs(visible, slice(p), [&, places = &next[p * tiles]](Pair pair, uint32_t slot, uint32_t index) {
        const uint32_t place = places[pair.tile]++;
        out.entries[place] = {record_base + visible.rows[slot], index};
        out.blocks[place] = pair.blocks;
      });
  });
}

void filter_tile_lists(const TileListsView& from, const std::vector<uint32_t>& tile_blocks,
                       const std::vector<uint8_t>& is_active, TileLists& out) {
  const std::size_t tiles = tile_blocks.size();
  std::size_t most = 0;
  for (std::size_t tile = 0; tile < tiles; tile++)
    if (tile_blocks[tile]) most += from.end[tile] - from.begin[tile];
  out.resize(tiles, most);
  uint32_t next = 0;
  for (std::size_t tile = 0; tile < tiles; tile++) {
    out.offset[tile] = next;
    if (!tile_blocks[tile]) continue;
    for (uint32_t e = from.begin[tile]; e < from.end[tile]; e++) {
      const uint32_t blocks = from.blocks[e] & tile_blocks[tile];
      if (!blocks || is_active[from.entries[e].record]) continue;
      out.entries[next] = {from.entries[e].record, FROZEN};
      out.blocks[next++] = blocks;
    }
  }
  out.offset[tiles] = next;
  out.size = next;
}

void add_touched_blocks(const TileLists& lists, std::vector<uint32_t>& touched) {
  for (std::size_t tile = 0; tile < lists.tiles; tile++)
    for (uint32_t e = lists.offset[tile]; e < lists.offset[tile + 1]; e++) touched[tile] |= lists.blocks[e];
}

void merge_tile(const ListSlice& frozen, const ListSlice& active, const DepthOrder& order, TileLists& out,
                std::size_t place) {
  TileEntry* entries = out.entries.data() + place;
  uint32_t* blocks = out.blocks.data() + place;
  const auto take = [&](const ListSlice& from, std::size_t i) {
    *entries++ = from.entries[i];
    *blocks++ = from.blocks[i];
  };
  std::size_t f = 0;
  for (std::size_t a = 0; a < active.size; a++) {
    const uint32_t record = active.entries[a].record, row = order.active_rows[record - order.base];
    const float depth = order.records[record].depth;
    for (; f < frozen.size; f++) {
      const uint32_t other = frozen.entries[f].record;
      const float far = order.records[other].depth;
      if (depth != far ? depth < far : row < other) break;
      take(frozen, f);
    }
    take(active, a);
  }
  for (; f < frozen.size; f++) take(frozen, f);
}

void merge_tile_lists(const TileLists& frozen, const TileLists& active, const std::vector<uint32_t>& tile_blocks,
                      const DepthOrder& order, TileLists& out) {
  out.resize(frozen.tiles, frozen.size + active.size);
  uint32_t total = 0;
  for (std::size_t tile = 0; tile < frozen.tiles; tile++) {
    out.offset[tile] = total;
    if (tile_blocks[tile])
      total += frozen.offset[tile + 1] - frozen.offset[tile] + active.offset[tile + 1] - active.offset[tile];
  }
  out.offset[frozen.tiles] = total;
  out.size = total;
  parallel_for(frozen.tiles, MERGE_GRAIN, [&](std::size_t begin, std::size_t end) {
    for (std::size_t tile = begin; tile < end; tile++)
      if (tile_blocks[tile]) merge_tile(frozen.slice(tile), active.slice(tile), order, out, out.offset[tile]);
  });
}

}  // namespace gsstream_cpu
