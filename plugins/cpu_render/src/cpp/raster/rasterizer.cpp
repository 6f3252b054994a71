#include "raster/rasterizer.hpp"

#include <algorithm>
#include <cstring>
#include <iterator>
#include <stdexcept>
#include <string>

#include "raster/claim.hpp"
#include "runtime/parallel.hpp"

namespace gsstream_cpu {
namespace {

constexpr std::size_t CLEAR_GRAIN = 16384;  // rows

// Memory of one call, kept by the thread that calls: what a view needs here, the next one needs, too.
struct Workspace {
  std::unique_ptr<ProjectChunk[]> chunks;
  std::size_t chunk_capacity = 0;
  Buffer<DepthItem> sort;
};

Workspace& workspace() {
  thread_local Workspace own;
  return own;
}

std::size_t chunk_count(std::size_t rows) { return (rows + PROJECT_CHUNK - 1) / PROJECT_CHUNK; }

// The results of chunks, one after the other.
void join_chunks(const ProjectChunk* chunk, std::size_t chunks, VisibleSet& visible) {
  std::vector<std::size_t> first_visible(chunks + 1, 0), first_pair(chunks + 1, 0);
  for (std::size_t c = 0; c < chunks; c++) {
    first_visible[c + 1] = first_visible[c] + chunk[c].visible;
    first_pair[c + 1] = first_pair[c] + chunk[c].pairs.size;
  }
  visible.count = first_visible[chunks];
  visible.pair_count = first_pair[chunks];
  if (visible.pair_count >= FROZEN)
    throw std::length_error("expected fewer than 2^32-1 (Gaussian, tile) pairs, got " +
                            std::to_string(visible.pair_count) +
                            ". Are the scales in log units of the scene? Render fewer or smaller Gaussians.");
  visible.rows.require(visible.count);
  visible.pair_offset.require(visible.count + 1);
  visible.by_depth.require(visible.count);
  visible.pairs.require(visible.pair_count);
  visible.pair_offset[visible.count] = static_cast<uint32_t>(visible.pair_count);
  parallel_for(chunks, 4, [&](std::size_t begin, std::size_t end) {
    for (std::size_t c = begin; c < end; c++) {
      const ProjectChunk& one = chunk[c];
      if (one.pairs.size)
        std::memcpy(&visible.pairs[first_pair[c]], one.pairs.data, one.pairs.size * sizeof(Pair));
      uint32_t pair = static_cast<uint32_t>(first_pair[c]);
      for (uint32_t i = 0; i < one.visible; i++) {
        const uint32_t slot = static_cast<uint32_t>(first_visible[c]) + i;
        visible.rows[slot] = one.row[i];
        visible.by_depth[slot] = {one.depth_bits[i], slot};
        visible.pair_offset[slot] = pair;
        pair += one.pair_count[i];
      }
    }
  });
}

}  // namespace

Buffer<float>& moment_workspace() {
  thread_local Buffer<float> own;
  return own;
}

Rasterizer::Rasterizer()
    : isa_(active_isa()),
      project_kernels_(project_kernels()),
      project_backward_kernels_(project_backward_kernels()),
      composite_kernels_(composite_kernels()) {}
Rasterizer::~Rasterizer() = default;

void Rasterizer::expect(const std::string& operation) const {
  const auto named = [&](const Rule& rule) { return operation == rule.operation; };
  const Rule* rule = std::find_if(std::begin(RULES), std::end(RULES), named);
  if (rule == std::end(RULES)) throw std::invalid_argument("expect: no operation is called '" + operation + "'.");
  const bool frozen = state_ == State::frozen || state_ == State::active_passed || state_ == State::layered_passed;
  const char* missing = nullptr;
  if (rule->needs == State::cached && state_ == State::empty)
    missing = "a forward pass of the whole scene before, got none. Call forward first.";
  if (rule->needs == State::passed && state_ != State::passed)
    missing = "a forward pass before, got none (or another pass since).";
  if (rule->needs == State::frozen && !frozen)
    missing = "freeze(tile_mask, active_ids) before, got none since the last forward or update.";
  if (rule->needs == State::active_passed && state_ != State::active_passed)
    missing = "a forward_active pass before, got none (or another pass since).";
  if (rule->needs == State::layered_passed && state_ != State::layered_passed)
    missing = "a forward_layered pass before, got none (or another pass since).";
  if (missing) throw std::invalid_argument(operation + ": expected " + missing);
}

void Rasterizer::drop_pass() {
  if (state_ == State::passed) state_ = State::cached;
  if (state_ == State::active_passed || state_ == State::layered_passed) state_ = State::frozen;
}

TileSelection Rasterizer::cached_tiles(const uint8_t* mask, const char* operation) const {
  expect(operation);
  TileSelection wanted;
  wanted.build(camera_.width, camera_.height, mask);
  if (!cached_selection_.contains(wanted))
    throw std::invalid_argument(std::string(operation) +
                                ": tile_mask has tiles that the cached forward pass did not cover. Run forward with a "
                                "mask that covers them.");
  return wanted;
}

// Stage 1. Results are in pass_->visible (memory order) and records.
uint32_t Rasterizer::project(const Scene& scene, const TileSelection& selection, Record* records) {
  const std::size_t chunks = chunk_count(scene.count);
  Workspace& work = workspace();
  if (chunks > work.chunk_capacity) {
    work.chunks = std::make_unique<ProjectChunk[]>(chunks);
    work.chunk_capacity = chunks;
  }
  std::size_t pair_count = 0;
  ProjectJob job{scene.arrays,         scene.count,       camera_,
                 selection.tiles_x,    selection.tiles_y, selection.blocks.data(),
                 selection.sum.data(), records,           work.chunks.get(),
                 most_pairs_,          &pair_count};
  parallel_for(chunks, 1,
               [&](std::size_t begin, std::size_t end) { project_kernels_.forward[scene.sh_degree](job, begin, end); });
  uint32_t faults = 0;
  for (std::size_t c = 0; c < chunks; c++) faults |= work.chunks[c].faults;
  if (!faults) join_chunks(work.chunks.get(), chunks, pass_->visible);
  return faults;
}

// Stage 3.
CompositeJob Rasterizer::composite_job(const TileListsView& lists, const TileSelection& selection,
                                       const Target& target, uint32_t* contributed, PixelTrace& trace) const {
  const std::size_t pixels = selection.blocks.size() * BLOCKS * BLOCK_PIXELS;
  CompositeJob job{};
  job.records = records_.data();
  job.lists = lists;
  job.tiles = selection.active.data();
  job.tile_blocks = selection.blocks.data();
  job.tiles_x = selection.tiles_x;
  job.width = camera_.width;
  job.height = camera_.height;
  std::copy_n(target.background, 3, job.background);
  job.image = target.image;
  job.transmittance = target.transmittance;
  job.contributed = contributed;
  job.pixel_transmittance = trace.transmittance.require(pixels);
  job.pixel_last = trace.last.require(pixels);
  return job;
}

CompositeJob Rasterizer::composite(const TileListsView& lists, const TileSelection& selection, const Target& target,
                                   uint32_t* contributed, PixelTrace& trace) {
  const CompositeJob job = composite_job(lists, selection, target, contributed, trace);
  parallel_for(selection.active.size(), TILE_GRAIN,
               [&](std::size_t begin, std::size_t end) { composite_kernels_.forward(job, begin, end); });
  return job;
}

uint32_t Rasterizer::forward(const Scene& scene, const Camera& camera, const uint8_t* mask, const Target& target) {
  const Claim claim(owner_);
  state_ = State::empty;
  passes_++;
  camera_ = camera;
  selection_.build(camera.width, camera.height, mask);
  const uint32_t faults = project(scene, selection_, records_.require(scene.count));
  if (faults) return faults;
  sort_by_depth(pass_->visible.by_depth, workspace().sort, pass_->visible.count);
  build_tile_lists(pass_->visible, selection_.blocks.size(), 0, pass_->merged);
  entry_count_ = pass_->merged.size;
  drop_layers();
  layers_.release();
  cached_lists_.adopt(pass_->merged);
  job_ = composite(cached_lists_.view(), selection_, target, cached_lists_.contributed.data(), cached_trace_);
  job_tiles_ = selection_.active.size();
  cached_visible_.clear(scene.count);
  for (std::size_t i = 0; i < pass_->visible.count; i++) cached_visible_.insert(pass_->visible.rows[i]);
  scene_ = scene;
  scene_count_ = scene.count;
  cached_selection_ = selection_;
  std::copy_n(target.background, 3, cached_background_);
  state_ = State::passed;
  return 0;
}

void Rasterizer::freeze(const uint8_t* mask, const uint32_t* active, std::size_t count) {
  const Claim claim(owner_);
  TileSelection wanted = cached_tiles(mask, "freeze");
  if (set_active(active, count, "freeze: active_ids") && active_in_cache_.any()) {
    active_in_cache_.keep(cached_lists_.view(), is_active_);
    layers_.freeze();
  } else {
    drop_layers();
    active_in_cache_.find(cached_lists_.view(), tiles_of_active(), is_active_);
  }
  active_in_cache_.touched(cached_lists_.view(), dropped_blocks_);
  selection_ = std::move(wanted);
  frozen_listed_ = false;
  state_ = State::frozen;
}

// Returns whether all of these rows were active before.
bool Rasterizer::set_active(const uint32_t* active, std::size_t count, const char* name) {
  for (std::size_t i = 0; i < count; i++)
    if (active[i] >= scene_count_ || (i > 0 && active[i] <= active[i - 1]))
      throw std::invalid_argument(std::string(name) + " must be strictly ascending rows below " +
                                  std::to_string(scene_count_) + ", got " + std::to_string(active[i]) + " at index " +
                                  std::to_string(i) + ". Sort them and drop duplicates.");
  state_ = State::cached;
  is_active_.resize(scene_count_, 0);
  const bool fewer = std::all_of(active, active + count, [&](uint32_t row) { return is_active_[row]; });
  for (uint32_t row : active_rows_)
    if (row < is_active_.size()) is_active_[row] = 0;
  active_rows_.assign(active, active + count);
  for (uint32_t row : active_rows_) is_active_[row] = 1;
  records_.require_keeping(scene_count_ + count, scene_count_);
  return fewer;
}

// Which tiles' cached lists may hold an active row: 1 or 0.
std::vector<uint8_t> Rasterizer::tiles_of_active() const {
  std::vector<uint8_t> marked(cached_lists_.tiles(), 0);
  for (uint32_t row : active_rows_) {
    if (!cached_visible_.contains(row)) continue;
    const Record& r = records_[row];
    for (int y = r.tile_y0; y <= r.tile_y1; y++)
      for (int x = r.tile_x0; x <= r.tile_x1; x++) marked[static_cast<std::size_t>(y * cached_selection_.tiles_x + x)] = 1;
  }
  return marked;
}

// Projects the active rows and leaves their lists over `selection` in pass_->active.
uint32_t Rasterizer::list_active(const Scene& rows, const TileSelection& selection) {
  const uint32_t base = static_cast<uint32_t>(scene_count_);
  const uint32_t faults = project(rows, selection, records_.data() + base);
  if (faults) return faults;
  sort_by_depth(pass_->visible.by_depth, workspace().sort, pass_->visible.count);
  build_tile_lists(pass_->visible, selection.blocks.size(), base, pass_->active);
  return 0;
}

// Lists the active rows and selects what they touch.
uint32_t Rasterizer::begin_active(const Scene& rows, bool touched_only, const uint8_t* mask) {
  drop_pass();
  passes_++;
  TileSelection fewer;
  if (mask) fewer.build(camera_.width, camera_.height, mask);
  const TileSelection& within = mask ? fewer : selection_;
  const uint32_t faults = list_active(rows, within);
  if (faults) return faults;
  if (touched_only) {
    std::vector<uint32_t> touched = dropped_blocks_;
    add_touched_blocks(pass_->active, touched);
    touched_.restrict(within, touched);
  } else {
    touched_ = within;
  }
  scene_ = rows;
  job_tiles_ = touched_.active.size();
  return 0;
}

uint32_t Rasterizer::forward_active(const Scene& rows, const Target& target, bool touched_only) {
  const Claim claim(owner_);
  expect("forward_active");
  const uint32_t faults = begin_active(rows, touched_only, nullptr);
  if (faults) return faults;
  if (!frozen_listed_) filter_tile_lists(cached_lists_.view(), selection_.blocks, is_active_, frozen_lists_);
  frozen_listed_ = true;
  merge_tile_lists(frozen_lists_, pass_->active, touched_.blocks,
                   {records_.data(), static_cast<uint32_t>(scene_count_), active_rows_.data()}, pass_->merged);
  entry_count_ = pass_->merged.size;
  job_ = composite(pass_->merged.view(), touched_, target, pass_->contributed.require(entry_count_), pass_->trace);
  state_ = State::active_passed;
  return 0;
}

void Rasterizer::forward_cached(const uint8_t* mask, const Target& target) {
  const Claim claim(owner_);
  const TileSelection wanted = cached_tiles(mask, "forward_cached");
  drop_pass();
  passes_++;
  composite(cached_lists_.view(), wanted, target, pass_->contributed.require(cached_lists_.used), pass_->trace);
}

void Rasterizer::clear_gradients(const GradientArrays& out) const {
  const std::size_t rest = 3 * static_cast<std::size_t>((scene_.sh_degree + 1) * (scene_.sh_degree + 1) - 1);
  const std::pair<float*, std::size_t> arrays[] = {{out.means, 3},     {out.quats, 4},   {out.scales, 3},
                                                   {out.opacities, 1}, {out.means2d, 2}, {out.sh0, 3},
                                                   {out.shN, rest}};
  parallel_for(scene_.count, CLEAR_GRAIN, [&](std::size_t begin, std::size_t end) {
    for (const auto& [data, width] : arrays)
      if (data && width) std::memset(data + begin * width, 0, (end - begin) * width * sizeof(float));
  });
}

// Stages 4 and 5.
void Rasterizer::differentiate(const float* image_gradient, const float* alpha_gradient, const GradientArrays& out,
                               bool compact) {
  Buffer<float>& moments = moment_workspace();
  const CompositeBackwardJob raster{job_, image_gradient, alpha_gradient,
                                    moments.require(pass_->visible.pair_count * MOMENT_STRIDE)};
  parallel_for(job_tiles_, TILE_GRAIN,
               [&](std::size_t begin, std::size_t end) { composite_kernels_.backward(raster, begin, end); });
  if (!compact) clear_gradients(out);
  const ProjectBackwardJob job{
      scene_.arrays,   camera_, pass_->visible.count, pass_->visible.rows.data(), pass_->visible.pair_offset.data(),
      moments.data(), out,     compact};
  parallel_for(pass_->visible.count, BACKWARD_GRAIN, [&](std::size_t begin, std::size_t end) {
    project_backward_kernels_.backward[scene_.sh_degree](job, begin, end);
  });
}

void Rasterizer::backward(const float* image_gradient, const float* alpha_gradient, const GradientArrays& out,
                          bool compact) {
  const Claim claim(owner_);
  expect("backward");
  differentiate(image_gradient, alpha_gradient, out, compact);
}

void Rasterizer::backward_active(const float* image_gradient, const float* alpha_gradient, const GradientArrays& out) {
  const Claim claim(owner_);
  expect("backward_active");
  differentiate(image_gradient, alpha_gradient, out, false);
}

void Rasterizer::backward_layered(const float* image_gradient, const GradientArrays& out) {
  const Claim claim(owner_);
  expect("backward_layered");
  differentiate(image_gradient, nullptr, out, false);
}

}  // namespace gsstream_cpu
