// The rasteriser of one camera: runs the stages, owns their scratch and, in the incremental mode, the cached scene.
//
//   full path         forward -> backward
//   incremental mode  forward (fills the cache) -> freeze -> { forward_active -> backward_active }* -> update -> freeze
//   ... for a fit     { forward_layered -> backward_layered }* in the place of { forward_active -> backward_active }*
//   ...               at any time after forward: backward_cached, forward_cached
//
// The incremental mode gives the same bits as the full path over the same tiles, without any cost that grows with the
// number of frozen Gaussians. Results do not depend on the number of threads. Not re-entrant: concurrent use of one
// object throws std::runtime_error.
#pragma once
#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "runtime/buffer.hpp"
#include "raster/active_entries.hpp"
#include "raster/layers.hpp"
#include "raster/raster_kernels.hpp"
#include "raster/raster_types.hpp"
#include "raster/screen_pass.hpp"
#include "raster/tile_lists.hpp"
#include "raster/tile_selection.hpp"
#include "raster/tile_store.hpp"

namespace gsstream_cpu {

constexpr std::size_t TILE_GRAIN = 2;        // tiles that a thread composites or differentiates at a time
constexpr std::size_t BACKWARD_GRAIN = 256;  // visible Gaussians; a multiple of every vector width

struct Scene {
  GaussianArrays arrays{};
  std::size_t count = 0;
  int sh_degree = 0;
};

// Means, quats, scales, opacities, sh0, shN: the order of attributes wherever they are numbered.
constexpr std::size_t ATTRIBUTES = 6;

// Floats of a row of each attribute.
inline std::array<std::size_t, ATTRIBUTES> row_widths(int sh_degree) {
  const std::size_t bases = static_cast<std::size_t>((sh_degree + 1) * (sh_degree + 1));
  return {3, 4, 3, 1, 3, 3 * (bases - 1)};
}

struct Target {
  float background[3];
  float *image, *transmittance;
};

// What a backward needs of the pixels of its forward, tile by tile.
struct PixelTrace {
  Buffer<float> transmittance;
  Buffer<int32_t> last;
  std::size_t bytes() const { return transmittance.bytes() + last.bytes(); }
};

// The moments of a backward, in memory of the calling thread: they are summed up before it returns. free_scratch lets
// go of them.
Buffer<float>& moment_workspace();

// What a pass leaves to its backward, but for the cache.
struct PassMemory {
  VisibleSet visible;
  TileLists active, merged;  // merged also receives the lists of a full pass
  Buffer<uint32_t> contributed;
  PixelTrace trace;
  std::size_t bytes() const {
    return visible.bytes() + active.bytes() + merged.bytes() + contributed.bytes() + trace.bytes();
  }
  void release();
};

class Rasterizer {
 public:
  // What there is to work with. `passed` (a forward whose backward may follow) offers what `cached` does, `frozen` too,
  // `active_passed` and `layered_passed` (a forward_active or forward_layered whose backward may follow) what `frozen`
  // does.
  enum class State { empty, cached, passed, frozen, active_passed, layered_passed };
  // What each operation needs and leaves behind. When it fails, forward leaves `empty`, forward_active and
  // forward_layered leave `frozen`; on `empty`, forget and free_scratch do nothing.
  struct Rule {
    const char* operation;
    State needs;
    const char* leaves;
  };
  static constexpr Rule RULES[] = {
      {"forward", State::empty, "passed"},
      {"backward", State::passed, "the same"},
      {"freeze", State::cached, "frozen"},
      {"forward_active", State::frozen, "active_passed"},
      {"backward_active", State::active_passed, "the same"},
      {"forward_layered", State::frozen, "layered_passed"},
      {"backward_layered", State::layered_passed, "the same"},
      {"update", State::cached, "cached"},
      {"backward_cached", State::cached, "the same"},
      {"contributing_in_cache", State::cached, "the same"},
      {"forward_cached", State::cached, "cached or frozen, without its pass"},
      {"forget", State::empty, "cached or frozen, without its pass"},
      {"free_scratch", State::empty, "cached"},
  };
  // Throws std::invalid_argument unless the state offers what the operation needs.
  void expect(const std::string& operation) const;

