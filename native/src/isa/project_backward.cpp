// Stage 2 of the backward pass: the slots of each Gaussian summed in order, and the chain rule back to its inputs.
#include "harmonics.h"
#include "kernels.h"
#include "projection.h"

namespace tgb {
namespace TGB_ISA {
namespace {

constexpr int kSums = 11;
constexpr float kTwoOverLog2e = 1.3862943611198906f;     // (u, v) carry a factor sqrt(log2(e) / 2):
constexpr float kRootTwoOverLog2e = 1.1774100225154747f;  // undone here

// Sums of one Gaussian's slots, per lane; returns whether any lane is drawn.
inline bool gather(const Frame& frame, int i, int count, float sums[][kWidth]) {
  bool any_drawn = false;
  memset(sums, 0, kSums * kWidth * sizeof(float));
  for (int lane = 0; lane < count; lane++) {
    if (!frame.drawn[i + lane]) continue;
    any_drawn = true;
    alignas(64) float total[kSlot];
    F sum[kSlot / kWidth];
    for (F& part : sum) part = F(0.f);
    const float* slot = frame.slots.data() + static_cast<size_t>(frame.slot_begin[i + lane]) * kSlot;
    for (uint32_t k = frame.slot_begin[i + lane]; k < frame.slot_begin[i + lane + 1]; k++, slot += kSlot)
      for (int c = 0; c < kSlot; c += kWidth) sum[c / kWidth] += load(slot + c);
    for (int c = 0; c < kSlot; c += kWidth) store(total + c, sum[c / kWidth]);
    for (int c = 0; c < kSums; c++) sums[c][lane] = total[c];
  }
  return any_drawn;
}

// Factor L of the conic: d^T conic d = |L^T d|^2, L = [[l0, 0], [l1, l2]].
struct Factor {
  F l0, l1, l2;
  explicit Factor(const Projection& p) {
    l0 = vsqrt(p.c / p.det), l1 = -(l0 * p.b / p.c), l2 = reciprocal_root(p.c);
  }
};

// d loss / d centre (camera frame), scale and quaternion from d loss / d 2D mean and covariance.
struct GeometryGradient {
  F centre[3], scale[3], q[4];
};

inline void quaternion_backward(const F* q, const F* vR, F* out) {
  const F w = q[0], x = q[1], y = q[2], z = q[3], two(2.f);
  out[0] = two * (x * (vR[7] - vR[5]) + y * (vR[2] - vR[6]) + z * (vR[3] - vR[1]));
  out[1] = two * (y * (vR[3] + vR[1]) + z * (vR[6] + vR[2]) + w * (vR[7] - vR[5]) - two * x * (vR[4] + vR[8]));
  out[2] = two * (x * (vR[3] + vR[1]) + z * (vR[7] + vR[5]) + w * (vR[2] - vR[6]) - two * y * (vR[0] + vR[8]));
  out[3] = two * (x * (vR[6] + vR[2]) + y * (vR[7] + vR[5]) + w * (vR[3] - vR[1]) - two * z * (vR[0] + vR[4]));
}

// (S00, S01, S11): d loss / d covariance as a symmetric matrix; (mx, my): d loss / d 2D mean.
inline void geometry_backward(const View& view, const Projection& p, F mx, F my, F S00, F S01, F S11,
                              GeometryGradient& g) {
  const F two(2.f);
  F vU[6], vT[6], vR[9];
  for (int j = 0; j < 3; j++) {
    vU[j] = two * fma(S00, p.U[j], S01 * p.U[3 + j]);
    vU[3 + j] = two * fma(S01, p.U[j], S11 * p.U[3 + j]);
  }
  for (int j = 0; j < 3; j++) {
    F v[3];
    for (int k = 0; k < 3; k++) v[k] = fma(p.T[k], vU[j], p.T[3 + k] * vU[3 + j]);
    g.scale[j] = fma(v[0], p.Rq[j], fma(v[1], p.Rq[3 + j], v[2] * p.Rq[6 + j]));
    for (int k = 0; k < 3; k++) vR[3 * k + j] = v[k] * p.scale[j];
  }
  quaternion_backward(p.q, vR, g.q);
  for (int r = 0; r < 2; r++)
    for (int k = 0; k < 3; k++)
      vT[3 * r + k] = fma(vU[3 * r], p.RS[3 * k], fma(vU[3 * r + 1], p.RS[3 * k + 1], vU[3 * r + 2] * p.RS[3 * k + 2]));
  const float* R = view.R;
  const F vJ00 = fma(vT[0], F(R[0]), fma(vT[1], F(R[1]), vT[2] * F(R[2])));
  const F vJ02 = fma(vT[0], F(R[6]), fma(vT[1], F(R[7]), vT[2] * F(R[8])));
  const F vJ11 = fma(vT[3], F(R[3]), fma(vT[4], F(R[4]), vT[5] * F(R[5])));
  const F vJ12 = fma(vT[3], F(R[6]), fma(vT[4], F(R[7]), vT[5] * F(R[8])));
  const F fx(view.fx), fy(view.fy), iz = p.inverse_z, iz2 = iz * iz;
  // J02 = -fx tx / z^2: a clamped tx counts as a constant.
  const F vtx = -(fx * iz2 * vJ02), vty = -(fy * iz2 * vJ12);
  g.centre[0] = fma(fx * iz, mx, keep(p.free_x, vtx));
  g.centre[1] = fma(fy * iz, my, keep(p.free_y, vty));
  const F from_mean = fma(fx * p.x, mx, fy * p.y * my), from_J = fma(fx, vJ00, fy * vJ11);
  g.centre[2] = -(iz2 * (from_mean + from_J)) - two * iz * fma(vtx, p.tx, vty * p.ty);
}

// Adds the colour's part: d loss / d SH to memory, and through the view direction to the world-frame mean.
void colour_backward(const View& view, const Frame& frame, const Scene& scene, const Gradients& gradients,
                     const Projection& p, int i, int count, M drawn, const float rgb[][kWidth], F* v_mean) {
  const Splats& splats = scene.splats;
  const int degree = splats.sh_degree, used = (degree + 1) * (degree + 1), stored = splats.sh_stored;
  Directions d;
  view_directions(view, splats, p, i, count, d);
  F basis[16], weight[16];
  harmonics_basis<F>(degree, d.local[0], d.local[1], d.local[2], basis);
  alignas(64) float b[16][kWidth], w[16][kWidth] = {};
  for (int k = 0; k < used; k++) store(b[k], basis[k]);
  for (int lane = 0; lane < count; lane++) {
    const size_t at = static_cast<size_t>(i + lane) * stored * 3;
    const float* sh = splats.sh + at;
    float v[3], *out = gradients.sh + at;
    if (!frame.drawn[i + lane]) {
      memset(out, 0, 3 * sizeof(float) * stored);
      continue;
    }
    for (int c = 0; c < 3; c++) v[c] = frame.clamped[i + lane] >> c & 1 ? 0 : rgb[c][lane];
    for (int k = 0; k < used; k++) {
      for (int c = 0; c < 3; c++) out[3 * k + c] = b[k][lane] * v[c];
      w[k][lane] = v[0] * sh[3 * k] + v[1] * sh[3 * k + 1] + v[2] * sh[3 * k + 2];
    }
    for (int k = 3 * used; k < 3 * stored; k++) out[k] = 0;
  }
  for (int k = 0; k < used; k++) weight[k] = load(w[k]);
  F local[3], world[3];
  harmonics_gradient<F>(degree, d.local[0], d.local[1], d.local[2], weight, local[0], local[1], local[2]);
  for (int k = 0; k < 3; k++) world[k] = local[k];
  if (splats.sh_frames != nullptr) {
    F R[9], vR[9];
    load_structs<9>(splats.sh_frames + 9 * static_cast<size_t>(i), count, R);
    for (int r = 0; r < 3; r++) {
      world[r] = fma(R[3 * r], local[0], fma(R[3 * r + 1], local[1], R[3 * r + 2] * local[2]));
      for (int c = 0; c < 3; c++) vR[3 * r + c] = keep(drawn, d.world[r] * local[c]);
    }
    if (gradients.sh_frames != nullptr) store_structs<9>(gradients.sh_frames + 9 * static_cast<size_t>(i), count, vR);
  }
  const F along = fma(world[0], d.world[0], fma(world[1], d.world[1], world[2] * d.world[2]));
  for (int k = 0; k < 3; k++) v_mean[k] += fnma(d.world[k], along, world[k]) * d.inverse_length;
}

void clear_gradients(const Scene& scene, const Gradients& gradients, int i, int count) {
  const auto zero = [&](float* p, size_t width) {
    if (p != nullptr) memset(p + i * width, 0, count * width * sizeof(float));
  };
  zero(gradients.means, 3), zero(gradients.quats, 4), zero(gradients.scales, 3), zero(gradients.opacities, 1);
  zero(gradients.sh, 3 * static_cast<size_t>(scene.splats.sh_stored));
  zero(gradients.sh_frames, 9), zero(gradients.mean2d_color, 2);
}

void group_backward(const View& view, const Frame& frame, const Scene& scene, const Gradients& gradients, int i,
                    int count) {
  alignas(64) float sums[kSums][kWidth], drawn_lane[kWidth] = {}, opacity[kWidth];
  if (!gather(frame, i, count, sums)) return clear_gradients(scene, gradients, i, count);
  for (int lane = 0; lane < count; lane++) drawn_lane[lane] = frame.drawn[i + lane];
  for (int lane = 0; lane < kWidth; lane++) opacity[lane] = scene.splats.opacities[i + imin(lane, count - 1)];
  // Where a lane is not drawn its projection may be inf or NaN, and NaN x 0 is NaN: outputs are masked.
  const M drawn = gt(load(drawn_lane), F(0.f));
  Projection p;
  project(view, scene, i, count, p);
  const Factor f(p);
  const F half(0.5f), root(kRootTwoOverLog2e), square(half * F(kTwoOverLog2e));
  const F u = load(sums[1]) * root, v = load(sums[2]) * root;
  const F uu = load(sums[3]) * square, uv = load(sums[4]) * square, vv = load(sums[5]) * square;
  // d exponent / d mean = conic d = L (u, v);  d exponent / d covariance = 1/2 (L w)(L w)^T
  const F mx = f.l0 * u, my = fma(f.l1, u, f.l2 * v);
  const F r0 = f.l0 * uu, r1 = f.l0 * uv, s0 = fma(f.l1, uu, f.l2 * uv), s1 = fma(f.l1, uv, f.l2 * vv);
  GeometryGradient g;
  geometry_backward(view, p, mx, my, f.l0 * r0, fma(f.l1, r0, f.l2 * r1), fma(f.l1, s0, f.l2 * s1), g);
  F v_mean[3];
  const float* R = view.R;
  for (int k = 0; k < 3; k++)
    v_mean[k] = fma(F(R[k]), g.centre[0], fma(F(R[3 + k]), g.centre[1], F(R[6 + k]) * g.centre[2]));
  colour_backward(view, frame, scene, gradients, p, i, count, drawn, sums + 6, v_mean);
  const size_t at = static_cast<size_t>(i);
  for (F& value : v_mean) value = keep(drawn, value);
  for (F& value : g.q) value = keep(drawn, value);
  for (F& value : g.scale) value = keep(drawn, value);
  store_structs<3>(gradients.means + 3 * at, count, v_mean);
  store_structs<4>(gradients.quats + 4 * at, count, g.q);
  store_structs<3>(gradients.scales + 3 * at, count, g.scale);
  const F v_opacity = keep(drawn, load(sums[0]) / load(opacity));
  store_structs<1>(gradients.opacities + at, count, &v_opacity);
  if (gradients.mean2d_color != nullptr) {
    // X of the alpha loss enters the sums with a plus sign, so the colour part is the rest.
    const F cu = u - load(sums[9]) * root, cv = v - load(sums[10]) * root;
    const F color[2] = {keep(drawn, f.l0 * cu), keep(drawn, fma(f.l1, cu, f.l2 * cv))};
    store_structs<2>(gradients.mean2d_color + 2 * at, count, color);
  }
}

}  // namespace

void project_backward(Frame& frame, const Scene& scene, const Gradients& gradients) {
  const View view(scene);
  const int n = scene.splats.n;
  parallel_for(scene.threads, chunks(n), [&](int chunk) {
    const int end = imin(n, (chunk + 1) * kChunk);
    for (int i = chunk * kChunk; i < end; i += kWidth)
      group_backward(view, frame, scene, gradients, i, imin(kWidth, end - i));
  });
}

}  // namespace TGB_ISA
}  // namespace tgb
