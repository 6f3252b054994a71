// The rasteriser of one camera: runs the stages, owns their scratch and, in the incremental mode, the cached scene.
//
//   full path         forward -> backward
//   incremental mode  forward (fills the cache) -> freeze -> { forward_active -> backward_active }* -> commit -> freeze
//   ...
//
// The incremental mode gives the same bits as the full path over the same tiles, without any cost that grows with the
// number of frozen Gaussians. Results do not depend on the number of threads. Not re-entrant: concurrent use of one
// object throws std::runtime_error.
#pragma once
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "buffer.hpp"
#include "raster_kernels.hpp"
#include "raster_types.hpp"
#include "tile_lists.hpp"
#include "tile_selection.hpp"

namespace gsstream_cpu {

struct Scene {
  GaussianArrays arrays{};
  std::size_t count = 0;
  int sh_degree = 0;
};

struct Target {
  float background[3];
  float *image, *transmittance;
};

class Rasterizer {
 public:
  Rasterizer();
  ~Rasterizer();

  // Forward passes return Fault bits; if any is set nothing was rendered and the cache is as before (active) or empty.
  // The arrays of `scene` are read again by the matching backward.
  uint32_t forward(const Scene& scene, const Camera& camera, const uint8_t* mask, const Target& target);
  // With `touched_only`, only blocks that the active rows touch now or touched in the cache are rendered: all others
  // would come out as they are in the cache.
  uint32_t forward_active(const Scene& rows, const Target& target, bool touched_only);
  // Renders from the cache alone (no projection, no gradients).
  void forward_cached(const uint8_t* mask, const Target& target);

  // Ends the life of the arrays given to the last forward; no backward may follow.
  void forget() { mode_ = Mode::none; }
  // out.means null: only out.means2d is written. Outputs have one row per Gaussian (zero where unseen), or with
  // `compact` one per visible_rows().
  void backward(const float* image_gradient, const float* alpha_gradient, const GradientArrays& out, bool compact);
  // Outputs have one row per active row.
  void backward_active(const float* image_gradient, const float* alpha_gradient, const GradientArrays& out);

  // active: strictly ascending rows of the cached scene.
  void freeze(const uint8_t* mask, const uint32_t* active, std::size_t count);
  // Puts the final values of the active rows into the cache. Ends the freeze.
  uint32_t commit(const Scene& rows);

  const VisibleSet& visible() const { return visible_; }
  std::size_t pair_count() const { return visible_.pair_count; }
  std::size_t entry_count() const { return lists_ ? lists_->size : 0; }
  std::size_t scene_count() const { return scene_count_; }
  std::size_t active_count() const { return active_rows_.size(); }
  int width() const { return camera_.width; }
  int height() const { return camera_.height; }
  Isa isa() const { return isa_; }
  uint64_t passes() const { return passes_; }
  std::size_t memory_bytes() const;

 private:
  enum class Mode { none, full, active };
  class Claim;

  uint32_t project(const Scene& scene, const TileSelection& selection, Record* records);
  void join_chunks(std::size_t chunks);
  uint32_t list_active(const Scene& rows, const TileSelection& selection);
  void composite(const TileLists& lists, const TileSelection& selection, const Target& target);
  void differentiate(Mode mode, const float* image_gradient, const float* alpha_gradient, const GradientArrays& out,
                     bool compact);
  void clear_gradients(const GradientArrays& out) const;

  const Isa isa_;  // one object uses one set for life: moments are laid out per set
  const ProjectKernels& project_kernels_;
  const ProjectBackwardKernels& project_backward_kernels_;
  const CompositeKernels& composite_kernels_;
  std::atomic<bool> busy_{false};
  uint64_t passes_ = 0;
  Mode mode_ = Mode::none;

  Camera camera_{};
  Scene scene_;  // of the last forward
  CompositeJob job_{};
  std::size_t job_tiles_ = 0;
  TileSelection selection_;
  TileSelection touched_;  // of the last active pass with touched_only
  std::vector<uint32_t> dropped_blocks_;

  std::unique_ptr<ProjectChunk[]> chunks_;
  std::size_t chunk_capacity_ = 0;
  VisibleSet visible_;
  Buffer<DepthItem> sort_scratch_;
  Buffer<uint32_t> contributed_;
  Buffer<float> pixel_transmittance_, moments_;
  Buffer<int32_t> pixel_last_;
  const TileLists* lists_ = nullptr;  // of the last forward

  // The cache: records of all Gaussians (then of the active rows) and depth-sorted lists of the whole scene.
  bool cached_ = false, frozen_ = false;
  std::size_t scene_count_ = 0;
  Buffer<Record> records_;
  TileSelection cached_selection_;
  TileLists cached_lists_, frozen_lists_, active_lists_, merged_lists_;
  std::vector<uint32_t> active_rows_;
  std::vector<uint8_t> is_active_;
};

}  // namespace gsstream_cpu
