#include <atomic>
#include <cstdint>
#include <stdexcept>

#include "runtime/bindings.hpp"
#include "runtime/parallel.hpp"

namespace nb = nanobind;

namespace gsstream_cpu {
namespace {

// For tests: visits every index of [0, count) once, `nested` times over from inside each chunk, and throws from the
// chunk that holds `fail_at` (none if negative). Returns the sum of the visited indices.
int64_t pool_exercise(int64_t count, int64_t grain, bool nested, int64_t fail_at) {
  if (count < 0 || grain < 1) throw std::invalid_argument("pool_exercise: expected count >= 0 and grain >= 1");
  std::atomic<int64_t> total{0};
  const auto visit = [&](std::size_t begin, std::size_t end) {
    int64_t sum = 0;
    for (auto i = static_cast<int64_t>(begin); i < static_cast<int64_t>(end); ++i) {
      if (i == fail_at) throw std::runtime_error("pool_exercise: asked to fail");
      sum += i;
    }
    total += sum;
  };
  parallel_for(static_cast<std::size_t>(count), static_cast<std::size_t>(grain), [&](std::size_t begin, std::size_t end) {
    if (!nested) return visit(begin, end);
    parallel_for(end - begin, 1, [&](std::size_t low, std::size_t high) { visit(begin + low, begin + high); });
  });
  return total.load();
}

}  // namespace

void bind_threads(nb::module_& module) {
  module.def("num_threads", &num_threads, "Threads that work on one call, the caller included.");
  module.def("set_num_threads", &set_num_threads, nb::arg("n"), nb::call_guard<nb::gil_scoped_release>(),
             "Sets the number of threads, 1 to 1024.");
  module.def("pool_exercise", &pool_exercise, nb::arg("count"), nb::arg("grain"), nb::arg("nested") = false,
             nb::arg("fail_at") = -1, nb::call_guard<nb::gil_scoped_release>(), "Runs the thread pool (tests).");
}

}  // namespace gsstream_cpu
