#include "photometric/photometric.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <vector>

#include "runtime/buffer.hpp"
#include "runtime/parallel.hpp"

namespace gsstream_cpu {
namespace {

float* strip_scratch() {
  thread_local Buffer<float> scratch;
  return scratch.require(kScratchFloats);
}

// The window from the rim to the centre. The centre takes the rounding, so that the float weights sum to 1.
std::array<float, kReach + 1> make_window() {
  std::array<double, kReach + 1> exact{};
  double total = 0.0;
  for (int k = 0; k <= kReach; ++k) {
    const double distance = kReach - k;
    exact[k] = std::exp(-distance * distance / (2.0 * 1.5 * 1.5));
    total += (k == kReach ? 1.0 : 2.0) * exact[k];
  }
  std::array<float, kReach + 1> window{};
  double rest = 1.0;
  for (int k = 0; k < kReach; ++k) {
    window[k] = static_cast<float>(exact[k] / total);
    rest -= 2.0 * static_cast<double>(window[k]);
  }
  window[kReach] = static_cast<float>(rest);
  return window;
}

const std::array<float, kReach + 1> kWindow = make_window();

// Sum of the window's weights inside [0, size) around each position, each repeated `repeat` times; exactly 1 inside.
void inside_weights(int size, int padded, int repeat, std::vector<float>& out) {
  out.assign(static_cast<std::size_t>(padded) * repeat, 0.0f);
  for (int i = 0; i < size; ++i) {
    double outside = 0.0;
    for (int k = -kReach; k <= kReach; ++k)
      if (i + k < 0 || i + k >= size) outside += static_cast<double>(kWindow[kReach - std::abs(k)]);
    std::fill_n(out.begin() + static_cast<std::ptrdiff_t>(i) * repeat, repeat, static_cast<float>(1.0 - outside));
  }
}

// What one call needs beyond its arguments. One per calling thread and kept between calls: fresh memory for the maps
// would cost as much in page faults as the loss itself.
struct Workspace {
  int height = 0, width = 0;
  std::vector<float> column_weight, row_weight;
  std::vector<double> partial;
  std::vector<uint8_t> done;
  Buffer<float> maps;
  std::size_t map_floats = 0;
  std::ptrdiff_t map_stride = 0;
  bool maps_clean = false;

  void fit(PhotometricJob& job, bool with_maps) {
    if (height != job.height || width != job.width) {
      inside_weights(job.width, kTile * job.tile_columns, 3, column_weight);
      inside_weights(job.height, kTile * job.tile_rows, 1, row_weight);
      height = job.height;
      width = job.width;
      map_stride = odd_lines(3 * kTile * job.tile_columns + 2 * kPad);
      map_floats = static_cast<std::size_t>(map_stride) * (kTile * job.tile_rows + 2 * kReach);
      maps_clean = false;
    }
    partial.assign(2 * static_cast<std::size_t>(job.tile_rows) * job.tile_columns, 0.0);
    done.assign(job.tile_rows, 0);
    job.window = kWindow.data();
    job.column_weight = column_weight.data();
    job.row_weight = row_weight.data();
    job.partial = partial.data();
    job.map_stride = map_stride;
    for (float*& map : job.maps) map = nullptr;
    if (!with_maps) return;
    if (maps.bytes() < 3 * map_floats * sizeof(float)) maps_clean = false;
    // The rim must be zero and is never written; tiles are written or zeroed by every call that reads them.
    if (!maps_clean) maps.require_zeros(3 * map_floats);
    maps_clean = true;
    for (int m = 0; m < 3; ++m) job.maps[m] = maps.data() + m * map_floats + kReach * map_stride + kPad;
  }
};

Workspace& workspace() {
  thread_local Workspace own;
  return own;
}

// Rows of tiles per chunk: two chunks a thread, so that a mask that is busy at one end of the rows still balances.
std::size_t chunk_rows(std::size_t rows) {
  const std::size_t parts = 2 * static_cast<std::size_t>(num_threads());
  return std::max<std::size_t>(1, (rows + parts - 1) / parts);
}

// Rows of tiles in which something is to be done: from the first to the last that has an active or a wanted tile, or
// lies beside one that has.
struct BusyRows {
  std::size_t first, end;
};
BusyRows busy_rows(const PhotometricJob& job) {
  const auto busy = [&](int row) {
    const std::size_t begin = static_cast<std::size_t>(row) * static_cast<std::size_t>(job.tile_columns);
    for (int column = 0; column < job.tile_columns; column++)
      if (job.active[begin + static_cast<std::size_t>(column)] || job.wanted[begin + static_cast<std::size_t>(column)])
        return true;
    return false;
  };
  int first = 0, last = job.tile_rows - 1;
  while (first <= last && !busy(first)) first++;
  while (last >= first && !busy(last)) last--;
  if (first > last) return {0, 0};
  return {static_cast<std::size_t>(std::max(0, first - 1)), static_cast<std::size_t>(std::min(job.tile_rows, last + 2))};
}

}  // namespace

PhotometricSums photometric_run(PhotometricJob job) {
  Workspace& work = workspace();
  work.fit(job, job.gradient != nullptr);
  const PhotometricKernels& kernels = photometric_kernels();
  const BusyRows busy = busy_rows(job);
  const std::size_t rows = busy.end - busy.first;
  uint8_t* done = work.done.data();
  // Inside a chunk the gradient follows one row behind the maps, which are then still in the cache. The first and last
  // row of a chunk need maps of another chunk and wait for the second round.
  parallel_for(rows, chunk_rows(rows), [&](std::size_t first, std::size_t last) {
    float* scratch = strip_scratch();
    const std::size_t begin = busy.first + first, end = busy.first + last;
    for (std::size_t row = begin; row < end; ++row) {
      kernels.forward_row(job, static_cast<int>(row), scratch);
      const bool ready = row >= 1 && (row >= begin + 2 || (row == begin + 1 && begin == busy.first));
      if (job.gradient == nullptr || !ready) continue;
      kernels.backward_row(job, static_cast<int>(row) - 1, scratch);
      done[row - 1] = 1;
    }
  });
  if (job.gradient != nullptr) {
    parallel_for(rows, 1, [&](std::size_t first, std::size_t last) {
      for (std::size_t row = busy.first + first; row < busy.first + last; ++row)
        if (!done[row]) kernels.backward_row(job, static_cast<int>(row), strip_scratch());
    });
  }
  PhotometricSums sums{0.0, 0.0};
  for (std::size_t i = 0; i < work.partial.size(); i += 2) {
    sums.l1 += work.partial[i];
    sums.dssim += work.partial[i + 1];
  }
  return sums;
}

}  // namespace gsstream_cpu
