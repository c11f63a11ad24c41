// Linear blend skinning of kWidth Gaussians at a time: what playback, training and its gradient share.
//
// Each Gaussian's map is the weighted sum of the joints' affine maps; its centre takes the map as it is, its
// orientation and its harmonics take the map's rotation factor. The maps are constants of the gradient.
#pragma once
#include "simd.h"
#include "training.h"

namespace tgb {
namespace TGB_ISA {

constexpr int kPolarSteps = 3;  // Newton iterations R <- (R + R^-T) / 2: 3DGB's number
constexpr float kLog2e = 1.4426950408889634f;

static inline F exponential(F x) { return exp2(clamp(x * F(kLog2e), F(-126.f), F(126.f))); }
static inline F sigmoid(F x) { return reciprocal(F(1.f) + exponential(-x)); }

// kWidth Gaussians with what both directions need.
struct Group {
  F map[12];                 // rows of [linear | translation]
  F rotation[9], turn[4];    // rotation factor of the linear part, and its quaternion
  F unit[4], inverse_length;  // normalised raw quaternion
};

static inline void polar_step(F* m) {
  F c[9];  // cofactors: determinant times the inverse transpose
  c[0] = m[4] * m[8] - m[5] * m[7], c[1] = m[5] * m[6] - m[3] * m[8], c[2] = m[3] * m[7] - m[4] * m[6];
  c[3] = m[2] * m[7] - m[1] * m[8], c[4] = m[0] * m[8] - m[2] * m[6], c[5] = m[1] * m[6] - m[0] * m[7];
  c[6] = m[1] * m[5] - m[2] * m[4], c[7] = m[2] * m[3] - m[0] * m[5], c[8] = m[0] * m[4] - m[1] * m[3];
  const F half(0.5f), scale = half * reciprocal(fma(m[0], c[0], fma(m[1], c[1], m[2] * c[2])));
  for (int i = 0; i < 9; i++) m[i] = fma(c[i], scale, half * m[i]);
}

// Quaternion of a rotation, its largest component positive. Row i of `rows` is 4 q_i (w, x, y, z).
static inline void quaternion_of(const F* m, F* q) {
  const F one(1.f), wx = m[7] - m[5], wy = m[2] - m[6], wz = m[3] - m[1];
  const F xy = m[3] + m[1], xz = m[6] + m[2], yz = m[7] + m[5];
  const F square[4] = {one + m[0] + m[4] + m[8], one + m[0] - m[4] - m[8], one - m[0] + m[4] - m[8],
                       one - m[0] - m[4] + m[8]};
  const F rows[4][4] = {{square[0], wx, wy, wz}, {wx, square[1], xy, xz}, {wy, xy, square[2], yz}, {wz, xz, yz, square[3]}};
  F largest = square[0];
  for (int j = 0; j < 4; j++) q[j] = rows[0][j];
  for (int i = 1; i < 4; i++) {
    const M larger = gt(square[i], largest);
    largest = select(larger, square[i], largest);
    for (int j = 0; j < 4; j++) q[j] = select(larger, rows[i][j], q[j]);
  }
  const F scale = F(0.5f) * reciprocal_root(largest);
  for (int j = 0; j < 4; j++) q[j] = q[j] * scale;
}

// Hamilton product.
static inline void multiply(const F* a, const F* b, F* out) {
  out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
  out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
  out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
  out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
}

// From the joints' weights, the raw quaternion and the joints' maps [kJoints, 4, 4], rest to pose.
static inline void prepare(const F* weights, const F* raw, const float* transforms, Group& g) {
  for (int e = 0; e < 12; e++) {
    g.map[e] = weights[0] * F(transforms[e]);
    for (int j = 1; j < kJoints; j++) g.map[e] = fma(weights[j], F(transforms[16 * j + e]), g.map[e]);
  }
  for (int r = 0; r < 3; r++)
    for (int c = 0; c < 3; c++) g.rotation[3 * r + c] = g.map[4 * r + c];
  for (int step = 0; step < kPolarSteps; step++) polar_step(g.rotation);
  quaternion_of(g.rotation, g.turn);
  const F square = fma(raw[0], raw[0], fma(raw[1], raw[1], fma(raw[2], raw[2], raw[3] * raw[3])));
  g.inverse_length = reciprocal_root(vmax(square, F(1e-24f)));
  for (int j = 0; j < 4; j++) g.unit[j] = raw[j] * g.inverse_length;
}

// Where a Gaussian at `rest` goes.
static inline void move(const Group& g, const F* rest, F* mean) {
  for (int r = 0; r < 3; r++)
    mean[r] = fma(g.map[4 * r], rest[0], fma(g.map[4 * r + 1], rest[1], fma(g.map[4 * r + 2], rest[2], g.map[4 * r + 3])));
}

}  // namespace TGB_ISA
}  // namespace tgb