  Rasterizer();
  ~Rasterizer();

  // While it lives (claim.hpp), passes work in memory that many rasterisers may use one after the other, and no other
  // thread may use this one. No backward may follow.
  class Loan;

  // Forward passes return Fault bits; if any is set nothing was rendered and the cache is as before (active) or empty.
  // The arrays of `scene` are read again by the matching backward.
  uint32_t forward(const Scene& scene, const Camera& camera, const uint8_t* mask, const Target& target);
  // With `touched_only`, only blocks that the active rows touch now or touched in the cache are rendered: all others
  // would come out as they are in the cache.
  uint32_t forward_active(const Scene& rows, const Target& target, bool touched_only);
  // forward_active with touched_only for the sake of gradients: frozen Gaussians that lie in front of all active ones
  // or behind them are blended once and not in every pass (layers.hpp). `mask`, as forward's: tiles outside it are not
  // rendered either. target.transmittance may be null; if not, it gets
  // what is left in front of the layers behind.
  uint32_t forward_layered(const Scene& rows, const Target& target, const uint8_t* mask = nullptr);
  // Renders from the cache alone (no projection, no gradients).
  void forward_cached(const uint8_t* mask, const Target& target);

  // Gradient of the 2-D means [N,2] of the cached scene, from what its forward left: nothing is rendered. Costs follow
  // the pixels at which the image gradient is not zero. `scene`: the values that the cache was made of.
  void backward_cached(const Scene& scene, const float* image_gradient, float* means2d_gradient);
  // The same of the rows that the image's gradient reaches alone; returns their number. reached_rows writes which they
  // are, ascending, and their gradients [K,2]; it may follow once.
  std::size_t backward_cached_rows(const Scene& scene, const float* image_gradient);
  void reached_rows(int64_t* rows, float* means2d_gradient) const;
  std::size_t reached_count() const { return reached_count_; }
  // out [N]: 1 for the rows of the cached scene that touch a cached tile.
  void visible_in_cache(uint8_t* out) const;
  // out [N]: 1 for the rows of the cached scene that added light to a pixel of a wanted tile. Costs follow these tiles,
  // but for clearing `out`. Border blocks reach beyond the image and are counted whole.
  void contributing_in_cache(const uint8_t* mask, uint8_t* out);
  // The same without clearing `out`, to which other rasterisers may add at the same time.
  void add_drawn(const uint8_t* mask, uint8_t* out);

  // Forward passes of more (Gaussian, tile) pairs than this stop before they are made, with FAULT_PAIRS.
  void limit_pairs(std::size_t most) { most_pairs_ = most; }
  // Ends the life of the arrays given to the last forward; no backward may follow.
  void forget() { drop_pass(); }
  // out.means null: only out.means2d is written. Outputs have one row per Gaussian (zero where unseen), or with
  // `compact` one per visible_rows().
  void backward(const float* image_gradient, const float* alpha_gradient, const GradientArrays& out, bool compact);
  // Outputs have one row per active row.
  void backward_active(const float* image_gradient, const float* alpha_gradient, const GradientArrays& out);

  // As backward_active, after forward_layered.
  void backward_layered(const float* image_gradient, const GradientArrays& out);

  // active: strictly ascending rows of the cached scene.
  void freeze(const uint8_t* mask, const uint32_t* active, std::size_t count);
  // Puts new values of some rows (strictly ascending) into the cache and renders anew, into `target`, the tiles that
  // these rows touched or touch. The cache is then as after a forward of the changed scene. Ends the freeze. Returns
  // Fault bits; if any is set nothing was changed.
  uint32_t update(const uint32_t* changed, const Scene& rows, const Target& target);
  // Lets go of the memory that only a full pass needs. No backward may follow.
  void free_scratch();

