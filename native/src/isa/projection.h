// The camera model, kWidth Gaussians at a time: what forward and backward both need of one projected Gaussian.
#pragma once
#include "raster.h"
#include "simd.h"

namespace tgb {
namespace TGB_ISA {

struct View {
  float R[9], t[3], fx, fy, cx, cy, limit_x, limit_y, position[3];

  explicit View(const Scene& scene) {
    const Camera& camera = scene.camera;
    for (int i = 0; i < 3; i++) {
      for (int j = 0; j < 3; j++) R[3 * i + j] = camera.view[4 * i + j];
      t[i] = camera.view[4 * i + 3];
    }
    fx = camera.fx, fy = camera.fy, cx = camera.cx - 0.5f, cy = camera.cy - 0.5f;  // pixel centres at integers
    limit_x = scene.constants.frustum_margin * 0.5f * camera.width / fx;
    limit_y = scene.constants.frustum_margin * 0.5f * camera.height / fy;
    for (int j = 0; j < 3; j++) position[j] = -(R[j] * t[0] + R[3 + j] * t[1] + R[6 + j] * t[2]);
  }
};

struct Projection {
  F mean[3], q[4], scale[3];    // inputs
  F x, y, z, inverse_z;         // camera frame
  F px, py;                     // pixel frame
  F tx, ty;                     // x, y with x/z, y/z clamped to the frustum margin
  M free_x, free_y;             // not clamped
  F J00, J02, J11, J12;         // Jacobian of the projection at (tx, ty, z)
  F Rq[9], RS[9];               // rotation of the (unnormalised) quaternion; times scale
  F T[6], U[6];                 // J R_view; T RS
  F a, b, c;                    // 2D covariance [[a, b], [b, c]] with the low pass
  F det;
};

// Rotation matrix of a quaternion by the formula for unit ones, whatever its length: 3DGB's convention.
static inline void quaternion_matrix(const F* q, F* R) {
  const F w = q[0], x = q[1], y = q[2], z = q[3], one(1.f), two(2.f);
  R[0] = one - two * (y * y + z * z), R[1] = two * (x * y - w * z), R[2] = two * (x * z + w * y);
  R[3] = two * (x * y + w * z), R[4] = one - two * (x * x + z * z), R[5] = two * (y * z - w * x);
  R[6] = two * (x * z - w * y), R[7] = two * (y * z + w * x), R[8] = one - two * (x * x + y * y);
}

static inline void project_centre(const View& view, Projection& p) {
  const float* R = view.R;
  const F* m = p.mean;
  p.x = fma(F(R[0]), m[0], fma(F(R[1]), m[1], fma(F(R[2]), m[2], F(view.t[0]))));
  p.y = fma(F(R[3]), m[0], fma(F(R[4]), m[1], fma(F(R[5]), m[2], F(view.t[1]))));
  p.z = fma(F(R[6]), m[0], fma(F(R[7]), m[1], fma(F(R[8]), m[2], F(view.t[2]))));
  p.inverse_z = F(1.f) / p.z;
  const F ratio_x = p.x * p.inverse_z, ratio_y = p.y * p.inverse_z, lx(view.limit_x), ly(view.limit_y);
  p.px = fma(F(view.fx), ratio_x, F(view.cx)), p.py = fma(F(view.fy), ratio_y, F(view.cy));
  const F clamped_x = clamp(ratio_x, -lx, lx), clamped_y = clamp(ratio_y, -ly, ly);
  p.free_x = both(ge(ratio_x, -lx), ge(lx, ratio_x)), p.free_y = both(ge(ratio_y, -ly), ge(ly, ratio_y));
  p.tx = clamped_x * p.z, p.ty = clamped_y * p.z;
  p.J00 = F(view.fx) * p.inverse_z, p.J02 = -(F(view.fx) * clamped_x * p.inverse_z);
  p.J11 = F(view.fy) * p.inverse_z, p.J12 = -(F(view.fy) * clamped_y * p.inverse_z);
}

// Projects centre and covariance of the inputs in `p`.
static inline void project(const View& view, const Scene& scene, Projection& p) {
  project_centre(view, p);
  quaternion_matrix(p.q, p.Rq);
  for (int r = 0; r < 3; r++)
    for (int c = 0; c < 3; c++) p.RS[3 * r + c] = p.Rq[3 * r + c] * p.scale[c];
  const float* R = view.R;
  for (int j = 0; j < 3; j++) {
    p.T[j] = fma(p.J00, F(R[j]), p.J02 * F(R[6 + j]));
    p.T[3 + j] = fma(p.J11, F(R[3 + j]), p.J12 * F(R[6 + j]));
  }
  for (int r = 0; r < 2; r++)
    for (int j = 0; j < 3; j++)
      p.U[3 * r + j] = fma(p.T[3 * r], p.RS[j], fma(p.T[3 * r + 1], p.RS[3 + j], p.T[3 * r + 2] * p.RS[6 + j]));
  const F* U = p.U;
  const F low_pass(scene.constants.low_pass);
  const F a0 = fma(U[0], U[0], fma(U[1], U[1], U[2] * U[2])), c0 = fma(U[3], U[3], fma(U[4], U[4], U[5] * U[5]));
  p.a = a0 + low_pass, p.c = c0 + low_pass, p.b = fma(U[0], U[3], fma(U[1], U[4], U[2] * U[5]));
  // det(U U^T) as the sum of squared minors: positive without cancellation, however thin the splat.
  const F m0 = U[0] * U[4] - U[1] * U[3], m1 = U[0] * U[5] - U[2] * U[3], m2 = U[1] * U[5] - U[2] * U[4];
  p.det = fma(m0, m0, fma(m1, m1, fma(m2, m2, low_pass * (a0 + c0 + low_pass))));
}

// Reads `count` Gaussians from index `i` on and projects them.
static inline void project(const View& view, const Scene& scene, int i, int count, Projection& p) {
  const Splats& splats = scene.splats;
  load_structs<3>(splats.means + 3 * static_cast<size_t>(i), count, p.mean);
  load_structs<4>(splats.quats + 4 * static_cast<size_t>(i), count, p.q);
  load_structs<3>(splats.scales + 3 * static_cast<size_t>(i), count, p.scale);
  project(view, scene, p);
}

// Unit direction from the camera to each Gaussian, and in the frame of its harmonics (R^T d) where it has one.
struct Directions {
  F world[3], local[3], inverse_length;
};

// `R`: those frames, or null.
static inline void view_directions(const View& view, const Projection& p, const F* R, Directions& d) {
  for (int k = 0; k < 3; k++) d.world[k] = p.mean[k] - F(view.position[k]);
  const F* w = d.world;
  d.inverse_length = reciprocal_root(fma(w[0], w[0], fma(w[1], w[1], w[2] * w[2])));
  for (int k = 0; k < 3; k++) d.world[k] = d.local[k] = d.world[k] * d.inverse_length;
  if (R == nullptr) return;
  for (int k = 0; k < 3; k++) d.local[k] = fma(R[k], w[0], fma(R[3 + k], w[1], R[6 + k] * w[2]));
}

static inline void view_directions(const View& view, const Splats& splats, const Projection& p, int i, int count,
                                   Directions& d) {
  F R[9];
  if (splats.sh_frames != nullptr) load_structs<9>(splats.sh_frames + 9 * static_cast<size_t>(i), count, R);
  view_directions(view, p, splats.sh_frames == nullptr ? nullptr : R, d);
}

}  // namespace TGB_ISA
}  // namespace tgb
