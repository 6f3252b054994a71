#include "adam/adam.hpp"

#include <algorithm>
#include <atomic>

#include "runtime/parallel.hpp"

namespace gsstream_cpu {
namespace {

std::size_t rows_per_chunk(const AdamJob& job) { return std::max<std::size_t>(64, 16384 / std::max<std::size_t>(job.columns, 1)); }

}  // namespace

void adam_run(const AdamJob& job) {
  const AdamKernels& kernels = adam_kernels();
  parallel_for(job.rows, rows_per_chunk(job),
               [&](std::size_t begin, std::size_t end) { kernels.update(job, begin, end); });
}

int64_t adam_first_bad(const AdamJob& job) {
  const AdamKernels& kernels = adam_kernels();
  const std::size_t d = job.columns;
  std::atomic<int64_t> worst{-1};
  const auto report = [&](std::size_t index) {
    int64_t seen = worst.load();
    while ((seen < 0 || static_cast<int64_t>(index) < seen) && !worst.compare_exchange_weak(seen, static_cast<int64_t>(index))) {
    }
  };
  parallel_for(job.rows, rows_per_chunk(job), [&](std::size_t begin, std::size_t end) {
    const std::size_t count = (end - begin) * d, found = kernels.first_bad(job.grad + begin * d, count);
    if (found < count) report(begin * d + found);
  });
  return worst.load();
}

}  // namespace gsstream_cpu
