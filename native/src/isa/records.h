// From projected Gaussians to records (Splat) and what ordering reads of them.
#pragma once
#include "projection.h"

namespace tgb {
namespace TGB_ISA {

constexpr float kHalfLog2e = 0.72134752044448170f, kTwoLn2 = 1.3862943611198906f;
constexpr float kGuard = 0.01f;  // px added around a bounding box against rounding

// A projected group, laid out for the scalar part.
struct Lanes {
  alignas(64) float px[kWidth], py[kWidth], ux[kWidth], uy[kWidth], vy[kWidth], lo[kWidth];
  alignas(64) float width[kWidth], tip[kWidth], depth[kWidth], radius[kWidth];
  alignas(64) float tile_begin[2][kWidth], tile_end[2][kWidth];    // 3DGB's tiles, x and y, before truncation
  alignas(64) float block_begin[2][kWidth], block_end[2][kWidth];  // blocks within reach, before truncation
};

// Along one axis of `size` px: the tiles that 3DGB's square of `radius` about p touches, and the blocks with a pixel
// centre within `reach` of p.
static inline void ranges(Lanes& lanes, int axis, F p, F radius, F reach, int tile, int size) {
  const F n(static_cast<float>((size + tile - 1) / tile)), side(static_cast<float>(tile)), zero(0.f);
  store(lanes.tile_begin[axis], clamp((p - radius) / side, zero, n));
  store(lanes.tile_end[axis], clamp((p + radius + F(tile - 1.f)) / side, zero, n));
  const F first = p - reach + F(1 - kGuard), last = p + reach + F(kGuard), block(static_cast<float>(kBlock));
  store(lanes.block_begin[axis], clamp(first, zero, F(static_cast<float>(size))) / block);
  store(lanes.block_end[axis], (clamp(last, -block, F(size - 1.f)) + block) / block);  // below 0: truncates to none
}

// log2 of an opacity; one that is not positive and finite is never drawn.
static inline F log2_of_opacity(F opacity) {
  return select(both(gt(opacity, F(0.f)), gt(F(1e30f), opacity)), log2(opacity), F(-1e30f));
}

// Lanes of `group` (bits) that may be drawn: 3DGB's rule before its tile test. Fills what the scalar part needs.
static inline uint32_t fill_lanes(const Scene& scene, const Projection& p, F log2_opacity, uint32_t group, Lanes& lanes) {
  const Constants& constants = scene.constants;
  M ok = both(gt(p.z, F(constants.near)), gt(p.det, F(0.f)));
  ok = both(ok, both(gt(F(1e30f), p.det), gt(F(1e30f), p.a + p.c)));  // an overflow or a NaN is not drawn
  const uint32_t visible = bits(ok) & group;
  if (visible == 0) return 0;

  const F threshold(log2f(constants.alpha_min));
  // alpha >= alpha_min inside the ellipse d^T conic d <= extent
  const F extent = vmax(F(0.f), (log2_opacity - threshold) * F(kTwoLn2));
  const F half_difference = F(0.5f) * (p.a - p.c), spread = fma(half_difference, half_difference, p.b * p.b);
  const F largest = F(0.5f) * (p.a + p.c) + vsqrt(vmax(F(0.1f), spread));
  const F radius = vceil(F(constants.radius_sigmas) * vsqrt(largest));
  store(lanes.radius, radius);
  ranges(lanes, 0, p.px, radius, vsqrt(extent * p.a), constants.tile, scene.camera.width);
  ranges(lanes, 1, p.py, radius, vsqrt(extent * p.c), constants.tile, scene.camera.height);
  store(lanes.px, p.px), store(lanes.py, p.py), store(lanes.depth, p.z), store(lanes.lo, log2_opacity);
  const F ux = vsqrt(F(kHalfLog2e) * p.c / p.det);
  store(lanes.ux, ux), store(lanes.uy, -(ux * (p.b / p.c))), store(lanes.vy, vsqrt(F(kHalfLog2e) / p.c));
  const F reach = vmax(F(0.f), log2_opacity - threshold + F(kSlack));
  store(lanes.width, F(1.f) / ux), store(lanes.tip, p.b * vsqrt(reach * F(1 / kHalfLog2e) / p.a));
  return visible;
}

// Fills the record of Gaussian i but for its colour, and returns whether it can reach a pixel; sets its 3DGB radius
// (0: not visible).
static inline bool place_record(Frame& frame, const Scene& scene, const Lanes& lanes, int i, int lane, int32_t& radius) {
  const int blocks = scene.constants.tile / kBlock;
  int begin[2], end[2];
  for (int axis = 0; axis < 2; axis++) {
    begin[axis] = static_cast<int>(lanes.tile_begin[axis][lane]), end[axis] = static_cast<int>(lanes.tile_end[axis][lane]);
    if (begin[axis] >= end[axis]) return false;
  }
  radius = lanes.radius[lane] < 1e9f ? static_cast<int32_t>(lanes.radius[lane]) : 1000000000;
  for (int axis = 0; axis < 2; axis++) {
    begin[axis] = imax(begin[axis] * blocks, static_cast<int>(lanes.block_begin[axis][lane]));
    end[axis] = imin(end[axis] * blocks, static_cast<int>(lanes.block_end[axis][lane]));
    if (begin[axis] >= end[axis]) return false;
  }
  Splat& s = frame.records[i];
  s.x0 = static_cast<float>(begin[0]), s.y0 = static_cast<float>(begin[1]);
  s.x1 = static_cast<float>(end[0]), s.y1 = static_cast<float>(end[1]);
  const auto tile = [](int block) { return static_cast<uint16_t>(block / kBlocksAcross); };
  frame.tiles[i] = {tile(begin[0]), tile(end[0] + kBlocksAcross - 1), tile(begin[1]), tile(end[1] + kBlocksAcross - 1)};
  frame.depth[i] = lanes.depth[lane];
  s.mx = lanes.px[lane], s.my = lanes.py[lane], s.lo = lanes.lo[lane];
  s.ux = lanes.ux[lane], s.uy = lanes.uy[lane], s.vy = lanes.vy[lane];
  s.width = lanes.width[lane], s.tip = lanes.tip[lane];
  s.place = 0;
  return true;
}

// Room for the records of n Gaussians, and the screen's tiles.
static inline void begin_frame(Frame& frame, const Scene& scene) {
  const size_t n = static_cast<size_t>(scene.splats.n);
  frame.tiles_x = (scene.camera.width + kTile - 1) / kTile, frame.tiles_y = (scene.camera.height + kTile - 1) / kTile;
  frame.records.need(n), frame.tiles.need(n), frame.depth.need(n), frame.drawn.need(n), frame.clamped.need(n);
  frame.slot_begin.need(n + 1), frame.visible_before.need(chunks(scene.splats.n) + 1);
}

}  // namespace TGB_ISA
}  // namespace tgb
