// Stage 1 of the forward pass: every Gaussian to its record (Splat), or dropped.
#include "kernels.h"
#include "harmonics.h"
#include "projection.h"

namespace tgb {
namespace TGB_ISA {
namespace {

constexpr float kHalfLog2e = 0.72134752044448170f, kTwoLn2 = 1.3862943611198906f;
constexpr float kGuard = 0.01f;  // px added around a bounding box against rounding

// One lane of a projected group, laid out for the scalar part.
struct Lanes {
  alignas(64) float px[kWidth], py[kWidth], ux[kWidth], uy[kWidth], vy[kWidth], lo[kWidth];
  alignas(64) float slope_x[kWidth], slope_y[kWidth], depth[kWidth], radius[kWidth], reach_x[kWidth], reach_y[kWidth];
  alignas(64) float basis[16][kWidth];
};

// Tiles [first, last) of side `tile` that 3DGB's square of `radius` about p touches, on an axis of `size` px.
inline void tile_range(float p, float radius, int tile, int size, int& first, int& last) {
  const float n = static_cast<float>((size + tile - 1) / tile), lo = (p - radius) / tile,
              hi = (p + radius + (tile - 1)) / tile;
  first = static_cast<int>(lo < 0 ? 0 : lo > n ? n : lo);
  last = static_cast<int>(hi < 0 ? 0 : hi > n ? n : hi);
}

// Blocks [first, last) with a pixel centre within `reach` of p, cut to [first, last) as given.
inline void cut_to_reach(float p, float reach, int size, uint16_t& first, uint16_t& last) {
  const float lo = p - reach + (1 - kGuard), hi = p + reach + kGuard;
  if (!(hi >= 0) || !(lo < size)) {
    last = first;
    return;
  }
  const int begin = lo < 0 ? 0 : static_cast<int>(lo) / kBlock;
  const int end = (hi > size - 1 ? size - 1 : static_cast<int>(hi)) / kBlock + 1;
  first = static_cast<uint16_t>(imax(first, begin)), last = static_cast<uint16_t>(imin(last, end));
}

template <int N>
inline void weigh(const float* sh, const float basis[][kWidth], int lane, float* rgb) {
  float r = 0, g = 0, b = 0;
  for (int k = 0; k < N; k++) {
    const float w = basis[k][lane];
    r += w * sh[3 * k], g += w * sh[3 * k + 1], b += w * sh[3 * k + 2];
  }
  rgb[0] = r, rgb[1] = g, rgb[2] = b;
}

// Colour max(0, sum + 0.5); returns the bits of channels clamped at 0.
inline uint8_t colour(const Splats& splats, const Lanes& lanes, int i, int lane, float* rgb) {
  const float* sh = splats.sh + static_cast<size_t>(i) * splats.sh_stored * 3;
  switch (splats.sh_degree) {
    case 0: weigh<1>(sh, lanes.basis, lane, rgb); break;
    case 1: weigh<4>(sh, lanes.basis, lane, rgb); break;
    case 2: weigh<9>(sh, lanes.basis, lane, rgb); break;
    default: weigh<16>(sh, lanes.basis, lane, rgb);
  }
  uint8_t clamped = 0;
  for (int k = 0; k < 3; k++) {
    rgb[k] += 0.5f;
    if (rgb[k] < 0) rgb[k] = 0, clamped |= static_cast<uint8_t>(1 << k);
  }
  return clamped;
}

// Fills the record of Gaussian i and returns whether it can reach a pixel; sets its 3DGB radius (0: not visible).
inline bool make_record(Frame& frame, const Scene& scene, const Lanes& lanes, int i, int lane, int32_t& radius) {
  const int tile = scene.constants.tile, width = scene.camera.width, height = scene.camera.height;
  const float px = lanes.px[lane], py = lanes.py[lane], r = lanes.radius[lane];
  int x0, x1, y0, y1;
  tile_range(px, r, tile, width, x0, x1);
  tile_range(py, r, tile, height, y0, y1);
  if (x1 <= x0 || y1 <= y0) return false;
  radius = r < 1e9f ? static_cast<int32_t>(r) : 1000000000;

  const float lo = lanes.lo[lane];
  Splat s;
  const int blocks = tile / kBlock;
  s.x0 = static_cast<uint16_t>(x0 * blocks), s.x1 = static_cast<uint16_t>(x1 * blocks);
  s.y0 = static_cast<uint16_t>(y0 * blocks), s.y1 = static_cast<uint16_t>(y1 * blocks);
  cut_to_reach(px, lanes.reach_x[lane], width, s.x0, s.x1);
  cut_to_reach(py, lanes.reach_y[lane], height, s.y0, s.y1);
  if (s.x1 <= s.x0 || s.y1 <= s.y0) return false;
  s.mx = px, s.my = py, s.ux = lanes.ux[lane], s.uy = lanes.uy[lane], s.vy = lanes.vy[lane], s.lo = lo;
  s.slope_x = lanes.slope_x[lane], s.slope_y = lanes.slope_y[lane];
  s.id = i, s.depth = lanes.depth[lane], s.unused = 0;
  frame.clamped[i] = colour(scene.splats, lanes, i, lane, &s.r);
  if (!__builtin_isfinite(s.r + s.g + s.b)) return false;
  frame.records[i] = s;
  return true;
}

// Lanes that 3DGB's rule would consider visible before its tile test; fills what the scalar part needs.
inline uint32_t prepare(const View& view, const Scene& scene, int i, int count, Lanes& lanes) {
  const Constants& constants = scene.constants;
  Projection p;
  project(view, scene, i, count, p);
  M ok = both(gt(p.z, F(constants.near)), gt(p.det, F(0.f)));
  ok = both(ok, both(gt(F(1e30f), p.det), gt(F(1e30f), p.a + p.c)));  // an overflow or a NaN is not drawn
  const uint32_t visible = bits(ok) & ((1u << count) - 1);
  if (visible == 0) return 0;

  alignas(64) float lo[kWidth];
  for (int lane = 0; lane < kWidth; lane++) lo[lane] = log2f(scene.splats.opacities[i + imin(lane, count - 1)]);
  const F log2_opacity = load(lo), threshold(log2f(constants.alpha_min));
  // alpha >= alpha_min inside the ellipse d^T conic d <= extent
  const F extent = vmax(F(0.f), (log2_opacity - threshold) * F(kTwoLn2));
  const F half_difference = F(0.5f) * (p.a - p.c), spread = fma(half_difference, half_difference, p.b * p.b);
  const F largest = F(0.5f) * (p.a + p.c) + vsqrt(vmax(F(0.1f), spread));
  store(lanes.radius, vceil(F(constants.radius_sigmas) * vsqrt(largest)));
  store(lanes.reach_x, vsqrt(extent * p.a)), store(lanes.reach_y, vsqrt(extent * p.c));
  store(lanes.px, p.px), store(lanes.py, p.py), store(lanes.depth, p.z), store(lanes.lo, log2_opacity);
  const F ux = vsqrt(F(kHalfLog2e) * p.c / p.det), slope_x = p.b / p.c;
  store(lanes.ux, ux), store(lanes.uy, -(ux * slope_x)), store(lanes.vy, vsqrt(F(kHalfLog2e) / p.c));
  store(lanes.slope_x, slope_x), store(lanes.slope_y, p.b / p.a);

  Directions d;
  view_directions(view, scene.splats, p, i, count, d);
  F basis[16];
  harmonics_basis<F>(scene.splats.sh_degree, d.local[0], d.local[1], d.local[2], basis);
  const int n = (scene.splats.sh_degree + 1) * (scene.splats.sh_degree + 1);
  for (int k = 0; k < n; k++) store(lanes.basis[k], basis[k]);
  return visible;
}

}  // namespace

void project_forward(Frame& frame, const Scene& scene, int32_t* radii) {
  const View view(scene);
  const int n = scene.splats.n;
  const float threshold = log2f(scene.constants.alpha_min);
  frame.tiles_x = (scene.camera.width + kTile - 1) / kTile, frame.tiles_y = (scene.camera.height + kTile - 1) / kTile;
  frame.records.need(n), frame.drawn.need(n), frame.clamped.need(n), frame.slot_begin.need(n + 1);
  frame.visible_before.need(chunks(n) + 1);
  parallel_for(scene.threads, chunks(n), [&](int chunk) {
    Lanes lanes;
    int visible_here = 0;
    const int end = imin(n, (chunk + 1) * kChunk);
    for (int i = chunk * kChunk; i < end; i += kWidth) {
      const int count = imin(kWidth, end - i);
      const uint32_t candidates = prepare(view, scene, i, count, lanes);
      for (int lane = 0; lane < count; lane++) {
        int32_t radius = 0;
        bool drawn = (candidates >> lane & 1) && make_record(frame, scene, lanes, i + lane, lane, radius);
        drawn = drawn && lanes.lo[lane] >= threshold && lanes.lo[lane] < 1e30f;
        frame.drawn[i + lane] = drawn;
        visible_here += drawn;
        if (radii != nullptr) radii[i + lane] = radius;
      }
    }
    frame.visible_before[chunk + 1] = visible_here;
  });
}

}  // namespace TGB_ISA
}  // namespace tgb
