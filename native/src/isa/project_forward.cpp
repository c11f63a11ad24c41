// Stage 1 of the forward pass: every Gaussian to its record (Splat), or dropped.
#include "harmonics.h"
#include "kernels.h"
#include "records.h"

namespace tgb {
namespace TGB_ISA {
namespace {

struct Basis {
  alignas(64) float values[16][kWidth];
};
struct Colours {
  alignas(64) float rgb[3][kWidth] = {};
};

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
inline uint8_t colour(const Splats& splats, const Basis& basis, int i, int lane, float* rgb) {
  const float* sh = splats.sh + static_cast<size_t>(i) * splats.sh_stored * 3;
  switch (splats.sh_degree) {
    case 0: weigh<1>(sh, basis.values, lane, rgb); break;
    case 1: weigh<4>(sh, basis.values, lane, rgb); break;
    case 2: weigh<9>(sh, basis.values, lane, rgb); break;
    default: weigh<16>(sh, basis.values, lane, rgb);
  }
  uint8_t clamped = 0;
  for (int k = 0; k < 3; k++) {
    rgb[k] += 0.5f;
    if (rgb[k] < 0) rgb[k] = 0, clamped |= static_cast<uint8_t>(1 << k);
  }
  return clamped;
}

// Lanes that may be drawn, their records, and the harmonics towards the camera.
inline uint32_t prepare(const View& view, const Scene& scene, int i, int count, Records& records, Basis& basis) {
  Projection p;
  project(view, scene, i, count, p);
  F opacity;
  load_structs<1>(scene.splats.opacities + i, count, &opacity);
  const uint32_t candidates = make_records(scene, p, log2_of_opacity(opacity), (1u << count) - 1, records);
  if (candidates == 0) return 0;
  Directions d;
  view_directions(view, scene.splats, p, i, count, d);
  F values[16];
  harmonics_basis<F>(scene.splats.sh_degree, d.local[0], d.local[1], d.local[2], values);
  const int n = (scene.splats.sh_degree + 1) * (scene.splats.sh_degree + 1);
  for (int k = 0; k < n; k++) store(basis.values[k], values[k]);
  return candidates;
}

// Projects `count` Gaussians from `i` on; returns how many are drawn.
inline int project_group(const View& view, Frame& frame, const Scene& scene, int i, int count, int32_t* radii) {
  Records records;
  records.radius = F(0.f), records.drawn = gt(F(0.f), F(0.f));
  Basis basis;
  Colours colours;
  for (uint32_t rest = prepare(view, scene, i, count, records, basis); rest != 0; rest &= rest - 1) {
    const int lane = __builtin_ctz(rest);
    float rgb[3];
    frame.clamped[i + lane] = colour(scene.splats, basis, i + lane, lane, rgb);
    for (int c = 0; c < 3; c++) colours.rgb[c][lane] = rgb[c];
  }
  if (radii != nullptr) {
    alignas(64) float radius[kWidth];
    store(radius, records.radius);
    for (int lane = 0; lane < count; lane++) radii[i + lane] = static_cast<int32_t>(radius[lane]);
  }
  const F rgb[3] = {load(colours.rgb[0]), load(colours.rgb[1]), load(colours.rgb[2])};
  return write_records(frame, records, rgb, i, count);
}

}  // namespace

void project_forward(Frame& frame, const Scene& scene, int32_t* radii) {
  const View view(scene);
  const int n = scene.splats.n;
  begin_frame(frame, scene);
  parallel_for(scene.threads, chunks(n), [&](int chunk) {
    int drawn = 0;
    const int end = imin(n, (chunk + 1) * kChunk);
    for (int i = chunk * kChunk; i < end; i += kWidth)
      drawn += project_group(view, frame, scene, i, imin(kWidth, end - i), radii);
    frame.visible_before[chunk + 1] = drawn;
  });
}

}  // namespace TGB_ISA
}  // namespace tgb
