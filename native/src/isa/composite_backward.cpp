// Stage 1 of the backward pass: each tile back to front, to sums per (Gaussian, tile).
//
// With weight w = alpha T, colour gradient v and G = <rgb, v>: d loss/d alpha = T G - Q / (1 - alpha), where Q is
// what lies behind (sum of w G, background and opacity terms). Going backwards, T before a splat is T after it
// divided by 1 - alpha. The splat's geometry follows from the moments of X = alpha_raw d loss/d alpha in the
// whitened coordinates (u, v) of its exponent; the clamp at alpha_max is ignored by the gradient.
#include "blocks.h"
#include "kernels.h"

namespace tgb {
namespace TGB_ISA {
namespace {

// Layout of a slot; project_backward.cpp reads it.
// 0 X   1 Xu   2 Xv   3 Xuu   4 Xuv   5 Xvv   6 r   7 g   8 b   9, 10: Xu, Xv of the alpha loss alone

struct Pixels {
  alignas(64) float T[kBlocks][kLanes], Q[kBlocks][kLanes];
  alignas(64) float r[kBlocks][kLanes], g[kBlocks][kLanes], b[kBlocks][kLanes];  // d loss / d colour
  alignas(64) float alpha[kBlocks][kLanes];  // final T times d loss / d alpha
};

void load_tile(Pixels& pixels, const Frame& frame, const Scene& scene, const Gradients& gradients, int tile) {
  const TileView view(frame, scene, tile);
  if (!view.whole()) memset(&pixels, 0, sizeof pixels);
  float r[kTile] = {}, g[kTile] = {}, b[kTile] = {}, a[kTile] = {};
  for (int y = 0; y < view.height; y++) {
    const size_t row = static_cast<size_t>(view.top + y) * scene.camera.width + view.left;
    const float* v = gradients.v_color + 3 * row;
    for (int x = 0; x < view.width; x++) r[x] = v[3 * x], g[x] = v[3 * x + 1], b[x] = v[3 * x + 2];
    memcpy(a, gradients.v_alpha + row, view.width * sizeof(float));
    for (int x = 0; x < kTile; x += kBlock) {
      const int block = y / kBlock * kBlocksAcross + x / kBlock, lane = y % kBlock * kBlock;
      copy_quad(pixels.r[block] + lane, r + x), copy_quad(pixels.g[block] + lane, g + x);
      copy_quad(pixels.b[block] + lane, b + x), copy_quad(pixels.alpha[block] + lane, a + x);
    }
  }
  const F red(scene.background[0]), green(scene.background[1]), blue(scene.background[2]);
  const float* final_T = frame.transmittance.data() + static_cast<size_t>(tile) * kBlocks * kLanes;
  for (int block = 0; block < kBlocks; block++)
    for (int k = 0; k < kLanes; k += kWidth) {
      const F T = load(final_T + block * kLanes + k), from_alpha = T * load(pixels.alpha[block] + k);
      const F behind = fma(red, load(pixels.r[block] + k),
                           fma(green, load(pixels.g[block] + k), blue * load(pixels.b[block] + k)));
      store(pixels.T[block] + k, T), store(pixels.alpha[block] + k, from_alpha);
      store(pixels.Q[block] + k, fma(T, behind, -from_alpha));
    }
}

struct Sums {
  F x{0.f}, u{0.f}, v{0.f}, uu{0.f}, uv{0.f}, vv{0.f}, r{0.f}, g{0.f}, b{0.f}, alpha_u{0.f}, alpha_v{0.f};
};

// Adds one block to the sums of one splat. Split: keep the share of the alpha loss in the mean's gradient apart.
template <bool Split>
inline void accumulate(Pixels& pixels, const float* last, int block, const Splat& s, F mx, F my, F index,
                       const F& threshold, const F& alpha_max, Sums& sums) {
  for (int k = 0; k < kLanes; k += kWidth) {
    const F dx = load(block_x(block) + k) - mx, dy = load(block_y(block) + k) - my;
    const F u = fma(F(s.ux), dx, F(s.uy) * dy), v = F(s.vy) * dy, exponent = fnma(v, v, fnma(u, u, F(s.lo)));
    const M counts = both(ge(exponent, threshold), ge(load(last + k), index));
    const F raw = keep(counts, exp2(exponent)), alpha = vmin(raw, alpha_max), rest = reciprocal(F(1.f) - alpha);
    const F T = load(pixels.T[block] + k) * rest, weight = alpha * T;
    store(pixels.T[block] + k, T);
    const F r = load(pixels.r[block] + k), g = load(pixels.g[block] + k), b = load(pixels.b[block] + k);
    sums.r = fma(weight, r, sums.r), sums.g = fma(weight, g, sums.g), sums.b = fma(weight, b, sums.b);
    const F G = fma(F(s.r), r, fma(F(s.g), g, F(s.b) * b)), Q = load(pixels.Q[block] + k);
    store(pixels.Q[block] + k, fma(weight, G, Q));
    const F X = raw * fnma(Q, rest, T * G), Xu = X * u, Xv = X * v;
    sums.x += X, sums.u += Xu, sums.v += Xv;
    sums.uu = fma(Xu, u, sums.uu), sums.uv = fma(Xu, v, sums.uv), sums.vv = fma(Xv, v, sums.vv);
    if (Split) {
      const F from_alpha = raw * rest * load(pixels.alpha[block] + k);
      sums.alpha_u = fma(from_alpha, u, sums.alpha_u), sums.alpha_v = fma(from_alpha, v, sums.alpha_v);
    }
  }
}

template <bool Split>
void composite_tile_backward(Frame& frame, const Scene& scene, const Gradients& gradients, int tile) {
  Pixels pixels;
  load_tile(pixels, frame, scene, gradients, tile);
  const TileView view(frame, scene, tile);
  const float* last = frame.last.data() + static_cast<size_t>(tile) * kBlocks * kLanes;
  const uint32_t begin = frame.tile_begin[tile], end = frame.tile_begin[tile + 1], used = begin + frame.tile_used[tile];
  const F threshold(log2f(scene.constants.alpha_min)), alpha_max(scene.constants.alpha_max);
  const auto slot = [&](uint32_t e) { return frame.slots.data() + (frame.list[e] >> 32) * kSlot; };
  for (uint32_t e = used; e-- > begin;) {
    if (e >= begin + 6) {
      __builtin_prefetch(&frame.records[static_cast<uint32_t>(frame.list[e - 6])]);
      __builtin_prefetch(slot(e - 6), 1);
    }
    float* out = slot(e);
    if (frame.masks[e] == 0) {
      memset(out, 0, kSlot * sizeof(float));
      continue;
    }
    const Splat& s = frame.records[static_cast<uint32_t>(frame.list[e])];
    const F mx(s.mx - view.left), my(s.my - view.top), index(static_cast<float>(e - begin));
    Sums sums;
    for (uint64_t rest = frame.masks[e]; rest != 0; rest &= rest - 1) {
      const int b = __builtin_ctzll(rest);
      accumulate<Split>(pixels, last + b * kLanes, b, s, mx, my, index, threshold, alpha_max, sums);
    }
    sum4(out, sums.x, sums.u, sums.v, sums.uu);
    sum4(out + 4, sums.uv, sums.vv, sums.r, sums.g);
    sum4(out + 8, sums.b, sums.alpha_u, sums.alpha_v, F(0.f));
    memset(out + 12, 0, 4 * sizeof(float));
  }
  for (uint32_t e = used; e < end; e++) memset(slot(e), 0, kSlot * sizeof(float));  // hidden behind opaque pixels
}

}  // namespace

void composite_backward(Frame& frame, const Scene& scene, const Gradients& gradients) {
  frame.slots.need(static_cast<size_t>(frame.pairs) * kSlot);
  const bool split = gradients.mean2d_color != nullptr;
  parallel_for(scene.threads, frame.tiles_x * frame.tiles_y, [&](int tile) {
    if (split)
      composite_tile_backward<true>(frame, scene, gradients, tile);
    else
      composite_tile_backward<false>(frame, scene, gradients, tile);
  });
}

}  // namespace TGB_ISA
}  // namespace tgb
