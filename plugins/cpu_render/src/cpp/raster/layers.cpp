#include "raster/layers.hpp"

#include <algorithm>
#include <limits>

namespace gsstream_cpu {
namespace {

constexpr float NEAREST = -std::numeric_limits<float>::infinity(), FARTHEST = std::numeric_limits<float>::infinity();
constexpr uint32_t LEAST_SPARE = 8;  // entries
constexpr uint32_t CELL = 32;        // entries

// Entries with the blocks in which they are wanted.
struct List {
  Buffer<TileEntry> entries;
  Buffer<uint32_t> blocks, places;  // places: in the cached list
  std::size_t size = 0;

  void start(std::size_t most) {
    entries.require(most);
    blocks.require(most);
    places.require(most);
    size = 0;
  }
  // Nothing where there is no block; written without a branch, which could not be predicted.
  void add(uint32_t record, uint32_t in, uint32_t place) {
    entries[size] = {record, FROZEN};
    blocks[size] = in;
    places[size] = place;
    size += in != 0;
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

// Blocks for which the front, the list between the layers or the back begins or ends at one place of the cached list.
struct Turn {
  uint32_t front, between, back;
};

// Memory of one thread, kept between calls.
struct Workspace {
  List front, back;
  std::vector<Turn> turns;
  Buffer<uint32_t> contributed;
};

Workspace& workspace() {
  thread_local Workspace own;
  return own;
}

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
  // Number of entries nearer than this depth.
  uint32_t nearer(float depth) const {
    const auto before = [&](const TileEntry& e, float d) { return records[e.record].depth < d; };
    return static_cast<uint32_t>(std::lower_bound(entries, entries + count, depth, before) - entries);
  }
  // Number of entries that are not farther.
  uint32_t not_farther(float depth) const {
    const auto before = [&](float d, const TileEntry& e) { return d < records[e.record].depth; };
    return static_cast<uint32_t>(std::upper_bound(entries, entries + count, depth, before) - entries);
  }
};

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

// Blocks of which one or the other layer does not hold.
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

void start_front(TileLayers& tile, int b) {
  tile.front_end[b] = 0;
  tile.front_depth[b] = NEAREST;
  std::fill_n(tile.pixels.transmittance[b], BLOCK_PIXELS, 1.0f);
  for (auto& channel : tile.pixels.front) std::fill_n(channel[b], BLOCK_PIXELS, 0.0f);
}

void start_back(TileLayers& tile, int b, uint32_t count, const float* background) {
  tile.back_begin[b] = count;
  for (int channel = 0; channel < 3; channel++)
    std::fill_n(tile.pixels.back[channel][b], BLOCK_PIXELS, background[channel]);
}

struct Limits {
  uint32_t front[BLOCKS], back[BLOCKS];
};

// The last place at which the front layer of a block may end, and the one at which its back layer has to begin.
Limits find_limits(const CachedTile& cached, const Ends& ends, uint32_t blocks, TileLayers& tile) {
  Limits limits;
  const auto cell_behind = [&](uint32_t place) { return std::min(cached.count, (place + CELL - 1) / CELL * CELL); };
  for_blocks(blocks, [&](int b) {
    limits.front[b] = cached.count;
    limits.back[b] = 0;
    tile.cell_depth[b] = NEAREST;
  });
  for (uint32_t e : cached.active)
    for_blocks(cached.blocks[e] & blocks, [&](int b) {
      limits.front[b] = std::min(limits.front[b], e);
      limits.back[b] = cell_behind(e + 1);
    });
  for (int i = 0; i < ends.firsts; i++) {
    if (!(ends.first[i].blocks & blocks)) continue;
    const uint32_t nearer = cached.nearer(ends.first[i].depth);
    for_blocks(ends.first[i].blocks & blocks, [&](int b) {
      limits.front[b] = std::min(limits.front[b], nearer - std::min(nearer, tile.spare[b]));
    });
  }
  for (int i = 0; i < ends.lasts; i++) {
    if (!(ends.last[i].blocks & blocks)) continue;
    const uint32_t behind = cell_behind(cached.not_farther(ends.last[i].depth));
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

// Moves the ends of the layers of these blocks to the limits; notes in `turns` what each part of the list now becomes.
void move_ends(const Limits& limits, uint32_t blocks, TileLayers& tile, Turn* turns) {
  for_blocks(tile.settled, [&](int b) {
    const uint32_t bit = 1u << b;
    if (blocks & bit) {
      const uint32_t front = std::min(std::max(limits.front[b], tile.front_end[b]), limits.back[b]);
      turns[tile.front_end[b]].front ^= bit;
      turns[front].front ^= bit;
      turns[limits.back[b]].back ^= bit;
      turns[tile.back_begin[b]].back ^= bit;
      tile.front_end[b] = front;
      tile.back_begin[b] = limits.back[b];
    }
    turns[tile.front_end[b]].between ^= bit;
    turns[tile.back_begin[b]].between ^= bit;
  });
}

// Divides the frozen entries of the cached list between what joins the layers and what lies between them.
void deal_out(const CachedTile& cached, const Turn* turns, TileLayers& tile, Workspace& work) {
  work.front.start(cached.count);
  work.back.start(cached.count);
  TileEntry* entries = tile.entries.require(cached.count);
  uint32_t* blocks = tile.blocks.require(cached.count);
  std::size_t size = 0;
  Turn now{};
  auto active = cached.active.begin();
  for (uint32_t e = 0; e < cached.count; e++) {
    now.front ^= turns[e].front;
    now.between ^= turns[e].between;
    now.back ^= turns[e].back;
    const bool frozen = active == cached.active.end() || *active != e;
    active += !frozen;
    const uint32_t record = cached.entries[e].record, in = frozen ? cached.blocks[e] : 0;
    work.front.add(record, in & now.front, e);
    work.back.add(record, in & now.back, e);
    entries[size] = {record, FROZEN};
    blocks[size] = in & now.between;
    size += blocks[size] != 0;
  }
  tile.size = size;
}

// Remembers behind which depths the active Gaussians have to stay.
void guard_fronts(const CachedTile& cached, const List& front, uint32_t missing, TileLayers& tile) {
  for (std::size_t i = front.size; missing && i-- > 0;) {
    for_blocks(front.blocks[i] & missing, [&](int b) { tile.front_depth[b] = cached.depth(front.places[i]); });
    missing &= ~front.blocks[i];
  }
}

// Blends what became part of the layers.
void extend(const LayerSource& source, std::size_t index, TileLayers& tile, Workspace& work) {
  const int x = static_cast<int>(index) % source.tiles_x * TILE_WIDTH,
            y = static_cast<int>(index) / source.tiles_x * TILE_HEIGHT;
  work.contributed.require(std::max(work.front.size, work.back.size));
  const auto job = [&](const List& list, std::size_t begin, std::size_t end) {
    uint32_t wanted = 0;
    for (std::size_t i = begin; i < end; i++) wanted |= list.blocks[i];
    return LayerJob{source.records, x,           y,
                    &list.entries[begin], &list.blocks[begin], end - begin,
                    work.contributed.data(), wanted, &tile.pixels};
  };
  if (work.front.size) source.kernels->extend_front(job(work.front, 0, work.front.size));
  for (std::size_t end = work.back.size; end > 0;) {
    std::size_t begin = end - 1;
    while (begin > 0 && work.back.places[begin - 1] / CELL == work.back.places[end - 1] / CELL) begin--;
    source.kernels->extend_back(job(work.back, begin, end));
    end = begin;
  }
}

}  // namespace

void Layers::clear(std::size_t tiles) {
  tiles_.clear();
  tiles_.resize(tiles);
  tiles_.shrink_to_fit();
}

void Layers::freeze() {
  for (const auto& tile : tiles_)
    if (tile) tile->current = 0;
}

void Layers::settle(const LayerSource& source, std::size_t index, uint32_t touched) {
  if (!tiles_[index]) tiles_[index] = std::make_unique<TileLayers>();
  TileLayers& tile = *tiles_[index];
  const Ends ends = find_ends(source, index, touched);
  const uint32_t crossed = find_crossed_fronts(tile, ends), others = find_other_backs(tile, ends, touched);
  const uint32_t blocks = (touched & ~tile.current) | crossed | others;
  if (!blocks) return;
  const CachedTile cached(source, index);
  for_blocks(crossed, [&](int b) { tile.spare[b] = std::max(2 * tile.spare[b], LEAST_SPARE); });
  const uint32_t fresh = blocks & ~tile.settled;
  tile.settled |= blocks;
  const Limits limits = find_limits(cached, ends, blocks, tile);
  // What the front hides was never made part of the back: they start anew together.
  for_blocks(blocks, [&](int b) {
    const bool anew = (fresh | crossed) >> b & 1u;
    if (anew) start_front(tile, b);
    if (anew || limits.back[b] > tile.back_begin[b]) start_back(tile, b, cached.count, source.background);
  });
  Workspace& work = workspace();
  work.turns.assign(cached.count + 1, Turn{});
  move_ends(limits, blocks, tile, work.turns.data());
  deal_out(cached, work.turns.data(), tile, work);
  guard_fronts(cached, work.front, blocks, tile);
  extend(source, index, tile, work);
  tile.current |= blocks;
}

std::size_t Layers::bytes() const {
  std::size_t bytes = tiles_.capacity() * sizeof tiles_[0];
  for (const auto& tile : tiles_)
    if (tile) bytes += tile->bytes();
  return bytes;
}

}  // namespace gsstream_cpu
