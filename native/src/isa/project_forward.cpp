// Stage 1 of the forward pass: every Gaussian to its record (Splat), or dropped.
#include "kernels.h"
#include "harmonics.h"
#include "projection.h"

namespace tgb {
namespace TGB_ISA {
namespace {

constexpr float kHalfLog2e = 0.72134752044448170f, kTwoLn2 = 1.3862943611198906f;
constexpr float kGuard = 0.01f;  // px added around a bounding box against rounding

// A projected group, laid out for the scalar part.
struct Lanes {
  alignas(64) float px[kWidth], py[kWidth], ux[kWidth], uy[kWidth], vy[kWidth], lo[kWidth];
  alignas(64) float slope_x[kWidth], slope_y[kWidth], depth[kWidth], radius[kWidth];
  alignas(64) float tile_begin[2][kWidth], tile_end[2][kWidth];    // 3DGB's tiles, x and y, before truncation
  alignas(64) float block_begin[2][kWidth], block_end[2][kWidth];  // blocks within reach, before truncation
  alignas(64) float basis[16][kWidth];
};

// Along one axis of `size` px: the tiles that 3DGB's square of `radius` about p touches, and the blocks with a pixel
// centre within `reach` of p.
inline void ranges(Lanes& lanes, int axis, F p, F radius, F reach, int tile, int size) {
  const F n(static_cast<float>((size + tile - 1) / tile)), side(static_cast<float>(tile)), zero(0.f);
  store(lanes.tile_begin[axis], clamp((p - radius) / side, zero, n));
  store(lanes.tile_end[axis], clamp((p + radius + F(tile - 1.f)) / side, zero, n));
  const F first = p - reach + F(1 - kGuard), last = p + reach + F(kGuard), block(static_cast<float>(kBlock));
  store(lanes.block_begin[axis], clamp(first, zero, F(static_cast<float>(size))) / block);
  store(lanes.block_end[axis], (clamp(last, -block, F(size - 1.f)) + block) / block);  // below 0: truncates to none
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
  frame.clamped[i] = colour(scene.splats, lanes, i, lane, &s.r);
  if (!__builtin_isfinite(s.r + s.g + s.b)) return false;
  s.x0 = static_cast<uint16_t>(begin[0]), s.x1 = static_cast<uint16_t>(end[0]);
  s.y0 = static_cast<uint16_t>(begin[1]), s.y1 = static_cast<uint16_t>(end[1]);
  s.mx = lanes.px[lane], s.my = lanes.py[lane], s.lo = lanes.lo[lane];
  s.ux = lanes.ux[lane], s.uy = lanes.uy[lane], s.vy = lanes.vy[lane];
  s.slope_x = lanes.slope_x[lane], s.slope_y = lanes.slope_y[lane];
  s.id = i, s.depth = lanes.depth[lane], s.place = 0;
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
  const F radius = vceil(F(constants.radius_sigmas) * vsqrt(largest));
  store(lanes.radius, radius);
  ranges(lanes, 0, p.px, radius, vsqrt(extent * p.a), constants.tile, scene.camera.width);
  ranges(lanes, 1, p.py, radius, vsqrt(extent * p.c), constants.tile, scene.camera.height);
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
