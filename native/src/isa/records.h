// From projected Gaussians to records (Splat) and what ordering reads of them.
#pragma once
#include "projection.h"

namespace tgb {
namespace TGB_ISA {

constexpr float kHalfLog2e = 0.72134752044448170f, kTwoLn2 = 1.3862943611198906f;
constexpr float kGuard = 0.01f;  // px added around a bounding box against rounding

// Records of a group, field by field; those of lanes that are not drawn are anything, NaN included.
struct Records {
  F mx, my, ux, uy, vy, lo, width, tip, x0, y0, x1, y1, depth;
  F radius;  // 3DGB's, px; 0 where not visible
  M drawn;   // but for the colour
};

// Along one axis of `size` px: 3DGB's tiles that the square of `radius` about p touches, in blocks, and the blocks with
// a pixel centre within `reach` of p.
static inline void ranges(F p, F radius, F reach, int tile, int size, F& tile_begin, F& tile_end, F& begin, F& end) {
  const F n(static_cast<float>((size + tile - 1) / tile)), side(static_cast<float>(tile)), zero(0.f);
  const F to_tiles(1.f / static_cast<float>(tile)), blocks(static_cast<float>(tile / kBlock)), to_blocks(1.f / kBlock);
  const bool exact = (tile & (tile - 1)) == 0;  // then one over it is, too
  const auto in_tiles = [&](F x) { return vfloor(clamp(exact ? x * to_tiles : x / side, zero, n)) * blocks; };
  tile_begin = in_tiles(p - radius), tile_end = in_tiles(p + radius + F(tile - 1.f));
  const F first = p - reach + F(1 - kGuard), last = p + reach + F(kGuard), block(static_cast<float>(kBlock));
  begin = vmax(tile_begin, vfloor(clamp(first, zero, F(static_cast<float>(size))) * to_blocks));
  end = vmin(tile_end, vfloor((clamp(last, -block, F(size - 1.f)) + block) * to_blocks));  // below 0: none
}

// log2 of an opacity; one that is not positive and finite is never drawn.
static inline F log2_of_opacity(F opacity) {
  return select(both(gt(opacity, F(0.f)), gt(F(1e30f), opacity)), log2(opacity), F(-1e30f));
}

// Returns the lanes of `group` (bits) that may be drawn; none are filled in where there are none.
static inline uint32_t make_records(const Scene& scene, const Projection& p, F log2_opacity, uint32_t group, Records& out) {
  const Constants& constants = scene.constants;
  M ok = both(gt(p.z, F(constants.near)), gt(p.det, F(0.f)));
  ok = both(ok, both(gt(F(1e30f), p.det), gt(F(1e30f), p.a + p.c)));  // an overflow or a NaN is not drawn
  if ((bits(ok) & group) == 0) return 0;

  const F threshold(log2f(constants.alpha_min)), zero(0.f);
  // alpha >= alpha_min inside the ellipse d^T conic d <= extent
  const F extent = vmax(zero, (log2_opacity - threshold) * F(kTwoLn2));
  const F half_difference = F(0.5f) * (p.a - p.c), spread = fma(half_difference, half_difference, p.b * p.b);
  const F largest = F(0.5f) * (p.a + p.c) + vsqrt(vmax(F(0.1f), spread));
  const F radius = vceil(F(constants.radius_sigmas) * vsqrt(largest));
  F left, right, top, bottom;
  ranges(p.px, radius, root(extent * p.a), constants.tile, scene.camera.width, left, right, out.x0, out.x1);
  ranges(p.py, radius, root(extent * p.c), constants.tile, scene.camera.height, top, bottom, out.y0, out.y1);
  const M visible = both(ok, both(gt(right, left), gt(bottom, top)));
  out.radius = keep(visible, vmin(radius, F(1e9f)));
  out.drawn = both(both(visible, ge(log2_opacity, threshold)), both(gt(out.x1, out.x0), gt(out.y1, out.y0)));

  const F over_c = reciprocal(p.c), square = p.det * over_c * F(1 / kHalfLog2e);
  out.mx = p.px, out.my = p.py, out.depth = p.z, out.lo = log2_opacity;
  out.ux = reciprocal_root(square), out.width = square * out.ux;
  out.uy = -(out.ux * p.b * over_c), out.vy = root(F(kHalfLog2e) * over_c);
  const F reach = vmax(zero, log2_opacity - threshold + F(kSlack));
  out.tip = p.b * root(reach * F(1 / kHalfLog2e) * reciprocal(p.a));
  return bits(out.drawn) & group;
}

// Writes the records of `count` Gaussians from `i` on, with their colours, and returns how many are drawn.
static inline int write_records(Frame& frame, const Records& in, const F* rgb, int i, int count) {
  const F sum = rgb[0] + rgb[1] + rgb[2];  // one that is not finite is not drawn
  const uint32_t drawn = bits(both(in.drawn, both(gt(F(1e30f), sum), gt(sum, F(-1e30f))))) & ((1u << count) - 1);
  for (int lane = 0; lane < count; lane++) frame.drawn[i + lane] = drawn >> lane & 1;
  if (drawn == 0) return 0;
  const F fields[kSplatFloats] = {in.mx, in.my,  in.ux,  in.uy,  in.vy, in.lo, in.width, in.tip,
                                  rgb[0], rgb[1], rgb[2], F(0.f), in.x0, in.y0, in.x1,    in.y1};
  store_structs<kSplatFloats>(&frame.records[i].mx, count, fields);
  const F across(1.f / kBlocksAcross), shift(static_cast<float>(1 << TileRect::kBits));
  const auto pair = [&](F begin, F end) { return fma(vceil(end * across), shift, vfloor(begin * across)); };
  store_ints(&frame.tile_columns[i], pair(in.x0, in.x1)), store_ints(&frame.tile_rows[i], pair(in.y0, in.y1));
  store_unaligned(&frame.depth[i], in.depth);
  return __builtin_popcount(drawn);
}

// Room for the records of n Gaussians, and the screen's tiles.
static inline void begin_frame(Frame& frame, const Scene& scene) {
  const size_t n = static_cast<size_t>(scene.splats.n);
  frame.tiles_x = (scene.camera.width + kTile - 1) / kTile, frame.tiles_y = (scene.camera.height + kTile - 1) / kTile;
  frame.records.need(n), frame.drawn.need(n), frame.clamped.need(n);
  // Written in whole vectors.
  frame.tile_columns.need(n + kWidth), frame.tile_rows.need(n + kWidth), frame.depth.need(n + kWidth);
  frame.slot_begin.need(n + 1), frame.visible_before.need(chunks(scene.splats.n) + 1);
}

}  // namespace TGB_ISA
}  // namespace tgb
