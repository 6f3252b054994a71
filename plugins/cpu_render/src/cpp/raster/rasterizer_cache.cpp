// The rasteriser's cache after its forward: changing rows, differentiating it, and what memory it takes.
#include <algorithm>
#include <atomic>
#include <stdexcept>
#include <string>

#include "raster/claim.hpp"
#include "runtime/parallel.hpp"
#include "raster/rasterizer.hpp"

namespace gsstream_cpu {
namespace {

ScreenPass& screen_workspace() {
  thread_local ScreenPass own;
  return own;
}

}  // namespace

void PassMemory::release() {
  visible.release();
  active.release();
  merged.release();
  contributed.release();
  trace.transmittance.release();
  trace.last.release();
}

uint32_t Rasterizer::update(const uint32_t* changed, const Scene& rows, const Target& target) {
  const Claim claim(owner_);
  expect("update");
  set_active(changed, rows.count, "update: changed");
  drop_layers();
  passes_++;
  const uint32_t faults = list_active(rows, cached_selection_);
  if (faults) return faults;
  ActiveEntries before;
  std::vector<uint32_t> touched;
  before.find(cached_lists_.view(), tiles_of_active(), is_active_);
  before.touched(cached_lists_.view(), touched);
  add_touched_blocks(pass_->active, touched);
  replace_tiles(touched);
  for (uint32_t row : active_rows_) cached_visible_.erase(row);
  for (std::size_t i = 0; i < pass_->visible.count; i++) cached_visible_.insert(active_rows_[pass_->visible.rows[i]]);
  touched_.restrict(cached_selection_, touched);
  CompositeJob job =
      composite_job(cached_lists_.view(), touched_, target, cached_lists_.contributed.data(), cached_trace_);
  job.keeps = true;  // the other blocks of a touched tile see the same Gaussians as before
  parallel_for(touched_.active.size(), TILE_GRAIN,
               [&](std::size_t begin, std::size_t end) { composite_kernels_.forward(job, begin, end); });
  return 0;
}

// Merges pass_->active into the cached lists of the changed tiles, by (depth, row), then their records into the cache.
// What the last forward left of blocks that do not change is carried over.
void Rasterizer::replace_tiles(const std::vector<uint32_t>& changed_blocks) {
  const uint32_t base = static_cast<uint32_t>(scene_count_);
  std::vector<TileEntry> entries;
  std::vector<uint32_t> blocks, contributed, place;  // place: of the entries before, where they are now
  const auto row_of = [&](uint32_t record) { return record < base ? record : active_rows_[record - base]; };
  const auto in_front = [&](uint32_t a, uint32_t b) {
    const float near = records_[a].depth, far = records_[b].depth;
    return near != far ? near < far : row_of(a) < row_of(b);
  };
  for (std::size_t tile = 0; tile < changed_blocks.size(); tile++) {
    if (!changed_blocks[tile]) continue;
    for (std::vector<uint32_t>* values : {&blocks, &contributed}) values->clear();
    entries.clear();
    place.assign(cached_lists_.end[tile] - cached_lists_.begin[tile], 0);
    uint32_t a = pass_->active.offset[tile], c = cached_lists_.begin[tile];
    const uint32_t a_end = pass_->active.offset[tile + 1], c_end = cached_lists_.end[tile];
    for (;;) {
      while (c < c_end && is_active_[cached_lists_.entries[c].record]) c++;
      if (a == a_end && c == c_end) break;
      const bool take_active =
          c == c_end || (a < a_end && in_front(pass_->active.entries[a].record, cached_lists_.entries[c].record));
      const uint32_t record = take_active ? pass_->active.entries[a].record : cached_lists_.entries[c].record;
      if (!take_active) place[c - cached_lists_.begin[tile]] = static_cast<uint32_t>(entries.size());
      entries.push_back({row_of(record), FROZEN});
      contributed.push_back(take_active ? 0 : cached_lists_.contributed[c] & ~changed_blocks[tile]);
      blocks.push_back(take_active ? pass_->active.blocks[a++] : cached_lists_.blocks[c++]);
    }
    renumber_last(tile, changed_blocks[tile], place);
    cached_lists_.replace(tile, entries, blocks, contributed);
  }
  for (std::size_t slot = 0; slot < active_rows_.size(); slot++) records_[active_rows_[slot]] = records_[base + slot];
}

// The entries at which pixels of the other blocks of a tile took their last light, counted in its new list.
void Rasterizer::renumber_last(std::size_t tile, uint32_t changed, const std::vector<uint32_t>& place) {
  int32_t* last = cached_trace_.last.data() + tile * BLOCKS * BLOCK_PIXELS;
  for (uint32_t kept = cached_selection_.blocks[tile] & ~changed; kept; kept &= kept - 1) {
    int32_t* pixels = last + __builtin_ctz(kept) * BLOCK_PIXELS;
    for (int i = 0; i < BLOCK_PIXELS; i++)
      if (pixels[i] != INT32_MAX) pixels[i] = static_cast<int32_t>(place[static_cast<std::size_t>(pixels[i] - 1)]) + 1;
  }
}

void Rasterizer::backward_cached(const Scene& scene, const float* image_gradient, float* means2d_gradient) {
  const Claim claim(owner_);
  expect("backward_cached");
  differentiate_cached(scene, image_gradient, means2d_gradient, false);
}

std::size_t Rasterizer::backward_cached_rows(const Scene& scene, const float* image_gradient) {
  const Claim claim(owner_);
  expect("backward_cached");
  differentiate_cached(scene, image_gradient, nullptr, true);
  return reached_count_;
}

void Rasterizer::reached_rows(int64_t* rows, float* means2d_gradient) const {
  std::copy_n(reached_rows_.data(), reached_count_, rows);
  std::copy_n(reached_gradient_.data(), 2 * reached_count_, means2d_gradient);
}

// Where `compact`, the gradients of the reached rows and which they are, are kept for reached_rows.
void Rasterizer::differentiate_cached(const Scene& scene, const float* image_gradient, float* means2d_gradient,
                                      bool compact) {
  if (scene.count != scene_count_)
    throw std::invalid_argument("backward_cached: expected the scene of the cached forward pass with " +
                                std::to_string(scene_count_) + " rows, got " + std::to_string(scene.count) + ".");
  TileSelection reached, wanted;
  select_nonzero(image_gradient, camera_.width, camera_.height, reached);
  wanted.restrict(cached_selection_, reached.blocks);
  ScreenPass& screen = screen_workspace();
  Buffer<float>& moments = moment_workspace();
  screen.build(cached_lists_, wanted, scene_count_);
  CompositeJob job{};
  job.records = records_.data();
  job.lists = {cached_lists_.begin.data(), cached_lists_.end.data(), screen.entries.data(),
               cached_lists_.blocks.data()};
  job.tiles = wanted.active.data();
  job.tile_blocks = wanted.blocks.data();
  job.tiles_x = wanted.tiles_x;
  job.width = camera_.width;
  job.height = camera_.height;
  std::copy_n(cached_background_, 3, job.background);
  job.contributed = cached_lists_.contributed.data();
  job.pixel_transmittance = cached_trace_.transmittance.data();
  job.pixel_last = cached_trace_.last.data();
  const CompositeBackwardJob raster{job, image_gradient, nullptr,
                                    moments.require(screen.pair_count * MOMENT_STRIDE)};
  parallel_for(wanted.active.size(), TILE_GRAIN,
               [&](std::size_t begin, std::size_t end) { composite_kernels_.backward(raster, begin, end); });
  if (compact) {
    reached_count_ = screen.count;
    std::copy_n(screen.rows.data(), screen.count, reached_rows_.require(screen.count));
    means2d_gradient = reached_gradient_.require(2 * screen.count);
  } else {
    std::fill_n(means2d_gradient, 2 * scene_count_, 0.0f);
  }
  GradientArrays out{};
  out.means2d = means2d_gradient;
  const ProjectBackwardJob rows{scene.arrays,           camera_,         screen.count, screen.rows.data(),
                                screen.offset.data(),  moments.data(), out,           compact};
  parallel_for(screen.count, BACKWARD_GRAIN, [&](std::size_t begin, std::size_t end) {
    project_backward_kernels_.backward[scene.sh_degree](rows, begin, end);
  });
}

void Rasterizer::visible_in_cache(uint8_t* out) const {
  for (std::size_t row = 0; row < scene_count_; row++) out[row] = cached_visible_.contains(static_cast<uint32_t>(row));
}

void Rasterizer::contributing_in_cache(const uint8_t* mask, uint8_t* out) {
  expect("contributing_in_cache");
  std::fill_n(out, scene_count_, uint8_t{0});
  add_drawn(mask, out);
}

void Rasterizer::add_drawn(const uint8_t* mask, uint8_t* out) {
  const Claim claim(owner_);
  const TileSelection wanted = cached_tiles(mask, "contributing_in_cache");
  for (uint32_t tile : wanted.active)
    for (uint32_t e = cached_lists_.begin[tile]; e < cached_lists_.end[tile]; e++)
      if (cached_lists_.contributed[e] & wanted.blocks[tile])
        std::atomic_ref(out[cached_lists_.entries[e].record]).store(1, std::memory_order_relaxed);
}

void Rasterizer::free_scratch() {
  const Claim claim(owner_);
  if (state_ != State::empty) state_ = State::cached;
  own_.release();
  moment_workspace().release();
  reached_rows_.release();
  reached_gradient_.release();
  reached_count_ = 0;
  drop_layers();
  layers_.release();
  frozen_lists_.release();
}

std::size_t Rasterizer::cache_bytes() const {
  return records_.bytes() + cached_lists_.bytes() + cached_trace_.bytes() + cached_visible_.bytes();
}

std::size_t Rasterizer::memory_bytes() const {
  return cache_bytes() + own_.bytes() + reached_rows_.bytes() + reached_gradient_.bytes() +
         active_rows_.capacity() * sizeof(uint32_t) + is_active_.capacity() + active_in_cache_.bytes() +
         layers_.bytes() + layer_pixels_.capacity() * sizeof layer_pixels_[0] + frozen_lists_.bytes();
}

}  // namespace gsstream_cpu
