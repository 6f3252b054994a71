// Stage 2a: visible Gaussians by depth.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "runtime/buffer.hpp"

namespace gsstream_cpu {

struct DepthItem {
  uint32_t depth_bits, slot;
};

// Stable sort by depth_bits (slots must come in ascending, so ties keep memory order). The result is in `items`.
void sort_by_depth(Buffer<DepthItem>& items, Buffer<DepthItem>& scratch, std::size_t count);

}  // namespace gsstream_cpu
