#include "raster/layers.hpp"

#include <algorithm>
#include <cstring>

#include "raster/layer_limits.hpp"

namespace gsstream_cpu {
namespace {

constexpr uint32_t LEAST_SPARE = 8;  // entries

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

// Blocks for which the front, the list between the layers or the back begins or ends at one place of the cached list.
struct Turn {
  uint32_t front, between, back;
};

// Memory of one thread, kept between calls.
struct Workspace {
  List front, between, back;
  std::vector<Turn> turns;
  Buffer<uint32_t> contributed;
};

Workspace& workspace() {
  thread_local Workspace own;
  return own;
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
void deal_out(const CachedTile& cached, const Turn* turns, Workspace& work) {
  for (List* list : {&work.front, &work.between, &work.back}) list->start(cached.count);
  const auto turns_at = [&](uint32_t e) { return turns[e].front | turns[e].between | turns[e].back; };
  uint32_t begin = 0, end = cached.count;  // nothing is dealt before the first turn, nor behind the last
  while (begin < end && !turns_at(begin)) begin++;
  while (end > begin && !turns_at(end)) end--;
  Turn now{};
  auto active = std::lower_bound(cached.active.begin(), cached.active.end(), begin);
  for (uint32_t e = begin; e < end; e++) {
    now.front ^= turns[e].front;
    now.between ^= turns[e].between;
    now.back ^= turns[e].back;
    const bool frozen = active == cached.active.end() || *active != e;
    active += !frozen;
    const uint32_t record = cached.entries[e].record, in = frozen ? cached.blocks[e] : 0;
    work.front.add(record, in & now.front, e);
    work.between.add(record, in & now.between, e);
    work.back.add(record, in & now.back, e);
  }
}

void keep_between(const List& between, TileLayers& tile) {
  tile.size = between.size;
  if (!tile.size) return;
  std::memcpy(tile.entries.require(tile.size), between.entries.data(), tile.size * sizeof(TileEntry));
  std::memcpy(tile.blocks.require(tile.size), between.blocks.data(), tile.size * sizeof(uint32_t));
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
  tiles_.resize(tiles);
  for (auto& tile : tiles_) {
    if (tile && !tile->settled) tile.reset();  // not used since the last clear: what changes has moved on
    if (tile) tile->settled = tile->current = 0;
  }
  valid_ = true;
}

void Layers::release() {
  tiles_.clear();
  tiles_.shrink_to_fit();
  valid_ = false;
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
  for_blocks(blocks & ~tile.settled, [&](int b) { tile.spare[b] = 0; });
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
  deal_out(cached, work.turns.data(), work);
  keep_between(work.between, tile);
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
