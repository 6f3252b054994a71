#include "fit/whole_pull.hpp"

#include <vector>

#include "fit/colour_map.hpp"
#include "runtime/buffer.hpp"
#include "runtime/parallel.hpp"

namespace gsstream_cpu {
namespace {

constexpr std::size_t ROW_GRAIN = 16;  // rows of pixels
constexpr std::size_t SLOPES = 12;     // entries of a colour map's matrix and offset

// Memory of one calling thread, kept between calls.
struct Workspace {
  Buffer<float> image, recorded, gradient;
  std::vector<uint8_t> all;      // every tile
  std::vector<double> slopes;    // by row of pixels
};

Workspace& workspace() {
  thread_local Workspace own;
  return own;
}

// fn(row, index of its first pixel), row by row.
template <class Fn>
void for_rows(int width, int height, Fn&& fn) {
  parallel_for(static_cast<std::size_t>(height), ROW_GRAIN, [&](std::size_t begin, std::size_t end) {
    for (std::size_t row = begin; row < end; row++) fn(row, row * static_cast<std::size_t>(width));
  });
}

// Pulls the gradient back through the colour map, and finds the map's own slope on the way.
void pull_map(int width, int height, const ViewComparison& view, const float* image, float* gradient, float* colours) {
  const std::size_t pixels = static_cast<std::size_t>(width);
  std::vector<double>& slopes = workspace().slopes;
  slopes.resize(SLOPES * static_cast<std::size_t>(height));
  for_rows(width, height, [&](std::size_t row, std::size_t first) {
    slope_of_colours(image + 3 * first, gradient + 3 * first, pixels, &slopes[SLOPES * row]);
    pull_colours(view.matrix, gradient + 3 * first, pixels);
  });
  for (std::size_t entry = 0; colours && entry < SLOPES; entry++) {
    double sum = 0.0;
    for (std::size_t row = 0; row < static_cast<std::size_t>(height); row++) sum += slopes[SLOPES * row + entry];
    colours[entry] = static_cast<float>(sum);
  }
}

}  // namespace

ViewPull pull_whole(Rasterizer& rasterizer, const Scene& scene, const Camera& camera, const ViewComparison& view,
                    const GradientArrays& out, float* colours) {
  Workspace& work = workspace();
  const int width = camera.width, height = camera.height;
  const std::size_t values = 3 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
  float* image = work.image.require(values);
  const Target target{{view.background[0], view.background[1], view.background[2]}, image, nullptr};
  ViewPull result{};
  result.faults = rasterizer.forward(scene, camera, nullptr, target);
  if (result.faults) return result;
  const float* recorded = image;
  if (view.matrix) {
    float* mapped = work.recorded.require(values);
    for_rows(width, height, [&](std::size_t, std::size_t first) {
      apply_colours(view.matrix, view.offset, image + 3 * first, mapped + 3 * first, static_cast<std::size_t>(width));
    });
    recorded = mapped;
  }
  PhotometricJob job = photometric_job(width, height, view, recorded);
  work.all.assign(static_cast<std::size_t>(job.tile_rows) * static_cast<std::size_t>(job.tile_columns), 1);
  job.active = job.wanted = work.all.data();
  job.gradient = work.gradient.require(values);
  result.sums = photometric_run(job);
  if (view.matrix) pull_map(width, height, view, image, job.gradient, colours);
  rasterizer.backward(job.gradient, nullptr, out, false);
  rasterizer.forget();
  return result;
}

}  // namespace gsstream_cpu
