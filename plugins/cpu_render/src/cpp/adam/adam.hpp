// Adam (Kingma and Ba 2015, algorithm 1) in place on rows, each row with its own step count: a row that was frozen for
// a while is corrected for the steps it took, not for the time that passed.
#pragma once
#include <cstddef>
#include <cstdint>

#include "runtime/isa.hpp"

namespace gsstream_cpu {

struct AdamJob {
  std::size_t rows = 0, columns = 0;  // of param, exp_avg, exp_avg_sq
  float* param;
  float* exp_avg;
  float* exp_avg_sq;
  const float* grad;        // [rows, columns]
  int32_t* step;            // [rows] step counts, incremented
  double lr, beta1, beta2, eps;
  const float* lr_columns;  // [columns] or null
  const float* lr_rows;     // [rows] or null
  bool ahead;               // steps go where the next mean would be if this gradient came again (Nesterov; Dozat 2016)
};

struct AdamKernels {
  // Visits rows begin..end.
  void (*update)(const AdamJob&, std::size_t begin, std::size_t end);
  // Index of the first non-finite value in [0, count), or count.
  std::size_t (*first_bad)(const float* values, std::size_t count);
};
GSS_KERNEL_TABLE(AdamKernels, adam_kernels)

// Updates in place; deterministic for any thread count (rows are independent).
void adam_run(const AdamJob& job);
// Flat index of the first non-finite gradient value, or -1.
int64_t adam_first_bad(const AdamJob& job);

}  // namespace gsstream_cpu
