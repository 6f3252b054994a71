// One bind_* function per kernel family, defined in its NAME_bindings.cpp and called by module.cpp.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>

namespace gsstream_cpu {

// C-contiguous CPU arrays, from numpy or torch, without a copy. Always declare such arguments `.noconvert()`:
// otherwise a float64 or strided *output* array is silently copied and what the kernel writes is lost.
using FloatArray = nanobind::ndarray<float, nanobind::c_contig, nanobind::device::cpu>;
using ConstFloatArray = nanobind::ndarray<const float, nanobind::c_contig, nanobind::device::cpu>;
using ByteArray = nanobind::ndarray<const uint8_t, nanobind::c_contig, nanobind::device::cpu>;
using ByteOutArray = nanobind::ndarray<uint8_t, nanobind::c_contig, nanobind::device::cpu>;
using IndexArray = nanobind::ndarray<const uint32_t, nanobind::c_contig, nanobind::device::cpu>;
using RowOutArray = nanobind::ndarray<int64_t, nanobind::c_contig, nanobind::device::cpu>;
using IndexOutArray = nanobind::ndarray<uint32_t, nanobind::c_contig, nanobind::device::cpu>;

void bind_rasterizer(nanobind::module_& module);
void bind_photometric(nanobind::module_& module);
void bind_adam(nanobind::module_& module);
void bind_residual(nanobind::module_& module);
void bind_moved(nanobind::module_& module);
void bind_whole(nanobind::module_& module);
void bind_views(nanobind::module_& module);
void bind_threads(nanobind::module_& module);

}  // namespace gsstream_cpu
