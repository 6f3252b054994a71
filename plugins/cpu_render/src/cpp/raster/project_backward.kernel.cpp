// Stage 5: from per-pair moments to gradients of the raw parameters. Visible Gaussians only; the projection is
// recomputed.
#include "raster/moments.hpp"
#include "raster/raster_kernels.hpp"
#include "raster/splats.hpp"

namespace gsstream_cpu::GSS_ISA {
namespace {

// Gradients of LANES Gaussians with respect to raw parameters.
template <int K>
struct SplatGradients {
  Floats mean[3], quat[4], scale[3], opacity, mean2d[2], sh[3 * K];
};

// Gradients inside the chain.
struct ChainGradients {
  Floats covariance[3];  // d/d(xx), half of d/d(xy) (each of the two equal entries), d/d(yy)
  Floats axes[6], rotation[9], view[3];
};

// Sums the moments over the pairs of each of `valid` Gaussians, in pair order, and transposes: out[k] lane l.
GSS_INLINE void gather_moments(const ProjectBackwardJob& job, std::size_t first, int valid, Floats* out) {
  constexpr int PARTS = MOMENT_STRIDE / LANES;
  alignas(64) float rows[LANES][MOMENT_STRIDE];
  for (int lane = 0; lane < LANES; lane++) {
    Floats total[PARTS] = {};
    if (lane < valid)
      for (uint32_t p = job.pair_offset[first + lane]; p < job.pair_offset[first + lane + 1]; p++)
        for (int part = 0; part < PARTS; part++)
          total[part] += load(job.moments + static_cast<std::size_t>(p) * MOMENT_STRIDE + part * LANES);
    for (int part = 0; part < PARTS; part++) store(rows[lane] + part * LANES, total[part]);
  }
  alignas(64) float column[LANES];
  for (int k = 0; k < MOMENTS; k++) {
    for (int lane = 0; lane < LANES; lane++) column[lane] = rows[lane][moment_slot(k)];
    out[k] = load(column);
  }
}

// log(alpha) = log(opacity) - 1/2 d^T Q d with d = pixel - mean2d and Q the inverse covariance.
template <int K>
GSS_INLINE void through_exponent(const Splats& s, const Floats* moments, SplatGradients<K>& out,
                                 ChainGradients& chain) {
  const Floats g = moments[0], gx = moments[1], gy = moments[2], gxx = moments[3], gxy = moments[4], gyy = moments[5];
  const Floats qa = s.yy * s.inverse_det, qb = -s.xy * s.inverse_det, qc = s.xx * s.inverse_det;
  out.opacity = g * s.transparency;  // d log(sigmoid)/d logit
  out.mean2d[0] = qa * gx + qb * gy;
  out.mean2d[1] = qb * gx + qc * gy;
  // dL/dQ = -1/2 [gxx gxy; gxy gyy] and dL/dCov = -Q (dL/dQ) Q
  const Floats m00 = 0.5f * (qa * gxx + qb * gxy), m01 = 0.5f * (qa * gxy + qb * gyy);
  const Floats m10 = 0.5f * (qb * gxx + qc * gxy), m11 = 0.5f * (qb * gxy + qc * gyy);
  chain.covariance[0] = m00 * qa + m01 * qb;
  chain.covariance[1] = m00 * qb + m01 * qc;
  chain.covariance[2] = m10 * qb + m11 * qc;
}

// Covariance = (axes S)(axes S)^T + blur, S = diag(scale).
template <int K>
GSS_INLINE void through_covariance(const Splats& s, SplatGradients<K>& out, ChainGradients& chain) {
  const Floats *cov = chain.covariance, *axes = s.axes;
  for (int j = 0; j < 3; j++) {
    const Floats u = axes[j] * s.scale[j], v = axes[3 + j] * s.scale[j];
    const Floats du = 2 * (cov[0] * u + cov[1] * v), dv = 2 * (cov[1] * u + cov[2] * v);
    out.scale[j] = (du * axes[j] + dv * axes[3 + j]) * s.scale[j];  // d scale / d log scale = scale
    chain.axes[j] = du * s.scale[j];
    chain.axes[3 + j] = dv * s.scale[j];
  }
}

// axes = rows * rotation, rows = Jacobian * camera rotation; then the camera transform itself.
template <int K>
GSS_INLINE void through_camera(const Camera& camera, const Splats& s, SplatGradients<K>& out, ChainGradients& chain) {
  Floats rows[6], row_gradient[6];
  projection_rows(camera, s, rows);
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) chain.rotation[3 * i + j] = rows[i] * chain.axes[j] + rows[3 + i] * chain.axes[3 + j];
  for (int r = 0; r < 2; r++)
    for (int i = 0; i < 3; i++)
      row_gradient[3 * r + i] = chain.axes[3 * r] * s.rotation[3 * i] + chain.axes[3 * r + 1] * s.rotation[3 * i + 1] +
                                chain.axes[3 * r + 2] * s.rotation[3 * i + 2];
  const float* cam = camera.rotation;
  // Jacobian: d(x/z), d(y/z) rows are fx [1/z, 0, -x/z^2] and fy [0, 1/z, -y/z^2] with the limited grads.
  Floats jxx{}, jxz{}, jyy{}, jyz{};
  for (int j = 0; j < 3; j++) {
    jxx += row_gradient[j] * cam[j];
    jxz += row_gradient[j] * cam[6 + j];
    jyy += row_gradient[3 + j] * cam[3 + j];
    jyz += row_gradient[3 + j] * cam[6 + j];
  }
  const Floats iz = s.inverse_z, fx_z = camera.fx * iz, fy_z = camera.fy * iz;
  const Floats grad_x = -fx_z * iz * jxz, grad_y = -fy_z * iz * jyz;
  const Floats to_x = fx_z * out.mean2d[0], to_y = fy_z * out.mean2d[1];
  chain.view[0] = to_x + select_or_zero(s.x_free, grad_x);
  chain.view[1] = to_y + select_or_zero(s.y_free, grad_y);
  chain.view[2] = -(to_x * s.view[0] + to_y * s.view[1]) * iz - (fx_z * jxx + fy_z * jyy) * iz;
  // A free grad depends on z once more than a limited one.
  chain.view[2] -=
      select(s.x_free, 2 * s.tan_x, s.tan_x) * grad_x + select(s.y_free, 2 * s.tan_y, s.tan_y) * grad_y;
  for (int j = 0; j < 3; j++)
    out.mean[j] = cam[j] * chain.view[0] + cam[3 + j] * chain.view[1] + cam[6 + j] * chain.view[2];
}

// Rotation matrix -> unit quaternion -> raw quaternion (projection on the tangent, divided by the norm).
template <int K>
GSS_INLINE void through_quaternion(const Splats& s, const ChainGradients& chain, SplatGradients<K>& out) {
  const Floats w = s.quat[0], x = s.quat[1], y = s.quat[2], z = s.quat[3];
  const Floats* r = chain.rotation;
  Floats* q = out.quat;
  q[0] = 2 * (x * (r[7] - r[5]) + y * (r[2] - r[6]) + z * (r[3] - r[1]));
  q[1] = 2 * (y * (r[1] + r[3]) + z * (r[2] + r[6]) + w * (r[7] - r[5]) - 2 * x * (r[4] + r[8]));
  q[2] = 2 * (x * (r[1] + r[3]) + z * (r[5] + r[7]) + w * (r[2] - r[6]) - 2 * y * (r[0] + r[8]));
  q[3] = 2 * (x * (r[2] + r[6]) + y * (r[5] + r[7]) + w * (r[3] - r[1]) - 2 * z * (r[0] + r[4]));
  const Floats radial = q[0] * w + q[1] * x + q[2] * y + q[3] * z;
  for (int i = 0; i < 4; i++) q[i] = (q[i] - radial * s.quat[i]) * s.quat_inverse_norm;
}

template <int K>
GSS_INLINE void through_color(const ProjectBackwardJob& job, const uint32_t* rows, const Floats* moments, Splats& s,
                              SplatGradients<K>& out) {
  Harmonics<K> sh;
  Floats color[3], gradient[3];
  view_direction(job.camera, s);
  evaluate_color<K>(job.gaussians, rows, s, sh, color);
  for (int c = 0; c < 3; c++) gradient[c] = select_or_zero(greater(color[c], Floats{}), moments[6 + c]);
  for (int k = 0; k < K; k++)
    for (int c = 0; c < 3; c++) out.sh[3 * k + c] = sh.basis[k] * gradient[c];
  if constexpr (K > 1) {
    Floats basis_gradient[K], direction[3];
    const Floats* v = sh.coefficients;
    for (int k = 1; k < K; k++)
      basis_gradient[k] = v[3 * k] * gradient[0] + v[3 * k + 1] * gradient[1] + v[3 * k + 2] * gradient[2];
    sh_direction_gradient<K>(s.direction, basis_gradient, direction);
    const Floats radial = direction[0] * s.direction[0] + direction[1] * s.direction[1] + direction[2] * s.direction[2];
    for (int i = 0; i < 3; i++) out.mean[i] += (direction[i] - radial * s.direction[i]) * s.inverse_distance;
  }
}

template <int WIDTH>
GSS_INLINE void scatter_rows(const Floats* values, const uint32_t* rows, int valid, float* destination) {
  alignas(64) float columns[WIDTH][LANES];
  for (int c = 0; c < WIDTH; c++) store(columns[c], values[c]);
  for (int lane = 0; lane < valid; lane++) {
    float* row = destination + static_cast<std::size_t>(rows[lane]) * WIDTH;
    for (int c = 0; c < WIDTH; c++) row[c] = columns[c][lane];
  }
}

template <int K>
void project_backward(const ProjectBackwardJob& job, std::size_t begin, std::size_t end) {
  for (std::size_t i = begin; i < end; i += LANES) {
    const int valid = static_cast<int>(end - i < LANES ? end - i : LANES);
    alignas(64) uint32_t rows[LANES], out_rows[LANES];
    for (int lane = 0; lane < LANES; lane++) {
      rows[lane] = job.rows[i + (lane < valid ? lane : 0)];
      out_rows[lane] = job.compact ? static_cast<uint32_t>(i) + lane : rows[lane];
    }
    Floats moments[MOMENTS];
    gather_moments(job, i, valid, moments);
    Splats s;
    load_and_activate(job.gaussians, rows, s);
    to_view_space(job.camera, s);
    covariance_2d(job.camera, s);
    SplatGradients<K> out;
    ChainGradients chain;
    through_exponent(s, moments, out, chain);
    scatter_rows<2>(out.mean2d, out_rows, valid, job.out.means2d);
    if (!job.out.means) continue;
    through_covariance(s, out, chain);
    through_camera(job.camera, s, out, chain);
    through_quaternion(s, chain, out);
    through_color<K>(job, rows, moments, s, out);
    scatter_rows<3>(out.mean, out_rows, valid, job.out.means);
    scatter_rows<4>(out.quat, out_rows, valid, job.out.quats);
    scatter_rows<3>(out.scale, out_rows, valid, job.out.scales);
    scatter_rows<1>(&out.opacity, out_rows, valid, job.out.opacities);
    scatter_rows<3>(out.sh, out_rows, valid, job.out.sh0);
    if constexpr (K > 1) scatter_rows<3 * (K - 1)>(out.sh + 3, out_rows, valid, job.out.shN);
  }
}

}  // namespace

const ProjectBackwardKernels& project_backward_kernels() {
  static const ProjectBackwardKernels table{
      {project_backward<1>, project_backward<4>, project_backward<9>, project_backward<16>}};
  return table;
}

}  // namespace gsstream_cpu::GSS_ISA
