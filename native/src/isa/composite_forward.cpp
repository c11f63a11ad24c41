// Stage 4 of the forward pass: front-to-back compositing, one task per 32 x 32 px tile.
#include "blocks.h"
#include "kernels.h"

namespace tgb {
namespace TGB_ISA {
namespace {

// Splats per round. Their block masks are transposed into kWords 64-bit hit lists per block, so that a block's pixels
// stay in registers for as long as possible.
constexpr int kWords = 4, kBatch = 64 * kWords;
constexpr int kLook = 16;  // splats after which a block is looked at: has it stopped?

// Running state of a tile's pixels, block-major. A pixel that stops keeps its transmittance with the sign turned, so
// stopping needs no branch; a block is dropped once none of its T is positive.
struct Pixels {
  alignas(64) float T[kBlocks][kLanes];
  alignas(64) float r[kBlocks][kLanes], g[kBlocks][kLanes], b[kBlocks][kLanes];
};

struct Limits {
  F threshold, alpha_max, transmittance_min;
};

inline uint64_t clear(Pixels& pixels, const TileView& view) {
  memset(&pixels, 0, sizeof pixels);
  for (int i = 0; i < kBlocks * kLanes; i++) (&pixels.T[0][0])[i] = 1;
  if (view.whole()) return ~0ull;
  uint64_t alive = 0;
  for (int b = 0; b < kBlocks; b++)
    for (int l = 0; l < kLanes; l++) {
      if (view.holds(b, l))
        alive |= 1ull << b;
      else
        pixels.T[b][l] = 0;
    }
  return alive;
}

struct Batch {
  alignas(64) Splat splats[kBatch];  // means relative to the tile
  uint64_t rows[kBatch];             // blocks each splat touches
  uint64_t hits[kWords][kBlocks];    // splats that touch each block
};

// The splats that touch one block, front to back: as numbers, because a loop that takes bits from words is left at a
// point nobody can predict five times as often.
struct Hits {
  int count = 0;
  alignas(64) uint32_t splat[kBatch + 64];
  Hits(const Batch& batch, int words, int block) {
    for (int w = 0; w < words; w++) count += list_bits(batch.hits[w][block], 64 * w, splat + count);
  }
};

// Composites the block's splats over it. Returns how many it took until all pixels stopped, or -1 where one goes on.
// Keep: note each pixel's last splat in `last`, for the backward pass.
template <bool Keep>
inline int composite_block(Pixels& pixels, float* last, int block, const Batch& batch, const Hits& hits,
                           const Limits& limits) {
  int used = 0;
  for (int k = 0; k < kLanes; k += kWidth) {
    const F x = load(block_x(block) + k), y = load(block_y(block) + k);
    F T = load(pixels.T[block] + k), latest = Keep ? load(last + k) : T;
    F r = load(pixels.r[block] + k), g = load(pixels.g[block] + k), b = load(pixels.b[block] + k);
    int i = 0;
    while (i < hits.count && any(gt(T, F(0.f)))) {
      for (const int end = imin(hits.count, i + kLook); i < end; i++) {
        const Splat& s = batch.splats[hits.splat[i]];
        const F dx = x - F(s.mx), dy = y - F(s.my), u = fma(F(s.ux), dx, F(s.uy) * dy), v = F(s.vy) * dy;
        const F exponent = fnma(v, v, fnma(u, u, F(s.lo)));
        const M reached = ge(exponent, limits.threshold);
        const F alpha = keep(reached, vmin(exp2(exponent), limits.alpha_max));
        const F next = fnma(alpha, T, T);
        const M go = ge(next, limits.transmittance_min);
        if (Keep) latest = select(both(reached, go), F(s.place), latest);
        const F weight = keep(go, alpha * T);
        T = go_on(go, next, T);
        r = fma(weight, F(s.r), r), g = fma(weight, F(s.g), g), b = fma(weight, F(s.b), b);
      }
    }
    used = any(gt(T, F(0.f))) ? -1 : (used < 0 ? -1 : imax(used, i));
    store(pixels.T[block] + k, T);
    if (Keep) store(last + k, latest);
    store(pixels.r[block] + k, r), store(pixels.g[block] + k, g), store(pixels.b[block] + k, b);
  }
  return used;
}

// Puts the background behind the pixels and writes them to the image rows.
void write_tile(Pixels& pixels, const Scene& scene, const TileView& view, float* color, float* alpha) {
  const F red(scene.background[0]), green(scene.background[1]), blue(scene.background[2]);
  for (int b = 0; b < kBlocks; b++)
    for (int k = 0; k < kLanes; k += kWidth) {
      const F T = magnitude(load(pixels.T[b] + k));
      store(pixels.T[b] + k, F(1.f) - T);
      store(pixels.r[b] + k, fma(T, red, load(pixels.r[b] + k)));
      store(pixels.g[b] + k, fma(T, green, load(pixels.g[b] + k)));
      store(pixels.b[b] + k, fma(T, blue, load(pixels.b[b] + k)));
    }
  float r[kTile], g[kTile], b[kTile], a[kTile];
  for (int y = 0; y < view.height; y++) {
    for (int x = 0; x < kTile; x += kBlock) {
      const int block = y / kBlock * kBlocksAcross + x / kBlock, lane = y % kBlock * kBlock;
      copy_quad(r + x, pixels.r[block] + lane), copy_quad(g + x, pixels.g[block] + lane);
      copy_quad(b + x, pixels.b[block] + lane), copy_quad(a + x, pixels.T[block] + lane);
    }
    const size_t row = static_cast<size_t>(view.top + y) * scene.camera.width + view.left;
    float* rgb = color + 3 * row;
    for (int x = 0; x < view.width; x++) rgb[3 * x] = r[x], rgb[3 * x + 1] = g[x], rgb[3 * x + 2] = b[x];
    memcpy(alpha + row, a, view.width * sizeof(float));
  }
}

// Fills the batch with the `count` list entries from `at` on: tile-relative splats, block masks, hit lists.
inline void load_batch(Batch& batch, const Frame& frame, const TileView& view, uint32_t begin, uint32_t at, int count,
                       float threshold, uint64_t alive) {
  const uint64_t* list = frame.list.data() + at;
  for (int j = 0; j < count; j++) {
    if (j + 8 < count) __builtin_prefetch(&frame.records[static_cast<uint32_t>(list[j + 8])]);
    Splat& s = batch.splats[j] = frame.records[static_cast<uint32_t>(list[j])];
    s.mx -= static_cast<float>(view.left), s.my -= static_cast<float>(view.top);
    s.place = static_cast<float>(at + j - begin);
  }
  for (int j = 0; j < count; j += kWidth) {
    block_masks(batch.splats + j, view, threshold, batch.rows + j);
    for (int i = j; i < j + kWidth; i++) batch.rows[i] &= alive;
  }
  for (int w = 0; 64 * w < count; w++) {
    for (int j = imax(count, 64 * w); j < 64 * (w + 1); j++) batch.rows[j] = 0;
    transpose_bits(batch.rows + 64 * w, batch.hits[w]);
  }
}

// Final transmittance of a tile's pixels, for the backward pass.
inline void keep_transmittance(const Pixels& pixels, float* out) {
  for (int i = 0; i < kBlocks * kLanes; i += kWidth) store(out + i, magnitude(load(&pixels.T[0][0] + i)));
}

template <bool Keep>
void composite_tile(Frame& frame, const Scene& scene, int tile, float* color, float* alpha) {
  const TileView view(frame, scene, tile);
  const float threshold = log2f(scene.constants.alpha_min);
  const Limits limits{F(threshold), F(scene.constants.alpha_max), F(scene.constants.transmittance_min)};
  Pixels pixels;
  Batch batch;
  const size_t first_pixel = static_cast<size_t>(tile) * kBlocks * kLanes;
  float* last = Keep ? frame.last.data() + first_pixel : nullptr;
  if (Keep)
    for (int i = 0; i < kBlocks * kLanes; i++) last[i] = -1;
  uint64_t alive = clear(pixels, view);
  const uint32_t begin = frame.tile_begin[tile], end = frame.tile_begin[tile + 1];
  uint32_t at = begin;
  while (at < end && alive != 0) {
    const int count = end - at < kBatch ? static_cast<int>(end - at) : kBatch, words = (count + 63) / 64;
    load_batch(batch, frame, view, begin, at, count, threshold, alive);
    for (uint64_t rest = alive; rest != 0; rest &= rest - 1) {
      const int b = __builtin_ctzll(rest);
      const Hits hits(batch, words, b);
      const int used = composite_block<Keep>(pixels, Keep ? last + b * kLanes : nullptr, b, batch, hits, limits);
      if (used < 0) continue;
      alive &= ~(1ull << b);
      for (int i = used; Keep && i < hits.count; i++) batch.rows[hits.splat[i]] &= ~(1ull << b);
    }
    if (Keep) memcpy(frame.masks.data() + at, batch.rows, count * sizeof(uint64_t));
    at += static_cast<uint32_t>(count);
  }
  frame.tile_used[tile] = at - begin;
  if (Keep) keep_transmittance(pixels, frame.transmittance.data() + first_pixel);
  write_tile(pixels, scene, view, color, alpha);
}

}  // namespace

void composite_forward(Frame& frame, const Scene& scene, float* color, float* alpha, bool keep) {
  const int tiles = frame.tiles_x * frame.tiles_y;
  const size_t pixels = keep ? static_cast<size_t>(tiles) * kBlocks * kLanes : 0;
  frame.transmittance.need(pixels), frame.last.need(pixels);
  if (keep) frame.masks.need(frame.pairs);
  parallel_for(scene.threads, tiles, [&](int tile) {
    if (keep)
      composite_tile<true>(frame, scene, tile, color, alpha);
    else
      composite_tile<false>(frame, scene, tile, color, alpha);
  });
}

}  // namespace TGB_ISA
}  // namespace tgb
