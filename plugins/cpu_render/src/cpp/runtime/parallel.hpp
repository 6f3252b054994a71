// A small thread pool of our own.
//
// OpenMP is not used: its spinning barriers cost 20-40x on an oversubscribed machine, and its settings belong to
// whichever library loads first. Here workers sleep on a condition variable after at most 20 us of spinning, the
// caller works too, and nobody waits for a worker that never woke up.
//
// Contract of parallel_for(count, grain, fn):
//   * fn(begin, end) is called over disjoint ranges that cover [0, count); in parallel, ranges start at multiples of grain.
//   * Serial, as the single call fn(0, count), when count <= grain, with one thread, from inside another parallel_for,
//     and when a second thread calls while the pool is busy. Results must therefore not depend on how [0, count) is cut:
//     write to slots addressed by item, and sum the slots afterwards in a fixed order.
//   * The first exception thrown by fn reaches the caller; chunks not yet begun are dropped.
//   * After fork() the child starts with a fresh pool.
//
// This header is included by files compiled for several instruction sets: it must hold templates only, never plain
// inline functions (the linker could keep the AVX-512 copy of one for everybody).
#pragma once

#include <cstddef>
#include <type_traits>

namespace gsstream_cpu {

namespace detail {
using RangeFunction = void (*)(void* context, std::size_t begin, std::size_t end);
void parallel_run(std::size_t count, std::size_t grain, RangeFunction function, void* context);
}  // namespace detail

template <class Fn>
void parallel_for(std::size_t count, std::size_t grain, Fn&& fn) {
  using Plain = std::remove_reference_t<Fn>;
  auto* address = const_cast<std::remove_const_t<Plain>*>(&fn);
  detail::parallel_run(
      count, grain,
      [](void* context, std::size_t begin, std::size_t end) { (*static_cast<Plain*>(context))(begin, end); }, address);
}

// Number of threads that work on one parallel_for, the caller included. Default: environment GSSTREAM_THREADS,
// else the processors this process may run on. Throws std::invalid_argument for a malformed GSSTREAM_THREADS.
int num_threads();

// 1 <= n <= 1024, else std::invalid_argument. Waits for a running parallel_for of another thread;
// std::logic_error from inside a parallel_for.
void set_num_threads(int n);

}  // namespace gsstream_cpu
