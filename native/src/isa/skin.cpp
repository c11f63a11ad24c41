// Activation and skinning of Gaussians: raw parameters to splats, and its gradient.
#include "kernels.h"
#include "skinning.h"

namespace tgb {
namespace TGB_ISA {
namespace {

inline void prepare(const Skin& s, size_t i, int count, Group& g) {
  F weights[kJoints], raw[4];
  load_structs<kJoints>(s.weights + kJoints * i, count, weights);
  load_structs<4>(s.quats + 4 * i, count, raw);
  prepare(weights, raw, s.transforms, g);
}

void skin_group(const Skin& s, const SkinOutput& out, size_t i, int count) {
  Group g;
  prepare(s, i, count, g);
  F rest[3], mean[3], quat[4], scale[3], opacity;
  load_structs<3>(s.means + 3 * i, count, rest);
  move(g, rest, mean);
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
