#include <nanobind/stl/optional.h>

#include <optional>
#include <stdexcept>
#include <string>

#include "adam/adam.hpp"
#include "runtime/bindings.hpp"

namespace nb = nanobind;

namespace gsstream_cpu {
namespace {

using StepArray = nb::ndarray<int32_t, nb::c_contig, nb::device::cpu>;

// The Python side has checked everything with messages for people; these checks only keep memory safe.
void require(bool good, const char* what) {
  if (!good) throw std::invalid_argument(std::string("adam: ") + what);
}

template <class Array>
void require_matrix(const Array& array, std::size_t rows, std::size_t columns, const char* what) {
  require(array.ndim() == 2 && array.shape(0) == rows && array.shape(1) == columns, what);
}

template <class Array>
void require_vector(const std::optional<Array>& array, std::size_t size, const char* what) {
  require(!array || (array->ndim() == 1 && array->shape(0) == size), what);
}

int64_t update(FloatArray param, ConstFloatArray grad, FloatArray exp_avg, FloatArray exp_avg_sq, StepArray step,
               double lr, std::optional<ConstFloatArray> lr_columns, std::optional<ConstFloatArray> lr_rows, double beta1,
               double beta2, double eps, bool ahead) {
  require(param.ndim() == 2, "param must be [N, d]");
  AdamJob job{};
  job.rows = param.shape(0);
  job.columns = param.shape(1);
  require_matrix(exp_avg, job.rows, job.columns, "exp_avg must have the parameter's shape");
  require_matrix(exp_avg_sq, job.rows, job.columns, "exp_avg_sq must have the parameter's shape");
  require_matrix(grad, job.rows, job.columns, "grad must have the parameter's shape");
  require(step.ndim() == 1 && step.shape(0) == job.rows, "step must be [N]");
  require_vector(lr_columns, job.columns, "per-column lr must be [d]");
  require_vector(lr_rows, job.rows, "per-row lr must be [N]");
  require(!(lr_columns && lr_rows), "give one kind of rates");
  job.param = param.data();
  job.exp_avg = exp_avg.data();
  job.exp_avg_sq = exp_avg_sq.data();
  job.grad = grad.data();
  job.step = step.data();
  job.lr = lr;
  job.lr_columns = lr_columns ? lr_columns->data() : nullptr;
  job.lr_rows = lr_rows ? lr_rows->data() : nullptr;
  job.beta1 = beta1;
  job.beta2 = beta2;
  job.eps = eps;
  job.ahead = ahead;
  const nb::gil_scoped_release released;
  const int64_t bad = adam_first_bad(job);
  if (bad < 0) adam_run(job);
  return bad;
}

}  // namespace

void bind_adam(nb::module_& module) {
  module.def("adam_update", &update, nb::arg("param").noconvert(), nb::arg("grad").noconvert(),
             nb::arg("exp_avg").noconvert(), nb::arg("exp_avg_sq").noconvert(), nb::arg("step").noconvert(),
             nb::arg("lr"), nb::arg("lr_columns").noconvert().none(), nb::arg("lr_rows").noconvert().none(),
             nb::arg("beta1"), nb::arg("beta2"), nb::arg("eps"), nb::arg("ahead"),
             "Adam in place. Returns -1, or the flat index of a gradient value that is not finite or beyond 1e18 (then nothing "
             "was changed).");
}

}  // namespace gsstream_cpu
