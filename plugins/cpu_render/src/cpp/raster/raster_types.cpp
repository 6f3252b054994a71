#include "raster/raster_types.hpp"

#include <algorithm>
#include <cstdlib>
#include <new>

namespace gsstream_cpu {

PairList::~PairList() { std::free(data); }

void PairList::reserve_more(std::size_t extra) {
  if (size + extra <= capacity) return;
  const std::size_t wanted = std::max(size + extra, capacity + capacity / 2 + 256);
  void* grown = std::realloc(data, wanted * sizeof(Pair));
  if (!grown) throw std::bad_alloc();
  data = static_cast<Pair*>(grown);
  capacity = wanted;
}

}  // namespace gsstream_cpu
