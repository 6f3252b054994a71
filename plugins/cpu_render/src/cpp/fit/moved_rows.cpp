#include "fit/moved_rows.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "runtime/buffer.hpp"
#include "runtime/parallel.hpp"

namespace gsstream_cpu {
namespace {

constexpr std::size_t ROW_GRAIN = 1024;

// Memory of one calling thread, kept between calls.
struct Workspace {
  Buffer<float> means, quats, gradient[ATTRIBUTES], means2d, structure;
};

Workspace& workspace() {
  thread_local Workspace own;
  return own;
}

struct Turn {
  double w, x, y, z;  // unit quaternion
  double matrix[9];
};

Turn turn_of(const double* t) {
  const double x = t[0], y = t[1], z = t[2], scale = 1.0 / std::sqrt(1.0 + x * x + y * y + z * z);
  const double qw = scale, qx = x * scale, qy = y * scale, qz = z * scale;
  return {qw, qx, qy, qz,
          {1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy),
           2.0 * (qx * qy + qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz - qw * qx),
           2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)}};
}

void move_row(const MovedRows& moved, const std::vector<Turn>& turns, std::size_t i, float* means, float* quats) {
  const std::size_t k = static_cast<std::size_t>(moved.place[i]);
  const Turn& t = turns[k];
  const float *from = moved.rows.arrays.means + 3 * i, *q = moved.rows.arrays.quats + 4 * i;
  const double *centre = moved.centre + 3 * k, *shift = moved.shift + 3 * k;
  const double x = from[0] - centre[0], y = from[1] - centre[1], z = from[2] - centre[2];
  for (int axis = 0; axis < 3; axis++) {
    const double* m = t.matrix + 3 * axis;
    means[3 * i + axis] = static_cast<float>(m[0] * x + m[1] * y + m[2] * z + centre[axis] + shift[axis]);
  }
  const double w = q[0], a = q[1], b = q[2], c = q[3];
  quats[4 * i] = static_cast<float>(t.w * w - t.x * a - t.y * b - t.z * c);
  quats[4 * i + 1] = static_cast<float>(t.w * a + t.x * w + t.y * c - t.z * b);
  quats[4 * i + 2] = static_cast<float>(t.w * b - t.x * c + t.y * w + t.z * a);
  quats[4 * i + 3] = static_cast<float>(t.w * c + t.x * b - t.y * a + t.z * w);
}

// Adds force and torque of one row to those of its group.
void add_row(const MovedRows& moved, std::size_t i, const Workspace& work, double* grad) {
  const std::size_t k = static_cast<std::size_t>(moved.place[i]);
  const float *mean = work.means.data() + 3 * i, *q = work.quats.data() + 4 * i;
  const float *force = work.gradient[0].data() + 3 * i, *g = work.gradient[1].data() + 4 * i;
  double arm[3];
  for (int axis = 0; axis < 3; axis++) arm[axis] = mean[axis] - (moved.centre[3 * k + axis] + moved.shift[3 * k + axis]);
  const double fx = force[0], fy = force[1], fz = force[2], w = q[0], x = q[1], y = q[2], z = q[3];
  const double a = g[0], b = g[1], c = g[2], d = g[3];
  // A small turn v in front of a quaternion q adds (0, v) q to it.
  const double torque[] = {2 * (arm[1] * fz - arm[2] * fy) + (-a * x + b * w - c * z + d * y),
                           2 * (arm[2] * fx - arm[0] * fz) + (-a * y + b * z + c * w - d * x),
                           2 * (arm[0] * fy - arm[1] * fx) + (-a * z - b * y + c * x + d * w)};
  double* out = grad + 6 * k;
  for (int axis = 0; axis < 3; axis++) {
    out[axis] += force[axis];
    out[3 + axis] += torque[axis];
  }
}

