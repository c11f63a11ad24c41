// Stage 4 of the forward pass: front-to-back compositing, one task per 32 x 32 px tile.
#include "blocks.h"
#include "kernels.h"

namespace tgb {
namespace TGB_ISA {
namespace {

// Splats per round. Their block masks are transposed into kWords 64-bit hit lists per block, so that a block's pixels
// stay in registers for as long as possible.
constexpr int kWords = 4, kBatch = 64 * kWords;

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
  memset(&pixels, 0, sizeof pixels);
  for (int i = 0; i < kBlocks * kLanes; i++) last[i] = -1, (&pixels.T[0][0])[i] = 1;
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
  alignas(64) Splat splats[kBatch];   // means relative to the tile
  uint64_t rows[kBatch];              // blocks each splat touches
  uint64_t hits[kWords][kBlocks];     // splats that touch each block
  uint64_t alive[kWords];             // blocks that went on after each word
};

// Composites the splats in `batch` over one block; sets its bit in `batch.alive` for as long as a pixel goes on.
inline void composite_block(Pixels& pixels, float* last, int block, int words, Batch& batch, const Limits& limits) {
  for (int k = 0; k < kLanes; k += kWidth) {
    const F x = load(block_x(block) + k), y = load(block_y(block) + k);
    F T = load(pixels.T[block] + k), stopped = load(pixels.stopped[block] + k), latest = load(last + k);
    F r = load(pixels.r[block] + k), g = load(pixels.g[block] + k), b = load(pixels.b[block] + k);
    for (int w = 0; w < words; w++) {
      for (uint64_t rest = batch.hits[w][block]; rest != 0; rest &= rest - 1) {
        const Splat& s = batch.splats[64 * w + __builtin_ctzll(rest)];
        const F dx = x - F(s.mx), dy = y - F(s.my), u = fma(F(s.ux), dx, F(s.uy) * dy), v = F(s.vy) * dy;
        const F exponent = fnma(v, v, fnma(u, u, F(s.lo)));
        const M reached = ge(exponent, limits.threshold);
        const F alpha = keep(reached, vmin(exp2(exponent), limits.alpha_max));
        const F next = fnma(alpha, T, T);
        const M go = ge(next, limits.transmittance_min);
        latest = select(both(reached, go), F(s.place), latest);
        const F weight = keep(go, alpha * T);
        stopped = select(go, stopped, vmax(stopped, T));  // T is 0 once stopped
        T = keep(go, next);
        r = fma(weight, F(s.r), r), g = fma(weight, F(s.g), g), b = fma(weight, F(s.b), b);
      }
      if (!any(gt(T, F(0.f)))) break;
      batch.alive[w] |= 1ull << block;
    }
    store(pixels.T[block] + k, T), store(pixels.stopped[block] + k, stopped), store(last + k, latest);
    store(pixels.r[block] + k, r), store(pixels.g[block] + k, g), store(pixels.b[block] + k, b);
  }
}

// Puts the background behind the pixels and writes them to the image rows.
void write_tile(Pixels& pixels, const Scene& scene, const TileView& view, float* transmittance, float* color,
                float* alpha) {
  const F red(scene.background[0]), green(scene.background[1]), blue(scene.background[2]);
  for (int b = 0; b < kBlocks; b++)
    for (int k = 0; k < kLanes; k += kWidth) {
      const F T = load(pixels.T[b] + k) + load(pixels.stopped[b] + k);
      store(transmittance + b * kLanes + k, T), store(pixels.T[b] + k, F(1.f) - T);
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
    if (j + 8 < count) __builtin_prefetch(&frame.sorted[static_cast<uint32_t>(list[j + 8])]);
    Splat& s = batch.splats[j] = frame.sorted[static_cast<uint32_t>(list[j])];
    const uint64_t inside = rectangle_mask(s, view.left, view.top);
    s.mx -= static_cast<float>(view.left), s.my -= static_cast<float>(view.top);
    s.place = static_cast<float>(at + j - begin);
    batch.rows[j] = ellipse_mask(s, threshold, inside & alive);
  }
  for (int w = 0; 64 * w < count; w++) {
    for (int j = imax(count, 64 * w); j < 64 * (w + 1); j++) batch.rows[j] = 0;
    transpose_bits(batch.rows + 64 * w, batch.hits[w]);
    batch.alive[w] = 0;
  }
}

void composite_tile(Frame& frame, const Scene& scene, int tile, float* color, float* alpha) {
  const TileView view(frame, scene, tile);
  const float threshold = log2f(scene.constants.alpha_min);
  const Limits limits{F(threshold), F(scene.constants.alpha_max), F(scene.constants.transmittance_min)};
  Pixels pixels;
  Batch batch;
  float* last = frame.last.data() + static_cast<size_t>(tile) * kBlocks * kLanes;
  uint64_t alive = clear(pixels, view, last);
  const uint32_t begin = frame.tile_begin[tile], end = frame.tile_begin[tile + 1];
  uint32_t at = begin;
  while (at < end && alive != 0) {
    const int count = end - at < kBatch ? static_cast<int>(end - at) : kBatch, words = (count + 63) / 64;
    load_batch(batch, frame, view, begin, at, count, threshold, alive);
    for (uint64_t rest = alive; rest != 0; rest &= rest - 1) {
      const int b = __builtin_ctzll(rest);
      composite_block(pixels, last + b * kLanes, b, words, batch, limits);
    }
    for (int j = 0; j < count; j++)  // for the backward pass: without blocks that stopped in an earlier word
      frame.masks[at + j] = batch.rows[j] & (j < 64 ? alive : batch.alive[j / 64 - 1]);
    alive = batch.alive[words - 1];
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
