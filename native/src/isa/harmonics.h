// Real spherical harmonics of degree 0..3 in 3D Gaussian splatting's sign convention, for vectors or floats.
// Must agree with toonifygb.geometry.harmonics.basis.
#pragma once

namespace tgb {
namespace TGB_ISA {

constexpr float kC0 = 0.28209479177387814f, kC1 = 0.48860251190291992f;
constexpr float kC2a = 1.0925484305920792f, kC2b = 0.94617469575755997f, kC2c = 0.31539156525251999f,
                kC2d = 0.54627421529603959f;
constexpr float kC3a = 0.59004358992664352f, kC3b = 2.8906114426405538f, kC3c = 2.2852289973223288f,
                kC3d = 0.45704579946446572f, kC3e = 1.865881662950577f, kC3f = 1.1195289977703462f,
                kC3g = 1.4453057213202769f;

// b[0 .. (degree + 1)^2) at the unit direction (x, y, z).
template <class T>
static inline void harmonics_basis(int degree, T x, T y, T z, T* b) {
  b[0] = T(kC0);
  if (degree < 1) return;
  b[1] = T(-kC1) * y, b[2] = T(kC1) * z, b[3] = T(-kC1) * x;
  if (degree < 2) return;
  const T xx = x * x, yy = y * y, zz = z * z;
  b[4] = T(kC2a) * x * y, b[5] = T(-kC2a) * y * z, b[6] = T(kC2b) * zz - T(kC2c);
  b[7] = T(-kC2a) * x * z, b[8] = T(kC2d) * (xx - yy);
  if (degree < 3) return;
  const T ring = T(kC3d) - T(kC3c) * zz;
  b[9] = T(-kC3a) * y * (T(3.f) * xx - yy), b[10] = T(kC3b) * x * y * z, b[11] = y * ring;
  b[12] = z * (T(kC3e) * zz - T(kC3f)), b[13] = x * ring;
  b[14] = T(kC3g) * z * (xx - yy), b[15] = T(-kC3a) * x * (xx - T(3.f) * yy);
}

// Gradient of sum_k w[k] b_k with respect to (x, y, z).
template <class T>
static inline void harmonics_gradient(int degree, T x, T y, T z, const T* w, T& gx, T& gy, T& gz) {
  gx = gy = gz = T(0.f);
  if (degree < 1) return;
  gx = T(-kC1) * w[3], gy = T(-kC1) * w[1], gz = T(kC1) * w[2];
  if (degree < 2) return;
  gx += T(kC2a) * (y * w[4] - z * w[7]) + T(2 * kC2d) * x * w[8];
  gy += T(kC2a) * (x * w[4] - z * w[5]) - T(2 * kC2d) * y * w[8];
  gz += T(2 * kC2b) * z * w[6] - T(kC2a) * (y * w[5] + x * w[7]);
  if (degree < 3) return;
  const T xx = x * x, yy = y * y, zz = z * z, ring = T(kC3d) - T(kC3c) * zz;
  gx += T(kC3b) * y * z * w[10] + ring * w[13] + T(2 * kC3g) * x * z * w[14] -
        T(3 * kC3a) * (T(2.f) * x * y * w[9] + (xx - yy) * w[15]);
  gy += T(kC3b) * x * z * w[10] + ring * w[11] - T(2 * kC3g) * y * z * w[14] -
        T(3 * kC3a) * ((xx - yy) * w[9] - T(2.f) * x * y * w[15]);
  gz += T(kC3b) * x * y * w[10] - T(2 * kC3c) * z * (y * w[11] + x * w[13]) +
        (T(3 * kC3e) * zz - T(kC3f)) * w[12] + T(kC3g) * (xx - yy) * w[14];
}

}  // namespace TGB_ISA
}  // namespace tgb
