#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <optional>
#include <stdexcept>
#include <string>
#include <utility>

#include "runtime/bindings.hpp"
#include "photometric/photometric.hpp"
#include "photometric/target_arrays.hpp"

namespace nb = nanobind;

namespace gsstream_cpu {
namespace {

// The Python side has checked shapes with messages for people; these checks only keep memory safe.
void require(bool good, const char* what) {
  if (!good) throw std::invalid_argument(std::string("photometric: ") + what);
}

template <class Array>
void require_image(const Array& array, std::size_t height, std::size_t width, const char* what) {
  require(array.ndim() == 3 && array.shape(0) == height && array.shape(1) == width && array.shape(2) == 3, what);
}

void require_sides(std::size_t height, std::size_t width) {
  require(height >= 1 && width >= 1 && height <= 65536 && width <= 65536, "image sides must be 1 to 65536");
}

std::pair<double, double> evaluate(ConstFloatArray image, const TargetArrays& target, ByteArray active, ByteArray wanted,
                                   std::optional<FloatArray> gradient, double l1_scale, double ssim_scale) {
  require(image.ndim() == 3, "image must be [H, W, 3]");
  const std::size_t height = image.shape(0), width = image.shape(1);
  require_sides(height, width);
  require_image(image, height, width, "image must be [H, W, 3]");
  target.require_size(height, width);
  if (gradient) require_image(*gradient, height, width, "gradient must have the image's shape");
  PhotometricJob job{};
  job.height = static_cast<int>(height);
  job.width = static_cast<int>(width);
  job.tile_rows = (job.height + kTile - 1) / kTile;
  job.tile_columns = (job.width + kTile - 1) / kTile;
  for (const ByteArray* mask : {&active, &wanted}) {
    require(mask->ndim() == 2 && mask->shape(0) == static_cast<std::size_t>(job.tile_rows) &&
                mask->shape(1) == static_cast<std::size_t>(job.tile_columns),
            "tile masks must be [ceil(H / 16), ceil(W / 16)]");
  }
  job.image = image.data();
  job.target = target.pixels;
  job.statistics = target.statistics;
  job.active = active.data();
  job.wanted = wanted.data();
  job.gradient = gradient ? gradient->data() : nullptr;
  job.l1_scale = static_cast<float>(l1_scale);
  job.ssim_scale = static_cast<float>(ssim_scale);
  const nb::gil_scoped_release released;
  const PhotometricSums sums = photometric_run(job);
  return {sums.l1, sums.dssim};
}

}  // namespace

void bind_photometric(nb::module_& module) {
  nb::class_<TargetArrays>(module, "Target", "A target image and where its statistics are kept; not copied.")
      .def(nb::init<TargetArrays::Pixels, std::optional<TargetArrays::Array>, std::optional<ByteOutArray>>(),
           nb::arg("pixels").noconvert(), nb::arg("statistics").noconvert().none() = nb::none(),
           nb::arg("known").noconvert().none() = nb::none());
  module.def("photometric_evaluate", &evaluate, nb::arg("image").noconvert(), nb::arg("target"),
             nb::arg("active").noconvert(), nb::arg("wanted").noconvert(), nb::arg("gradient").noconvert().none(),
             nb::arg("l1_scale"), nb::arg("ssim_scale"),
             "Sums over active tiles of |I - G| and of 1 - SSIM; writes the scaled gradient of wanted tiles.");
  module.attr("STRIP_TILES") = kStripTiles;
}

}  // namespace gsstream_cpu
