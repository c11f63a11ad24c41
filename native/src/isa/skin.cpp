// Linear blend skinning and activation of Gaussians: raw parameters to splats, and its gradient.
//
// Each Gaussian's map is the weighted sum of the joints' affine maps; its centre takes the map as it is, its
// orientation and its harmonics take the map's rotation factor. The maps are constants of the gradient.
#include "kernels.h"

namespace tgb {
namespace TGB_ISA {
namespace {

constexpr int kPolarSteps = 3;  // Newton iterations R <- (R + R^-T) / 2: 3DGB's number
constexpr float kLog2e = 1.4426950408889634f;

inline F exponential(F x) { return exp2(clamp(x * F(kLog2e), F(-126.f), F(126.f))); }
inline F sigmoid(F x) { return F(1.f) / (F(1.f) + exponential(-x)); }

// kWidth Gaussians with what both directions need.
struct Group {
  F map[12];                 // rows of [linear | translation]
  F rotation[9], turn[4];    // rotation factor of the linear part, and its quaternion
  F unit[4], inverse_length;  // normalised raw quaternion
};

inline void polar_step(F* m) {
  F c[9];  // cofactors: determinant times the inverse transpose
  c[0] = m[4] * m[8] - m[5] * m[7], c[1] = m[5] * m[6] - m[3] * m[8], c[2] = m[3] * m[7] - m[4] * m[6];
  c[3] = m[2] * m[7] - m[1] * m[8], c[4] = m[0] * m[8] - m[2] * m[6], c[5] = m[1] * m[6] - m[0] * m[7];
  c[6] = m[1] * m[5] - m[2] * m[4], c[7] = m[2] * m[3] - m[0] * m[5], c[8] = m[0] * m[4] - m[1] * m[3];
  const F half(0.5f), scale = half / fma(m[0], c[0], fma(m[1], c[1], m[2] * c[2]));
  for (int i = 0; i < 9; i++) m[i] = fma(c[i], scale, half * m[i]);
}

// Quaternion of a rotation, its largest component positive. Row i of `rows` is 4 q_i (w, x, y, z).
inline void quaternion_of(const F* m, F* q) {
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
  const F scale = F(0.5f) / vsqrt(largest);
  for (int j = 0; j < 4; j++) q[j] = q[j] * scale;
}

// Hamilton product.
inline void multiply(const F* a, const F* b, F* out) {
  out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
  out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
  out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
  out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
}

inline void prepare(const Skin& s, size_t i, int count, Group& g) {
  F weights[kJoints], raw[4];
  load_structs<kJoints>(s.weights + kJoints * i, count, weights);
  for (int e = 0; e < 12; e++) {
    g.map[e] = weights[0] * F(s.transforms[e]);
    for (int j = 1; j < kJoints; j++) g.map[e] = fma(weights[j], F(s.transforms[16 * j + e]), g.map[e]);
  }
  for (int r = 0; r < 3; r++)
    for (int c = 0; c < 3; c++) g.rotation[3 * r + c] = g.map[4 * r + c];
  for (int step = 0; step < kPolarSteps; step++) polar_step(g.rotation);
  quaternion_of(g.rotation, g.turn);
  load_structs<4>(s.quats + 4 * i, count, raw);
  const F length = vsqrt(fma(raw[0], raw[0], fma(raw[1], raw[1], fma(raw[2], raw[2], raw[3] * raw[3]))));
  g.inverse_length = F(1.f) / vmax(length, F(1e-12f));
  for (int j = 0; j < 4; j++) g.unit[j] = raw[j] * g.inverse_length;
}

void skin_group(const Skin& s, const SkinOutput& out, size_t i, int count) {
  Group g;
  prepare(s, i, count, g);
  F rest[3], mean[3], quat[4], scale[3], opacity;
  load_structs<3>(s.means + 3 * i, count, rest);
  for (int r = 0; r < 3; r++)
    mean[r] = fma(g.map[4 * r], rest[0], fma(g.map[4 * r + 1], rest[1], fma(g.map[4 * r + 2], rest[2], g.map[4 * r + 3])));
  multiply(g.turn, g.unit, quat);
  load_structs<3>(s.log_scales + 3 * i, count, scale);
  for (F& value : scale) value = exponential(value);
  load_structs<1>(s.opacity_logits + i, count, &opacity);
  opacity = sigmoid(opacity);
  store_structs<3>(out.means + 3 * i, count, mean);
  store_structs<4>(out.quats + 4 * i, count, quat);
  store_structs<3>(out.scales + 3 * i, count, scale);
  store_structs<1>(out.opacities + i, count, &opacity);
  store_structs<9>(out.sh_frames + 9 * i, count, g.rotation);
}

void skin_group_backward(const Skin& s, const SkinOutput& v, const SkinGradient& out, size_t i, int count) {
  Group g;
  prepare(s, i, count, g);
  F v_mean[3], mean[3], v_quat[4], v_unit[4], quat[4], v_scale[3], scale[3], v_opacity, opacity;
  load_structs<3>(v.means + 3 * i, count, v_mean);
  for (int c = 0; c < 3; c++)
    mean[c] = fma(g.map[c], v_mean[0], fma(g.map[4 + c], v_mean[1], g.map[8 + c] * v_mean[2]));
  load_structs<4>(v.quats + 4 * i, count, v_quat);
  const F back[4] = {g.turn[0], -g.turn[1], -g.turn[2], -g.turn[3]};
  multiply(back, v_quat, v_unit);
  const F along = fma(g.unit[0], v_unit[0], fma(g.unit[1], v_unit[1], fma(g.unit[2], v_unit[2], g.unit[3] * v_unit[3])));
  for (int j = 0; j < 4; j++) quat[j] = fnma(along, g.unit[j], v_unit[j]) * g.inverse_length;
  load_structs<3>(v.scales + 3 * i, count, v_scale);
  load_structs<3>(s.log_scales + 3 * i, count, scale);
  for (int c = 0; c < 3; c++) scale[c] = v_scale[c] * exponential(scale[c]);
  load_structs<1>(v.opacities + i, count, &v_opacity);
  load_structs<1>(s.opacity_logits + i, count, &opacity);
  opacity = sigmoid(opacity);
  opacity = v_opacity * opacity * (F(1.f) - opacity);
  store_structs<3>(out.means + 3 * i, count, mean);
  store_structs<4>(out.quats + 4 * i, count, quat);
  store_structs<3>(out.log_scales + 3 * i, count, scale);
  store_structs<1>(out.opacity_logits + i, count, &opacity);
}

template <class Body>
inline void for_groups(int n, int threads, const Body& body) {
  parallel_for(threads, chunks(n), [&](int chunk) {
    const int end = imin(n, (chunk + 1) * kChunk);
    for (int i = chunk * kChunk; i < end; i += kWidth) body(static_cast<size_t>(i), imin(kWidth, end - i));
  });
}

}  // namespace

void skin(const Skin& input, const SkinOutput& output, int threads) {
  for_groups(input.n, threads, [&](size_t i, int count) { skin_group(input, output, i, count); });
}

void skin_backward(const Skin& input, const SkinOutput& upstream, const SkinGradient& gradient, int threads) {
  for_groups(input.n, threads, [&](size_t i, int count) { skin_group_backward(input, upstream, gradient, i, count); });
}

}  // namespace TGB_ISA
}  // namespace tgb
