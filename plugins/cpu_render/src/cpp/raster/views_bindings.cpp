// What all cameras of a rig do with their caches, at the same time: each view is one thread's, so that nobody waits
// within a view. The same bits as one after the other.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

#include "fit/comparison_arrays.hpp"
#include "raster/rasterizer.hpp"
#include "raster/scene_arrays.hpp"
#include "raster/view_arrays.hpp"
#include "runtime/bindings.hpp"
#include "runtime/parallel.hpp"

namespace nb = nanobind;

namespace gsstream_cpu {
namespace {

using Updated = std::tuple<nb::object, FloatArray, std::optional<FloatArray>>;  // rasteriser, image, transmittance
using Asked = std::tuple<nb::object, ByteArray>;                 // rasteriser, tiles

// Fault bits of all views. Views without a fault are changed, also where another one has a fault.
uint32_t update_views(const std::vector<Updated>& views, IndexArray changed, const SceneArrays& rows,
                      ConstFloatArray background) {
  require(changed.ndim() == 1 && changed.shape(0) == rows.scene.count, "expected one row per changed id");
  std::vector<Rasterizer*> rasterizers;
  std::vector<Target> targets;
  for (const auto& [object, image, transmittance] : views) {
    Rasterizer& rasterizer = native_rasterizer(object);
    targets.push_back(make_target(background, image, transmittance, rasterizer.width(), rasterizer.height()));
    rasterizers.push_back(&rasterizer);
  }
  std::vector<uint32_t> faults(views.size());
  const uint32_t* ids = changed.data();
  const nb::gil_scoped_release released;
  parallel_for(views.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t view = begin; view < end; view++)
      faults[view] = rasterizers[view]->update(ids, rows.scene, targets[view]);
  });
  uint32_t all = 0;
  for (uint32_t fault : faults) all |= fault;
  return all;
}

// out[row] = 1 where a row is drawn in a marked tile of some view.
void drawn_in_views(const std::vector<Asked>& views, ByteOutArray out) {
  std::vector<Rasterizer*> rasterizers;
  std::vector<const uint8_t*> masks;
  for (const auto& [object, tiles] : views) {
    Rasterizer& rasterizer = native_rasterizer(object);
    require_shape(out, {rasterizer.scene_count()}, "out");
    rasterizers.push_back(&rasterizer);
    masks.push_back(mask_data(tiles, rasterizer.width(), rasterizer.height()));
  }
  uint8_t* result = out.data();
  const std::size_t rows = out.size();
  const nb::gil_scoped_release released;
  std::fill_n(result, rows, uint8_t{0});
  parallel_for(views.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t view = begin; view < end; view++) rasterizers[view]->add_drawn(masks[view], result);
  });
}

// Rasterizer::freeze of several views, all tiles, the same rows.
void freeze_views(const std::vector<nb::object>& views, IndexArray active) {
  require(active.ndim() == 1, "active_ids must be [A]");
  std::vector<Rasterizer*> rasterizers;
  for (const nb::object& object : views) rasterizers.push_back(&native_rasterizer(object));
  const uint32_t* ids = active.data();
  const std::size_t count = active.shape(0);
  const nb::gil_scoped_release released;
  parallel_for(views.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t view = begin; view < end; view++) rasterizers[view]->freeze(nullptr, ids, count);
  });
}

}  // namespace

void bind_views(nb::module_& module) {
  const auto strict = [](const char* name) { return nb::arg(name).noconvert(); };
  module.def("update_views", &update_views, nb::arg("views"), strict("changed"), nb::arg("scene"), strict("background"),
             "Rasterizer.update of several views; returns the FAULT_* bits of all.");
  module.def("freeze_views", &freeze_views, nb::arg("views"), strict("active"),
             "Rasterizer.freeze of several views, in all tiles, to the same rows.");
  module.def("drawn_in_views", &drawn_in_views, nb::arg("views"), strict("out"),
             "The rows that Rasterizer.contributing_in_cache names in any of several views.");
}

}  // namespace gsstream_cpu
