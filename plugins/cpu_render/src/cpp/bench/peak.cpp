#include "bench/peak.hpp"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace gsstream_cpu {
namespace {

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

// Runs work(thread) on threads of its own, started together, and returns the sum of what they return. The pool is not
// used: a measurement must occupy exactly the asked number of processors.
template <class Work>
double sum_over_threads(int threads, Work work) {
  if (threads < 1 || threads > 1024)
    throw std::invalid_argument("threads: expected 1 to 1024, got " + std::to_string(threads));
  std::vector<double> rate(threads, 0.0);
  std::atomic<int> ready{0};
  std::vector<std::thread> others;
  const auto run = [&](int index) {
    ready.fetch_add(1);
    while (ready.load() < threads) std::this_thread::yield();
    rate[index] = work(index);
  };
  for (int t = 1; t < threads; ++t) others.emplace_back(run, t);
  run(0);
  for (auto& thread : others) thread.join();
  double total = 0.0;
  for (double r : rate) total += r;
  return total;
}

}  // namespace

double fma_peak(int threads, double seconds) {
  if (!(seconds > 0.0 && seconds <= 60.0))
    throw std::invalid_argument("seconds: expected more than 0 and at most 60, got " + std::to_string(seconds));
  const PeakKernels& kernels = peak_kernels();
  std::vector<float> results(static_cast<std::size_t>(std::max(threads, 1)) * 16);
  return sum_over_threads(threads, [&](int index) {
    const auto start = Clock::now();
    double operations = 0.0;
    while (seconds_since(start) < seconds) operations += kernels.multiply_add(100000, &results[16 * index]);
    return operations / seconds_since(start) * 1e-9;
  });
}

double copy_peak(int threads, double megabytes) {
  if (!(megabytes >= 0.001 && megabytes <= 4096.0))
    throw std::invalid_argument("megabytes: expected 0.001 to 4096, got " + std::to_string(megabytes));
  const PeakKernels& kernels = peak_kernels();
  const auto count = static_cast<std::size_t>(megabytes * 1e6 / sizeof(float));
  std::vector<std::vector<float>> from(std::max(threads, 1)), to(std::max(threads, 1));
  return sum_over_threads(threads, [&](int index) {
    from[index].assign(count, 1.0f);  // by the thread that uses it: memory belongs near it
    to[index].assign(count, 0.0f);
    double best = 0.0;
    const auto start = Clock::now();
    do {
      const auto begin = Clock::now();
      for (std::size_t done = 0; done < (std::size_t{1} << 20); done += count)
        kernels.copy(from[index].data(), to[index].data(), count);
      const double repeats = static_cast<double>(((std::size_t{1} << 20) + count - 1) / count);
      best = std::max(best, 2.0 * repeats * static_cast<double>(count) * sizeof(float) / seconds_since(begin) * 1e-9);
    } while (seconds_since(start) < 0.2);
    return best;
  });
}

}  // namespace gsstream_cpu
