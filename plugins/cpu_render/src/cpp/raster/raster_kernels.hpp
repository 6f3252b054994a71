// The kernel tables of the rasteriser, one implementation per instruction set.
#pragma once
#include "runtime/isa.hpp"
#include "raster/raster_types.hpp"

namespace gsstream_cpu {

constexpr int SH_DEGREES = 4;  // tables are indexed by degree 0..3

struct ProjectKernels {
  void (*forward[SH_DEGREES])(const ProjectJob&, std::size_t first_chunk, std::size_t end_chunk);
};
struct ProjectBackwardKernels {
  void (*backward[SH_DEGREES])(const ProjectBackwardJob&, std::size_t first_visible, std::size_t end_visible);
};
struct CompositeKernels {
  void (*forward)(const CompositeJob&, std::size_t first_tile, std::size_t end_tile);
  void (*backward)(const CompositeBackwardJob&, std::size_t first_tile, std::size_t end_tile);
  void (*extend_front)(const LayerJob&);
  void (*extend_back)(const LayerJob&);
};

GSS_KERNEL_TABLE(ProjectKernels, project_kernels)
GSS_KERNEL_TABLE(ProjectBackwardKernels, project_backward_kernels)
GSS_KERNEL_TABLE(CompositeKernels, composite_kernels)

}  // namespace gsstream_cpu
