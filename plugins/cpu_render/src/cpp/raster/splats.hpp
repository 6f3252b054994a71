// LANES Gaussians at once: loading, activation and EWA projection. Shared by the forward projection and by its
// backward, which recomputes instead of storing.
//   Projection: Zwicker et al., "EWA splatting", 2002, as used by Kerbl et al., "3D Gaussian Splatting", 2023;
//   the limit on x/z and y/z inside the Jacobian is gsplat's (1.3 times the field of view).
#pragma once
#include "raster/raster_types.hpp"
#include "raster/spherical_harmonics.hpp"

namespace gsstream_cpu::GSS_ISA {

struct Splats {
  Floats mean[3], quat[4], scale[3];  // activated: unit quaternion, linear scale
  Floats opacity, transparency;       // in (0,1); 1 - opacity would be 0 from a logit of 17 on
  Floats quat_inverse_norm, quat_norm2;
  Ints largest;                                 // largest_magnitude of the raw geometry
  Floats view[3], inverse_z, tan_x, tan_y;  // camera space; grads x/z, y/z limited as above
  Mask x_free, y_free;                          // where the grad was not limited
  Floats rotation[9];
  Floats axes[6];                         // 2x3: Jacobian * camera rotation * rotation (without scale)
  Floats xx, xy, yy, inverse_det;         // 2-D covariance with blur
  Floats direction[3], inverse_distance;  // from the camera centre
};

// Transposes rows of `width` floats: out[c] lane l = source[rows[l]*width + c].
template <int WIDTH>
GSS_INLINE void gather_rows(const float* source, const uint32_t* rows, Floats* out) {
  alignas(64) float columns[WIDTH][LANES];
  for (int lane = 0; lane < LANES; lane++) {
    const float* row = source + static_cast<std::size_t>(rows[lane]) * WIDTH;
    for (int c = 0; c < WIDTH; c++) columns[c][lane] = row[c];
  }
  for (int c = 0; c < WIDTH; c++) out[c] = load(columns[c]);
}

GSS_INLINE void load_and_activate(const GaussianArrays& in, const uint32_t* rows, Splats& s) {
  gather_rows<3>(in.means, rows, s.mean);
  gather_rows<4>(in.quats, rows, s.quat);
  gather_rows<3>(in.scales, rows, s.scale);
  gather_rows<1>(in.opacities, rows, &s.opacity);
  s.largest = largest_magnitude(Ints{}, s.opacity);
  for (int i = 0; i < 3; i++) s.largest = largest_magnitude(largest_magnitude(s.largest, s.mean[i]), s.scale[i]);
  for (const Floats& q : s.quat) s.largest = largest_magnitude(s.largest, q);
  const Floats odds = exp2(clamp(-LOG2_E * s.opacity, broadcast(-60.f), broadcast(60.f)));
  s.opacity = 1.0f / (1.0f + odds);
  s.transparency = odds * s.opacity;
  for (Floats& scale : s.scale)
    scale = exp2(clamp(scale * LOG2_E, broadcast(-LOG2_SCALE_LIMIT), broadcast(LOG2_SCALE_LIMIT)));
  s.quat_norm2 = s.quat[0] * s.quat[0] + s.quat[1] * s.quat[1] + s.quat[2] * s.quat[2] + s.quat[3] * s.quat[3];
  s.quat_inverse_norm = 1.0f / sqrt(max(s.quat_norm2, broadcast(QUAT_NORM2_MIN)));
  for (Floats& q : s.quat) q *= s.quat_inverse_norm;
}

GSS_INLINE void to_view_space(const Camera& camera, Splats& s) {
  const float* r = camera.rotation;
  for (int i = 0; i < 3; i++)
    s.view[i] = r[3 * i] * s.mean[0] + r[3 * i + 1] * s.mean[1] + r[3 * i + 2] * s.mean[2] + camera.translation[i];
  // Gaussians nearer than the near plane are dropped later; keep their numbers finite until then.
  s.inverse_z = 1.0f / max(s.view[2], broadcast(camera.near));
  const Floats x = s.view[0] * s.inverse_z, y = s.view[1] * s.inverse_z;
  const Floats x_low = broadcast(camera.x_low), x_high = broadcast(camera.x_high);
  const Floats y_low = broadcast(camera.y_low), y_high = broadcast(camera.y_high);
  s.tan_x = clamp(x, x_low, x_high);
  s.tan_y = clamp(y, y_low, y_high);
  s.x_free = both(greater_equal(x, x_low), greater_equal(x_high, x));
  s.y_free = both(greater_equal(y, y_low), greater_equal(y_high, y));
}

GSS_INLINE void rotation_matrix(const Floats* quat, Floats* r) {
  const Floats w = quat[0], x = quat[1], y = quat[2], z = quat[3];
  r[0] = 1 - 2 * (y * y + z * z);
  r[1] = 2 * (x * y - w * z);
  r[2] = 2 * (x * z + w * y);
  r[3] = 2 * (x * y + w * z);
  r[4] = 1 - 2 * (x * x + z * z);
  r[5] = 2 * (y * z - w * x);
  r[6] = 2 * (x * z - w * y);
  r[7] = 2 * (y * z + w * x);
  r[8] = 1 - 2 * (x * x + y * y);
}

// The 2x3 product Jacobian * camera rotation.
GSS_INLINE void projection_rows(const Camera& camera, const Splats& s, Floats* rows) {
  const float* r = camera.rotation;
  const Floats jx = camera.fx * s.inverse_z, jy = camera.fy * s.inverse_z;
  for (int j = 0; j < 3; j++) {
    rows[j] = jx * (r[j] - s.tan_x * r[6 + j]);
    rows[3 + j] = jy * (r[3 + j] - s.tan_y * r[6 + j]);
  }
}

GSS_INLINE void covariance_2d(const Camera& camera, Splats& s) {
  Floats rows[6];
  projection_rows(camera, s, rows);
  rotation_matrix(s.quat, s.rotation);
  Floats u[3], v[3];
  for (int j = 0; j < 3; j++) {
    s.axes[j] = rows[0] * s.rotation[j] + rows[1] * s.rotation[3 + j] + rows[2] * s.rotation[6 + j];
    s.axes[3 + j] = rows[3] * s.rotation[j] + rows[4] * s.rotation[3 + j] + rows[5] * s.rotation[6 + j];
    u[j] = s.axes[j] * s.scale[j];
    v[j] = s.axes[3 + j] * s.scale[j];
  }
  const Floats uu = u[0] * u[0] + u[1] * u[1] + u[2] * u[2];
  const Floats vv = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
  s.xx = uu + BLUR;
  s.xy = u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
  s.yy = vv + BLUR;
  // xx*yy - xy*xy loses all digits for long thin Gaussians; by Cauchy-Binet it is this sum of positive terms.
  const Floats c0 = u[1] * v[2] - u[2] * v[1], c1 = u[2] * v[0] - u[0] * v[2], c2 = u[0] * v[1] - u[1] * v[0];
  s.inverse_det = 1.0f / (c0 * c0 + c1 * c1 + c2 * c2 + BLUR * (uu + vv) + BLUR * BLUR);
}

GSS_INLINE void view_direction(const Camera& camera, Splats& s) {
  const Floats x = s.mean[0] - camera.position[0], y = s.mean[1] - camera.position[1],
               z = s.mean[2] - camera.position[2];
  s.inverse_distance = 1.0f / sqrt(max(x * x + y * y + z * z, broadcast(1e-20f)));
  s.direction[0] = x * s.inverse_distance;
  s.direction[1] = y * s.inverse_distance;
  s.direction[2] = z * s.inverse_distance;
}

template <int K>
struct Harmonics {
  Floats coefficients[3 * K], basis[K];
};

// Colours before the cut at zero.
template <int K>
GSS_INLINE void evaluate_color(const GaussianArrays& in, const uint32_t* rows, const Splats& s, Harmonics<K>& sh,
                               Floats* color) {
  gather_rows<3>(in.sh0, rows, sh.coefficients);
  if constexpr (K > 1) gather_rows<3 * (K - 1)>(in.shN, rows, sh.coefficients + 3);
  sh_basis<K>(s.direction, sh.basis);
  for (int channel = 0; channel < 3; channel++) {
    color[channel] = broadcast(0.5f);
    for (int k = 0; k < K; k++) color[channel] += sh.basis[k] * sh.coefficients[3 * k + channel];
  }
}

}  // namespace gsstream_cpu::GSS_ISA
