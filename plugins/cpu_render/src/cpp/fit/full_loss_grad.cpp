#include "fit/full_loss_grad.hpp"

#include <vector>

#include "fit/colour_map.hpp"
#include "runtime/buffer.hpp"
#include "runtime/parallel.hpp"

namespace gsstream_cpu {
namespace {

constexpr std::size_t ROW_GRAIN = 16;  // rows of pixels
constexpr std::size_t GRADS = 12;     // entries of a colour map's matrix and offset

// Memory of one calling thread, kept between calls.
struct Workspace {
  Buffer<float> image, recorded, gradient;
  std::vector<uint8_t> all;      // every tile
  std::vector<double> grads;    // by row of pixels
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

// Backpropagates through the colour map, and computes the map's own gradient.
void map_backward(int width, int height, const ViewComparison& view, const float* image, float* gradient, float* colours) {
  const std::size_t pixels = static_cast<std::size_t>(width);
  std::vector<double>& grads = workspace().grads;
  grads.resize(GRADS * static_cast<std::size_t>(height));
  for_rows(width, height, [&](std::size_t row, std::size_t first) {
    exposure_grad_of(image + 3 * first, gradient + 3 * first, pixels, &grads[GRADS * row]);
    exposure_vjp(view.matrix, gradient + 3 * first, pixels);
  });
  for (std::size_t entry = 0; colours && entry < GRADS; entry++) {
    double sum = 0.0;
    for (std::size_t row = 0; row < static_cast<std::size_t>(height); row++) sum += grads[GRADS * row + entry];
    colours[entry] = static_cast<float>(sum);
  }
}

}  // namespace

ViewLossGrad full_loss_and_grad(Rasterizer& rasterizer, const Scene& scene, const Camera& camera, const ViewComparison& view,
                    const GradientArrays& out, float* colours) {
  Workspace& work = workspace();
  const int width = camera.width, height = camera.height;
  const std::size_t values = 3 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
  float* image = work.image.require(values);
  const Target target{{view.background[0], view.background[1], view.background[2]}, image, nullptr};
  ViewLossGrad result{};
  result.faults = rasterizer.forward(scene, camera, nullptr, target);
  if (result.faults) return result;
  const float* recorded = image;
  if (view.matrix) {
    float* mapped = work.recorded.require(values);
    for_rows(width, height, [&](std::size_t, std::size_t first) {
      apply_exposure(view.matrix, view.offset, image + 3 * first, mapped + 3 * first, static_cast<std::size_t>(width));
    });
    recorded = mapped;
  }
  PhotometricJob job = photometric_job(width, height, view, recorded);
  work.all.assign(static_cast<std::size_t>(job.tile_rows) * static_cast<std::size_t>(job.tile_columns), 1);
  job.active = job.wanted = work.all.data();
  job.gradient = work.gradient.require(values);
  result.sums = photometric_run(job);
  if (view.matrix) map_backward(width, height, view, image, job.gradient, colours);
  rasterizer.backward(job.gradient, nullptr, out, false);
  rasterizer.forget();
  return result;
}

}  // namespace gsstream_cpu
