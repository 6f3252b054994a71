#include "raster/depth_sort.hpp"

#include <algorithm>
#include <array>
#include <utility>

#include "runtime/parallel.hpp"

namespace gsstream_cpu {
namespace {

constexpr std::size_t RADIX_FROM = 512;       // below, std::sort is faster
constexpr std::size_t PARALLEL_FROM = 16384;  // items per additional thread
constexpr int DIGIT_BITS = 11;
constexpr uint32_t DIGITS = 1u << DIGIT_BITS;

using Histogram = std::array<uint32_t, DIGITS>;

// One counting pass over `parts` contiguous pieces. The order of the result does not depend on the number of pieces.
void radix_pass(const DepthItem* from, DepthItem* to, std::size_t count, uint32_t lowest, int shift,
                std::vector<Histogram>& histograms) {
  const std::size_t parts = histograms.size();
  const auto digit = [=](const DepthItem& item) { return ((item.depth_bits - lowest) >> shift) & (DIGITS - 1); };
  parallel_for(parts, 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t p = begin; p < end; p++) {
      histograms[p].fill(0);
      for (std::size_t i = count * p / parts; i < count * (p + 1) / parts; i++) histograms[p][digit(from[i])]++;
    }
  });
  uint32_t next = 0;
  for (uint32_t d = 0; d < DIGITS; d++)
    for (Histogram& h : histograms) next += std::exchange(h[d], next);
  parallel_for(parts, 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t p = begin; p < end; p++)
      for (std::size_t i = count * p / parts; i < count * (p + 1) / parts; i++)
        to[histograms[p][digit(from[i])]++] = from[i];
  });
}

}  // namespace

void sort_by_depth(Buffer<DepthItem>& items, Buffer<DepthItem>& scratch, std::size_t count) {
  if (count < RADIX_FROM) {
    std::sort(items.data(), items.data() + count, [](const DepthItem& a, const DepthItem& b) {
      return a.depth_bits != b.depth_bits ? a.depth_bits < b.depth_bits : a.slot < b.slot;
    });
    return;
  }
  const auto [nearest, farthest] =
      std::minmax_element(items.data(), items.data() + count,
                          [](const DepthItem& a, const DepthItem& b) { return a.depth_bits < b.depth_bits; });
  const uint32_t lowest = nearest->depth_bits, range = farthest->depth_bits - lowest;
  scratch.require(count);
  const std::size_t threads = static_cast<std::size_t>(num_threads());
  std::vector<Histogram> histograms(std::clamp<std::size_t>(count / PARALLEL_FROM, 1, threads));
  for (int shift = 0; shift < 32 && (range >> shift) != 0; shift += DIGIT_BITS) {
    radix_pass(items.data(), scratch.data(), count, lowest, shift, histograms);
    items.swap(scratch);
  }
}

}  // namespace gsstream_cpu
