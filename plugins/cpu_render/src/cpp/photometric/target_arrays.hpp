// A target image as it comes from Python, checked.
#pragma once
#include <optional>
#include <stdexcept>

#include "photometric/photometric.hpp"
#include "runtime/bindings.hpp"

namespace gsstream_cpu {

// Keeps the arrays alive. The Python side checks with messages for people; these checks keep memory safe.
struct TargetArrays {
  using Pixels = nanobind::ndarray<nanobind::ro, nanobind::c_contig, nanobind::device::cpu>;
  using Array = nanobind::ndarray<nanobind::c_contig, nanobind::device::cpu>;

  // pixels [H, W, 3] float32 or uint8; statistics as TargetStatistics has them, float32 or uint16.
  TargetArrays(Pixels image, std::optional<Array> kept, std::optional<ByteOutArray> strips)
      : held_image(image), held_statistics(kept), held_known(strips) {
    if (image.dtype() == nanobind::dtype<float>())
      pixels.floats = static_cast<const float*>(image.data());
    else if (image.dtype() == nanobind::dtype<uint8_t>())
      pixels.bytes = static_cast<const uint8_t*>(image.data());
    else
      throw std::invalid_argument("target: pixels must be float32 or uint8");
    if (kept.has_value() != strips.has_value())
      throw std::invalid_argument("target: statistics and where they are known come together or not at all");
    if (!kept) return;
    statistics.known = strips->data();
    if (kept->dtype() == nanobind::dtype<float>())
      statistics.floats = static_cast<float*>(kept->data());
    else if (kept->dtype() == nanobind::dtype<uint16_t>())
      statistics.codes = static_cast<uint16_t*>(kept->data());
    else
      throw std::invalid_argument("target: statistics must be float32 or uint16");
  }

  // Throws std::invalid_argument unless the arrays are those of an image of this size.
  void require_size(std::size_t height, std::size_t width) const {
    const std::size_t rows = (height + kTile - 1) / kTile, columns = (width + kTile - 1) / kTile;
    bool good = held_image.ndim() == 3 && held_image.shape(0) == height && held_image.shape(1) == width &&
                held_image.shape(2) == 3;
    if (held_statistics) {
      const std::size_t shape[] = {rows, columns, 2, kTile, kTileFloats};
      good = good && held_statistics->ndim() == 5 && held_known->ndim() == 2 && held_known->shape(0) == rows &&
             held_known->shape(1) == static_cast<std::size_t>(strips_of(static_cast<int>(columns)));
      for (std::size_t axis = 0; good && axis < 5; axis++) good = held_statistics->shape(axis) == shape[axis];
    }
    if (!good) throw std::invalid_argument("target: image or statistics have the wrong shape");
  }

  Pixels held_image;
  std::optional<Array> held_statistics;
  std::optional<ByteOutArray> held_known;
  TargetPixels pixels{};
  TargetStatistics statistics{};
};

}  // namespace gsstream_cpu
