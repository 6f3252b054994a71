// A pass of the active rows over layers of the frozen ones.
#include <algorithm>

#include "raster/claim.hpp"
#include "raster/rasterizer.hpp"
#include "runtime/parallel.hpp"

namespace gsstream_cpu {

uint32_t Rasterizer::forward_layered(const Scene& rows, const Target& target, const uint8_t* mask) {
  const Claim claim(owner_);
  expect("forward_layered");
  const uint32_t faults = begin_active(rows, true, mask);
  if (faults) return faults;
  settle_layers(target.background);
  const TileListsView lists = place_layered_lists();
  job_ = composite_job(lists, touched_, target, pass_->contributed.require(entry_count_), pass_->trace);
  job_.layers = layer_pixels_.data();
  parallel_for(touched_.active.size(), TILE_GRAIN, [&](std::size_t begin, std::size_t end) {
    for (std::size_t slot = begin; slot < end; slot++) merge_layered_tile(touched_.active[slot]);
    composite_kernels_.forward(job_, begin, end);
  });
  state_ = State::layered_passed;
  return 0;
}

void Rasterizer::drop_layers() {
  layers_.drop();
  active_in_cache_.clear();
}

void Rasterizer::settle_layers(const float* background) {
  const std::size_t tiles = touched_.blocks.size();
  if (!layers_.valid() || !std::equal(background, background + 3, layer_background_)) {
    layers_.clear(tiles);
    std::copy_n(background, 3, layer_background_);
  }
  const LayerSource source{&composite_kernels_, records_.data(), cached_lists_.view(), &active_in_cache_,
                           &pass_->active,      touched_.tiles_x, {background[0], background[1], background[2]}};
  layer_pixels_.assign(tiles, nullptr);
  parallel_for(touched_.active.size(), TILE_GRAIN, [&](std::size_t begin, std::size_t end) {
    for (std::size_t slot = begin; slot < end; slot++) {
      const uint32_t tile = touched_.active[slot];
      layers_.settle(source, tile, touched_.blocks[tile]);
      layer_pixels_[tile] = &layers_[tile].pixels;
    }
  });
}

// Room in pass_->merged for what lies between the layers of each touched tile and for the active entries.
TileListsView Rasterizer::place_layered_lists() {
  const std::size_t tiles = touched_.blocks.size();
  std::size_t total = 0;
  uint32_t* offset = pass_->merged.offset.require(tiles + 1);
  for (std::size_t tile = 0; tile < tiles; tile++) {
    offset[tile] = static_cast<uint32_t>(total);
    if (touched_.blocks[tile])
      total += layers_[tile].size + pass_->active.offset[tile + 1] - pass_->active.offset[tile];
  }
  offset[tiles] = static_cast<uint32_t>(total);
  pass_->merged.resize(tiles, total);
  entry_count_ = total;
  return pass_->merged.view();
}

void Rasterizer::merge_layered_tile(std::size_t tile) {
  const TileLayers& between = layers_[tile];
  merge_tile({between.entries.data(), between.blocks.data(), between.size}, pass_->active.slice(tile),
             {records_.data(), static_cast<uint32_t>(scene_count_), active_rows_.data()}, pass_->merged,
             pass_->merged.offset[tile]);
}

}  // namespace gsstream_cpu
