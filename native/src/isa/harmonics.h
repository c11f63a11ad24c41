// Real spherical harmonics of degree 0..3 in 3D Gaussian splatting's sign convention, for vectors or floats.
// Must agree with toonifygb.geometry.harmonics.basis.
#pragma once

namespace tgb {
namespace TGB_ISA {

constexpr float kC0 = 0.28209479177387814f, kC1 = 0.4886025119029199f;
constexpr float kC2a = 1.0925484305920792f, kC2b = 0.31539156525252005f, kC2c = 0.5462742152960396f;
constexpr float kC3a = 0.5900435899266435f, kC3b = 2.890611442640554f, kC3c = 0.4570457994644658f,
                kC3d = 0.3731763325901154f, kC3e = 1.445305721320277f;

// b[0 .. (degree + 1)^2) at the unit direction (x, y, z).
template <class T>
static inline void harmonics_basis(int degree, T x, T y, T z, T* b) {
  b[0] = T(kC0);
  if (degree < 1) return;
  b[1] = T(-kC1) * y, b[2] = T(kC1) * z, b[3] = T(-kC1) * x;
  if (degree < 2) return;
  const T xx = x * x, yy = y * y, zz = z * z, two(2.f), three(3.f);
  b[4] = T(kC2a) * x * y, b[5] = T(-kC2a) * y * z, b[6] = T(kC2b) * (two * zz - xx - yy);
  b[7] = T(-kC2a) * x * z, b[8] = T(kC2c) * (xx - yy);
  if (degree < 3) return;
  const T ring = T(-kC3c) * (T(4.f) * zz - xx - yy);
  b[9] = T(-kC3a) * y * (three * xx - yy), b[10] = T(kC3b) * x * y * z, b[11] = y * ring;
  b[12] = T(kC3d) * z * (two * zz - three * (xx + yy)), b[13] = x * ring;
  b[14] = T(kC3e) * z * (xx - yy), b[15] = T(-kC3a) * x * (xx - three * yy);
}

// Gradient of sum_k w[k] b_k with respect to (x, y, z), of the homogeneous polynomials above.
template <class T>
static inline void harmonics_gradient(int degree, T x, T y, T z, const T* w, T& gx, T& gy, T& gz) {
  gx = gy = gz = T(0.f);
  if (degree < 1) return;
  gx = T(-kC1) * w[3], gy = T(-kC1) * w[1], gz = T(kC1) * w[2];
  if (degree < 2) return;
  const T axial = T(2 * kC2b) * w[6], saddle = T(2 * kC2c) * w[8];
  gx += T(kC2a) * (y * w[4] - z * w[7]) + x * (saddle - axial);
  gy += T(kC2a) * (x * w[4] - z * w[5]) - y * (saddle + axial);
  gz += T(2.f) * z * axial - T(kC2a) * (y * w[5] + x * w[7]);
  if (degree < 3) return;
  const T xx = x * x, yy = y * y, zz = z * z, two(2.f), three(3.f), six(6.f);
  const T around = T(kC3c) * two * x * y, edge = T(3 * kC3a) * (xx - yy), cross = T(6 * kC3a) * x * y;
  gx += T(kC3b) * y * z * w[10] + around * w[11] - T(6 * kC3d) * x * z * w[12] -
        T(kC3c) * (T(4.f) * zz - three * xx - yy) * w[13] + T(2 * kC3e) * x * z * w[14] - cross * w[9] - edge * w[15];
  gy += T(kC3b) * x * z * w[10] + around * w[13] - T(6 * kC3d) * y * z * w[12] -
        T(kC3c) * (T(4.f) * zz - xx - three * yy) * w[11] - T(2 * kC3e) * y * z * w[14] - edge * w[9] + cross * w[15];
  gz += T(kC3b) * x * y * w[10] - T(8 * kC3c) * z * (y * w[11] + x * w[13]) +
        T(kC3d) * (six * zz - three * (xx + yy)) * w[12] + T(kC3e) * (xx - yy) * w[14];
}

}  // namespace TGB_ISA
}  // namespace tgb
