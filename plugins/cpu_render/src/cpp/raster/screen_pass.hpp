// Which Gaussians and pairs the backward of an image gradient reaches, when most of that gradient is zero.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "runtime/buffer.hpp"
#include "raster/raster_types.hpp"
#include "raster/tile_selection.hpp"
#include "raster/tile_store.hpp"

namespace gsstream_cpu {

// A set of rows that can tell the rank of each of its members.
class RowSet {
 public:
  void clear(std::size_t rows) {
    bits_.assign((rows + 63) / 64, 0);
    before_.clear();
  }
  void insert(uint32_t row) { bits_[row / 64] |= uint64_t{1} << row % 64; }
  void erase(uint32_t row) { bits_[row / 64] &= ~(uint64_t{1} << row % 64); }
  bool contains(uint32_t row) const { return bits_[row / 64] >> row % 64 & 1; }
  // Counts the members; to be called after the last insert, before rank.
  std::size_t rank_all();
  // Number of members below `row`.
  uint32_t rank(uint32_t row) const {
    return before_[row / 64] +
           static_cast<uint32_t>(__builtin_popcountll(bits_[row / 64] & ((uint64_t{1} << row % 64) - 1)));
  }
  // Writes the members in ascending order.
  void list(uint32_t* out) const;
  std::size_t bytes() const { return bits_.capacity() * sizeof(uint64_t) + before_.capacity() * sizeof(uint32_t); }

 private:
  std::vector<uint64_t> bits_;
  std::vector<uint32_t> before_;  // members in the words before each word
};

// The reached entries of some tiles with places for their moments, contiguous per Gaussian in tile order.
struct ScreenPass {
  RowSet reached;
  std::size_t count = 0, pair_count = 0;
  Buffer<uint32_t> rows, offset, next;  // [count], [count+1], [count]
  Buffer<TileEntry> entries;            // those of the store, with pairs; FROZEN where not reached
  std::size_t bytes() const {
    return reached.bytes() + rows.bytes() + offset.bytes() + next.bytes() + entries.bytes();
  }
  void build(const TileStore& store, const TileSelection& selection, std::size_t scene_rows);
};

// Blocks in which the gradient [H,W,3] is not zero (NaN is not zero).
void select_nonzero(const float* image_gradient, int width, int height, TileSelection& out);

}  // namespace gsstream_cpu
