// The structure of a picture, pixel by pixel: gsstream.parts.render.structure.weighed_structure.
#pragma once
#include <cstddef>

#include "photometric/photometric.hpp"

namespace gsstream_cpu {

constexpr float LEAST_ERROR = 0.03f;  // as there

// out [H, W, 3] of `count` pixels of one line, from pixel `first` on: xx, xy and yy. image, target: [H, W, 3]; the pixels
// beside and above those of the line are read.
void structure_of_line(const float* image, const TargetPixels& target, int width, int height, std::size_t first,
                       std::size_t count, float* out);

}  // namespace gsstream_cpu