  // Tiles rendered by the last forward_active or forward_layered.
  const TileSelection& touched() const { return touched_; }
  const VisibleSet& visible() const { return pass_->visible; }
  std::size_t pair_count() const { return pass_->visible.pair_count; }
  std::size_t entry_count() const { return entry_count_; }
  std::size_t scene_count() const { return scene_count_; }
  std::size_t active_count() const { return active_rows_.size(); }
  const Camera& camera() const { return camera_; }  // of the cache
  int width() const { return camera_.width; }
  int height() const { return camera_.height; }
  Isa isa() const { return isa_; }
  uint64_t passes() const { return passes_; }
  std::size_t memory_bytes() const;  // cache_bytes() and scratch
  std::size_t cache_bytes() const;

 private:
  class Claim;

  // No backward may follow.
  void drop_pass();
  // The selection of the caller's mask. Throws std::invalid_argument where the cache does not cover it.
  TileSelection cached_tiles(const uint8_t* mask, const char* operation) const;

  uint32_t project(const Scene& scene, const TileSelection& selection, Record* records);
  bool set_active(const uint32_t* active, std::size_t count, const char* name);
  std::vector<uint8_t> tiles_of_active() const;
  uint32_t list_active(const Scene& rows, const TileSelection& selection);
  uint32_t begin_active(const Scene& rows, bool touched_only, const uint8_t* mask);
  void drop_layers();
  void settle_layers(const float* background);
  TileListsView place_layered_lists();
  void merge_layered_tile(std::size_t tile);
  CompositeJob composite_job(const TileListsView& lists, const TileSelection& selection, const Target& target,
                             uint32_t* contributed, PixelTrace& trace) const;
  CompositeJob composite(const TileListsView& lists, const TileSelection& selection, const Target& target,
                         uint32_t* contributed, PixelTrace& trace);
  void differentiate_cached(const Scene& scene, const float* image_gradient, float* means2d_gradient, bool compact);
  void replace_tiles(const std::vector<uint32_t>& changed_blocks);
  void renumber_last(std::size_t tile, uint32_t changed, const std::vector<uint32_t>& place);
  void differentiate(const float* image_gradient, const float* alpha_gradient, const GradientArrays& out,
                     bool compact);
  void clear_gradients(const GradientArrays& out) const;

  const Isa isa_;  // one object uses one set for life: moments are laid out per set
  const ProjectKernels& project_kernels_;
  const ProjectBackwardKernels& project_backward_kernels_;
  const CompositeKernels& composite_kernels_;
  std::atomic<std::thread::id> owner_{};  // the thread that runs a call
  std::size_t most_pairs_ = ~std::size_t{0};
  uint64_t passes_ = 0;
  State state_ = State::empty;

  Camera camera_{};
  Scene scene_;  // of the last forward
  CompositeJob job_{};
  std::size_t job_tiles_ = 0, entry_count_ = 0;
  TileSelection selection_;
  TileSelection touched_;  // of the last active pass
  std::vector<uint32_t> dropped_blocks_;  // that the active rows touch in the cache

  PassMemory own_;
  PassMemory* pass_ = &own_;  // or that of a loan
  Buffer<uint32_t> reached_rows_;  // of the last backward_cached_rows, and their gradients
  Buffer<float> reached_gradient_;
  std::size_t reached_count_ = 0;

  // The cache: records of all Gaussians (then of the active rows), depth-sorted lists of the whole scene, what its
  // forward left at the pixels, and who is visible.
  std::size_t scene_count_ = 0;
  Buffer<Record> records_;
  TileSelection cached_selection_;
  float cached_background_[3] = {};
  TileStore cached_lists_;
  PixelTrace cached_trace_;
  RowSet cached_visible_;
  TileLists frozen_lists_;
  std::vector<uint32_t> active_rows_;
  std::vector<uint8_t> is_active_;
  ActiveEntries active_in_cache_;
  bool frozen_listed_ = false;  // frozen_lists_ are those of the last freeze

  Layers layers_;
  float layer_background_[3] = {};
  std::vector<const LayerPixels*> layer_pixels_;
};

}  // namespace gsstream_cpu