// out [2][6]: derivative of the row's place on the screen by shift and turn of its group. Float64 as in Python, from the
// camera that the kernels have in float32.
void row_on_screen(const MovedRows& moved, std::size_t i, const float* mean, const Camera& camera, double out[2][6]) {
  const std::size_t k = static_cast<std::size_t>(moved.place[i]);
  const float* r = camera.rotation;
  double seen[3], arm[3];
  for (int axis = 0; axis < 3; axis++) {
    const float* m = r + 3 * axis;
    seen[axis] = double{m[0]} * mean[0] + double{m[1]} * mean[1] + double{m[2]} * mean[2] + camera.translation[axis];
    arm[axis] = mean[axis] - (moved.centre[3 * k + axis] + moved.shift[3 * k + axis]);
  }
  const double depth = std::max(seen[2], double{camera.near}), focal[] = {camera.fx, camera.fy};
  for (int d = 0; d < 2; d++) {
    double* p = out[d];
    for (int axis = 0; axis < 3; axis++) p[axis] = focal[d] / depth * (r[3 * d + axis] - seen[d] / depth * r[6 + axis]);
    p[3] = 2 * (arm[1] * p[2] - arm[2] * p[1]);
    p[4] = 2 * (arm[2] * p[0] - arm[0] * p[2]);
    p[5] = 2 * (arm[0] * p[1] - arm[1] * p[0]);
  }
}

// Adds the curvature of one row to that of its group.
void add_curvature(const MovedRows& moved, std::size_t i, const Workspace& work, const Camera& camera, double* curvature) {
  const float* s = work.structure.data() + 3 * i;
  if (s[0] == 0.0f && s[2] == 0.0f) return;  // not seen
  double p[2][6];
  row_on_screen(moved, i, work.means.data() + 3 * i, camera, p);
  double* out = curvature + 36 * moved.place[i];
  for (int a = 0; a < 6; a++) {
    const double x = s[0] * p[0][a] + s[1] * p[1][a], y = s[1] * p[0][a] + s[2] * p[1][a];
    for (int b = 0; b < 6; b++) out[6 * a + b] += x * p[0][b] + y * p[1][b];
  }
}

}  // namespace

ViewLossGrad transform_loss_and_grad(Rasterizer& rasterizer, const MovedRows& moved, const ViewComparison& view, double* grad,
                    double* curvature) {
  Workspace& work = workspace();
  const std::size_t rows = moved.rows.count;
  const auto widths = row_widths(moved.rows.sh_degree);
  float *means = work.means.require(3 * rows), *quats = work.quats.require(4 * rows), *gradients[ATTRIBUTES];
  for (std::size_t a = 0; a < ATTRIBUTES; a++) gradients[a] = work.gradient[a].require(rows * widths[a]);
  std::vector<Turn> turns;
  for (std::size_t k = 0; k < moved.groups; k++) turns.push_back(turn_of(moved.turn + 3 * k));
  parallel_for(rows, ROW_GRAIN, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; i++) move_row(moved, turns, i, means, quats);
  });
  Scene scene = moved.rows;
  scene.arrays.means = means;
  scene.arrays.quats = quats;
  const GradientArrays out{gradients[0], gradients[1], gradients[2], gradients[3],
                           gradients[4], gradients[5], work.means2d.require(2 * rows)};
  float* structure = curvature ? work.structure.require(3 * rows) : nullptr;
  const ViewLossGrad found = view_loss_and_grad(rasterizer, scene, view, out, structure);
  rasterizer.forget();  // its arrays belong to the next call
  if (found.faults) return found;
  std::fill_n(grad, 6 * moved.groups, 0.0);
  for (std::size_t i = 0; i < rows; i++) add_row(moved, i, work, grad);
  if (curvature) {
    std::fill_n(curvature, 36 * moved.groups, 0.0);
    for (std::size_t i = 0; i < rows; i++) add_curvature(moved, i, work, rasterizer.camera(), curvature);
  }
  return found;
}

}  // namespace gsstream_cpu
