// Stage 4 of the forward pass: front-to-back compositing, one task per 32 x 32 px tile.
#include "blocks.h"
#include "kernels.h"

namespace tgb {
namespace TGB_ISA {
namespace {

constexpr int kBatch = 64;  // splats per round: their block masks transpose into one 64-bit hit list per block

// Running state of a tile's pixels, block-major. A pixel that stops moves its transmittance from T to `stopped` and
// goes on with T = 0, so stopping needs no branch; a block is dropped once all its T are 0.
struct Pixels {
  alignas(64) float T[kBlocks][kLanes], stopped[kBlocks][kLanes];
  alignas(64) float r[kBlocks][kLanes], g[kBlocks][kLanes], b[kBlocks][kLanes];
};

struct Limits {
  F threshold, alpha_max, transmittance_min;
};

inline uint64_t clear(Pixels& pixels, const TileView& view, float* last) {
  uint64_t alive = 0;
  memset(&pixels, 0, sizeof pixels);
  for (int b = 0; b < kBlocks; b++)
    for (int l = 0; l < kLanes; l++) {
      last[b * kLanes + l] = -1;
      if (view.holds(b, l)) pixels.T[b][l] = 1, alive |= 1ull << b;
    }
  return alive;
}

// Composites the splats in `hits` over one block; returns whether any of its pixels goes on.
inline bool composite_block(Pixels& pixels, float* last, int block, uint64_t hits, const Splat* splats, uint32_t first,
                            const Limits& limits) {
  bool alive = false;
  for (int k = 0; k < kLanes; k += kWidth) {
    const F x = load(kBlockTable.x[block] + k), y = load(kBlockTable.y[block] + k);
    F T = load(pixels.T[block] + k), stopped = load(pixels.stopped[block] + k), latest = load(last + k);
    F r = load(pixels.r[block] + k), g = load(pixels.g[block] + k), b = load(pixels.b[block] + k);
    for (uint64_t rest = hits; rest != 0; rest &= rest - 1) {
      const int j = __builtin_ctzll(rest);
      const Splat& s = splats[j];
      const F dx = x - F(s.mx), dy = y - F(s.my), u = fma(F(s.ux), dx, F(s.uy) * dy), v = F(s.vy) * dy;
      const F exponent = fnma(v, v, fnma(u, u, F(s.lo)));
      const M reached = ge(exponent, limits.threshold);
      const F alpha = keep(reached, vmin(exp2(exponent), limits.alpha_max));
      const F next = fnma(alpha, T, T);
      const M go = ge(next, limits.transmittance_min);
      latest = select(both(reached, go), F(static_cast<float>(first + j)), latest);
      const F weight = keep(go, alpha * T);
      stopped += T - keep(go, T);
      T = keep(go, next);
      r = fma(weight, F(s.r), r), g = fma(weight, F(s.g), g), b = fma(weight, F(s.b), b);
    }
    store(pixels.T[block] + k, T), store(pixels.stopped[block] + k, stopped), store(last + k, latest);
    store(pixels.r[block] + k, r), store(pixels.g[block] + k, g), store(pixels.b[block] + k, b);
    alive |= any(gt(T, F(0.f)));
  }
  return alive;
}

void write_tile(const Pixels& pixels, const Scene& scene, const TileView& view, float* transmittance, float* color,
                float* alpha) {
  const float* background = scene.background;
  for (int y = 0; y < view.height; y++) {
    const size_t row = static_cast<size_t>(view.top + y) * scene.camera.width + view.left;
    for (int x = 0; x < view.width; x++) {
      const int b = y / kBlock * kBlocksAcross + x / kBlock, l = y % kBlock * kBlock + x % kBlock;
      const float T = pixels.T[b][l] + pixels.stopped[b][l];
      transmittance[b * kLanes + l] = T;
      float* rgb = color + 3 * (row + x);
      rgb[0] = pixels.r[b][l] + T * background[0];
      rgb[1] = pixels.g[b][l] + T * background[1];
      rgb[2] = pixels.b[b][l] + T * background[2];
      alpha[row + x] = 1 - T;
    }
  }
}

void composite_tile(Frame& frame, const Scene& scene, int tile, float* color, float* alpha) {
  const TileView view(frame, scene, tile);
  const float threshold = log2f(scene.constants.alpha_min);
  const Limits limits{F(threshold), F(scene.constants.alpha_max), F(scene.constants.transmittance_min)};
  Pixels pixels;
  float* last = frame.last.data() + static_cast<size_t>(tile) * kBlocks * kLanes;
  uint64_t alive = clear(pixels, view, last);
  const uint32_t begin = frame.tile_begin[tile], end = frame.tile_begin[tile + 1];
  uint32_t at = begin;
  alignas(64) Splat splats[kBatch];
  uint64_t rows[kBatch], hits[kBlocks];
  while (at < end && alive != 0) {
    const int count = end - at < kBatch ? static_cast<int>(end - at) : kBatch;
    for (int j = 0; j < count; j++) {
      if (at + j + 8 < end) __builtin_prefetch(&frame.sorted[static_cast<uint32_t>(frame.list[at + j + 8])]);
      Splat& s = splats[j] = frame.sorted[static_cast<uint32_t>(frame.list[at + j])];
      const uint64_t inside = rectangle_mask(s, view.left, view.top);
      s.mx -= static_cast<float>(view.left), s.my -= static_cast<float>(view.top);
      frame.masks[at + j] = rows[j] = ellipse_mask(s, threshold) & inside & alive;
    }
    for (int j = count; j < kBatch; j++) rows[j] = 0;
    transpose_bits(rows, hits);
    uint64_t still = 0;
    for (uint64_t rest = alive; rest != 0; rest &= rest - 1) {
      const int b = __builtin_ctzll(rest);
      if (composite_block(pixels, last + b * kLanes, b, hits[b], splats, at - begin, limits)) still |= 1ull << b;
    }
    alive = still;
    at += static_cast<uint32_t>(count);
  }
  frame.tile_used[tile] = at - begin;
  write_tile(pixels, scene, view, frame.transmittance.data() + static_cast<size_t>(tile) * kBlocks * kLanes, color,
             alpha);
}

}  // namespace

void composite_forward(Frame& frame, const Scene& scene, float* color, float* alpha) {
  const int tiles = frame.tiles_x * frame.tiles_y;
  const size_t pixels = static_cast<size_t>(tiles) * kBlocks * kLanes;
  frame.transmittance.need(pixels), frame.last.need(pixels);
  parallel_for(scene.threads, tiles, [&](int tile) { composite_tile(frame, scene, tile, color, alpha); });
}

}  // namespace TGB_ISA
}  // namespace tgb
