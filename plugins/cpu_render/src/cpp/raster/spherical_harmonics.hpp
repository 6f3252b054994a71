// Real spherical harmonics up to degree 3 in the sign convention of 3DGS and gsplat. K = (degree+1)^2 coefficients.
#pragma once
#include "runtime/simd.hpp"

namespace gsstream_cpu::GSS_ISA {

constexpr float SH_0 = 0.28209479f;
constexpr float SH_1 = 0.48860251f;
constexpr float SH_2A = 1.09254843f, SH_2B = 0.31539157f, SH_2C = 0.54627422f;
constexpr float SH_3A = 0.59004359f, SH_3B = 2.89061144f, SH_3C = 0.45704580f, SH_3D = 0.37317633f, SH_3E = 1.44530572f;

template <int K>
GSS_INLINE void sh_basis(const Floats* direction, Floats* basis) {
  const Floats x = direction[0], y = direction[1], z = direction[2];
  basis[0] = broadcast(SH_0);
  if constexpr (K > 1) {
    basis[1] = -SH_1 * y;
    basis[2] = SH_1 * z;
    basis[3] = -SH_1 * x;
  }
  if constexpr (K > 4) {
    basis[4] = SH_2A * x * y;
    basis[5] = -SH_2A * y * z;
    basis[6] = SH_2B * (2 * z * z - x * x - y * y);
    basis[7] = -SH_2A * x * z;
    basis[8] = SH_2C * (x * x - y * y);
  }
  if constexpr (K > 9) {
    const Floats xx = x * x, yy = y * y, zz = z * z;
    basis[9] = -SH_3A * y * (3 * xx - yy);
    basis[10] = SH_3B * x * y * z;
    basis[11] = -SH_3C * y * (4 * zz - xx - yy);
    basis[12] = SH_3D * z * (2 * zz - 3 * xx - 3 * yy);
    basis[13] = -SH_3C * x * (4 * zz - xx - yy);
    basis[14] = SH_3E * z * (xx - yy);
    basis[15] = -SH_3A * x * (xx - 3 * yy);
  }
}

// Gradient with respect to the direction, given w[k] = dL/d(basis k). Not yet projected on the sphere's tangent.
template <int K>
GSS_INLINE void sh_direction_gradient(const Floats* direction, const Floats* w, Floats* gradient) {
  const Floats x = direction[0], y = direction[1], z = direction[2];
  Floats gx = -SH_1 * w[3], gy = -SH_1 * w[1], gz = SH_1 * w[2];
  if constexpr (K > 4) {
    gx += SH_2A * (y * w[4] - z * w[7]) + 2 * x * (SH_2C * w[8] - SH_2B * w[6]);
    gy += SH_2A * (x * w[4] - z * w[5]) - 2 * y * (SH_2C * w[8] + SH_2B * w[6]);
    gz += 4 * SH_2B * z * w[6] - SH_2A * (y * w[5] + x * w[7]);
  }
  if constexpr (K > 9) {
    const Floats xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
    gx += 6 * SH_3D * -xz * w[12] + 2 * SH_3E * xz * w[14] + SH_3B * yz * w[10] + 2 * SH_3C * xy * w[11];
    gx += SH_3C * (3 * xx + yy - 4 * zz) * w[13] - 6 * SH_3A * xy * w[9] - 3 * SH_3A * (xx - yy) * w[15];
    gy += 6 * SH_3D * -yz * w[12] - 2 * SH_3E * yz * w[14] + SH_3B * xz * w[10] + 2 * SH_3C * xy * w[13];
    gy += SH_3C * (xx + 3 * yy - 4 * zz) * w[11] + 6 * SH_3A * xy * w[15] - 3 * SH_3A * (xx - yy) * w[9];
    gz += SH_3B * xy * w[10] - 8 * SH_3C * (yz * w[11] + xz * w[13]);
    gz += 3 * SH_3D * (2 * zz - xx - yy) * w[12] + SH_3E * (xx - yy) * w[14];
  }
  gradient[0] = gx;
  gradient[1] = gy;
  gradient[2] = gz;
}

}  // namespace gsstream_cpu::GSS_ISA
