// Playback: neutral Gaussians and deltas to records in one pass over memory. What lies between - raw parameters, posed
// splats - never leaves the first-level cache. Computes what blend, skin and project_forward do one after the other.
#include "playback.h"

#include "harmonics.h"
#include "kernels.h"
#include "records.h"
#include "skinning.h"

namespace tgb {
namespace TGB_ISA {
namespace {

constexpr int kAhead = 2048;  // bytes fetched ahead: the machine's own guess ends at every gap and page
constexpr int kGeometry = 11, kMostChannels = kGeometry + 48, kMostRows = 1024;
static_assert(kChunk % kPlaybackBlock == 0, "a task is whole blocks");

struct Channels {
  alignas(64) float values[kMostChannels][kPlaybackBlock];
};

// out = source + sum over `n` rows of factor times levels, one channel of a block.
template <class Level>
inline void add_levels(const float* source, const Level* levels, const int* entry, const float* factor, int n,
                       float* out) {
  constexpr int kVectors = kPlaybackBlock / kWidth < 8 ? kPlaybackBlock / kWidth : 8;
  for (int lane = 0; lane < kPlaybackBlock; lane += kVectors * kWidth) {
    F sum[kVectors];
    for (int v = 0; v < kVectors; v++) sum[v] = load(source + lane + v * kWidth);
    for (int i = 0; i < n; i++) {
      const Level* p = levels + static_cast<size_t>(entry[i]) * kPlaybackBlock + lane;
      __builtin_prefetch(p + kAhead / sizeof(Level));
      const F weight(factor[i]);
      for (int v = 0; v < kVectors; v++) sum[v] = fma(weight, load_level(p + v * kWidth), sum[v]);
    }
    for (int v = 0; v < kVectors; v++) store(out + lane + v * kWidth, sum[v]);
  }
}

// B0 + sum psi_k dB_k of one group's channels. `factors` [width, rows]: psi times step.
inline void blend_group(const DeltaGroup& group, int block, int rows, const float* psi, const float* factors,
                        const float* neutral, Channels& out) {
  const int begin = group.begin[block], entries = group.begin[block + 1] - begin;
  int active[kMostRows], row[kMostRows], n = 0;
  for (int e = 0; e < entries; e++)
    if (psi[group.row[begin + e]] != 0) active[n] = e, row[n++] = group.row[begin + e];
  float factor[kMostRows];
  const size_t first = static_cast<size_t>(begin) * group.width * kPlaybackBlock;
  for (int c = 0; c < group.width; c++) {
    for (int i = 0; i < n; i++) factor[i] = factors[c * rows + row[i]];
    const float* source = neutral + (group.first + c) * kPlaybackBlock;
    float* to = out.values[group.first + c];
    const size_t at = first + static_cast<size_t>(c) * entries * kPlaybackBlock;
    if (group.bytes == 1)
      add_levels(source, static_cast<const int8_t*>(group.levels) + at, active, factor, n, to);
    else
      add_levels(source, static_cast<const int16_t*>(group.levels) + at, active, factor, n, to);
  }
}

// Poses and projects `count` Gaussians, the lanes from `lane` on of a block; returns how many are drawn.
inline int project_lanes(const View& view, Frame& frame, const Scene& scene, const Channels& channels,
                         const float* weights, const float* transforms, int i, int count) {
  const int lane = i % kPlaybackBlock, degree = scene.splats.sh_degree;
  const auto channel = [&](int c) { return load(channels.values[c] + lane); };
  F joints[kJoints], raw[4];
  for (int j = 0; j < kJoints; j++) joints[j] = load(weights + j * kPlaybackBlock + lane);
  for (int j = 0; j < 4; j++) raw[j] = channel(3 + j);
  Group g;
  prepare(joints, raw, transforms, g);
  Projection p;
  const F rest[3] = {channel(0), channel(1), channel(2)};
  move(g, rest, p.mean);
  multiply(g.turn, g.unit, p.q);
  for (int j = 0; j < 3; j++) p.scale[j] = exponential(channel(7 + j));
  project(view, scene, p);
  Records records;
  F rgb[3] = {F(0.5f), F(0.5f), F(0.5f)};
  records.drawn = gt(F(0.f), F(0.f));
  const F opacity = log2_of_opacity(sigmoid(channel(10)));
  if (make_records(scene, p, opacity, (1u << count) - 1, records) != 0) {
    Directions d;
    view_directions(view, p, g.rotation, d);
    F basis[16];
    harmonics_basis<F>(degree, d.local[0], d.local[1], d.local[2], basis);
    for (int k = 0; k < (degree + 1) * (degree + 1); k++)
      for (int c = 0; c < 3; c++) rgb[c] = fma(basis[k], channel(kGeometry + 3 * k + c), rgb[c]);
    for (F& value : rgb) value = vmax(value, F(0.f));
  }
  return write_records(frame, records, rgb, i, count);
}

}  // namespace

void project_playback(Frame& frame, const Scene& scene, const Playback& avatar, const float* psi,
                      const float* transforms) {
  const View view(scene);
  const int n = avatar.n, used = kGeometry + 3 * (scene.splats.sh_degree + 1) * (scene.splats.sh_degree + 1);
  const int stored = kGeometry + 3 * (avatar.sh_degree + 1) * (avatar.sh_degree + 1);
  begin_frame(frame, scene);
  float* factors = frame.factors.need(static_cast<size_t>(stored) * avatar.rows);
  for (const DeltaGroup& group : avatar.groups)
    for (int c = 0; c < group.width; c++)
      for (int k = 0; k < avatar.rows; k++)
        factors[(group.first + c) * avatar.rows + k] = psi[k] * group.steps[c * avatar.rows + k];

  parallel_for(scene.threads, chunks(n), [&](int chunk) {
    Channels channels;
    int drawn = 0;
    const int end = imin(n, (chunk + 1) * kChunk);
    for (int first = chunk * kChunk; first < end; first += kPlaybackBlock) {
      const int block = first / kPlaybackBlock;
      const float* neutral = avatar.neutral + static_cast<size_t>(block) * stored * kPlaybackBlock;
      const float* weights = avatar.weights + static_cast<size_t>(block) * kJoints * kPlaybackBlock;
      for (const DeltaGroup& group : avatar.groups)
        if (group.first < used)
          blend_group(group, block, avatar.rows, psi, factors + group.first * avatar.rows, neutral, channels);
      for (int i = first; i < imin(end, first + kPlaybackBlock); i += kWidth)
        drawn += project_lanes(view, frame, scene, channels, weights, transforms, i, imin(kWidth, end - i));
    }
    frame.visible_before[chunk + 1] = drawn;
  });
}

}  // namespace TGB_ISA
}  // namespace tgb
