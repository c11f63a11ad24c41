// Stages 2 and 3 of the forward pass: depth order, and the list of Gaussians of every screen tile.
#include <cstring>
#include <utility>

#include "pool.h"
#include "raster.h"

namespace tgb {
namespace {

constexpr int kDigitBits = 11, kDigits = 1 << kDigitBits, kPasses = 3;

// Screen tiles [x0, x1) x [y0, y1) of a splat's block rectangle.
struct TileRect {
  int x0, x1, y0, y1;
  explicit TileRect(const Splat& s)
      : x0(s.x0 / kBlocksAcross),
        x1((s.x1 + kBlocksAcross - 1) / kBlocksAcross),
        y0(s.y0 / kBlocksAcross),
        y1((s.y1 + kBlocksAcross - 1) / kBlocksAcross) {}
};

void collect_keys(Frame& frame, const Scene& scene) {
  const int n = scene.splats.n;
  parallel_for(scene.threads, chunks(n), [&](int chunk) {
    int out = frame.visible_before[chunk];
    const int end = n < (chunk + 1) * kChunk ? n : (chunk + 1) * kChunk;
    for (int i = chunk * kChunk; i < end; i++) {
      if (!frame.drawn[i]) continue;
      memcpy(&frame.key[out], &frame.records[i].depth, 4);  // positive floats order like their bits
      frame.order[out++] = static_cast<uint32_t>(i);
    }
  });
}

// Places of the Gaussians' gradient slots: by input index, so that the final sums read memory in order.
void place_slots(Frame& frame, const Scene& scene) {
  uint32_t total = 0;
  for (int i = 0; i < scene.splats.n; i++) {
    frame.slot_begin[i] = total;
    if (!frame.drawn[i]) continue;
    const TileRect rect(frame.records[i]);
    total += static_cast<uint32_t>((rect.x1 - rect.x0) * (rect.y1 - rect.y0));
  }
  frame.slot_begin[scene.splats.n] = frame.pairs = total;
}

}  // namespace

// Least-significant-digit radix sort: stable, so equal depths stay in input order.
void sort_by_depth(Frame& frame, const Scene& scene) {
  const int n_chunks = chunks(scene.splats.n);
  frame.visible_before[0] = 0;
  for (int c = 0; c < n_chunks; c++) frame.visible_before[c + 1] += frame.visible_before[c];
  const int visible = frame.visible = frame.visible_before[n_chunks];
  frame.key.need(visible), frame.key_swap.need(visible), frame.order.need(visible), frame.order_swap.need(visible);
  collect_keys(frame, scene);

  uint32_t counts[kPasses][kDigits] = {};
  for (int i = 0; i < visible; i++) {
    const uint32_t key = frame.key[i];
    for (int pass = 0; pass < kPasses; pass++) counts[pass][key >> (kDigitBits * pass) & (kDigits - 1)]++;
  }
  for (int pass = 0; pass < kPasses; pass++) {
    uint32_t* position = counts[pass];
    const int shift = kDigitBits * pass;
    if (visible == 0 || position[frame.key[0] >> shift & (kDigits - 1)] == static_cast<uint32_t>(visible)) continue;
    uint32_t sum = 0;
    for (int digit = 0; digit < kDigits; digit++) sum += std::exchange(position[digit], sum);
    for (int i = 0; i < visible; i++) {
      const uint32_t key = frame.key[i], to = position[key >> shift & (kDigits - 1)]++;
      frame.key_swap[to] = key, frame.order_swap[to] = frame.order[i];
    }
    frame.key.swap(frame.key_swap), frame.order.swap(frame.order_swap);
  }
}

// Counting sort by tile: each thread counts and then scatters its own stretch of the depth order, so lists come out
// front to back without sorting (tile, depth) keys.
void bin_into_tiles(Frame& frame, const Scene& scene) {
  place_slots(frame, scene);
  const int visible = frame.visible, tiles = frame.tiles_x * frame.tiles_y, parts = scene.threads;
  frame.sorted.need(visible), frame.histogram.need(static_cast<size_t>(parts) * tiles);
  frame.tile_begin.need(tiles + 1), frame.tile_used.need(tiles);
  frame.list.need(frame.pairs), frame.masks.need(frame.pairs);
  const auto stretch = [&](int part) { return static_cast<int>(static_cast<int64_t>(visible) * part / parts); };

  parallel_for(scene.threads, parts, [&](int part) {
    uint32_t* count = frame.histogram.data() + static_cast<size_t>(part) * tiles;
    memset(count, 0, sizeof(uint32_t) * tiles);
    const int end = stretch(part + 1);
    for (int rank = stretch(part); rank < end; rank++) {
      if (rank + 12 < end) __builtin_prefetch(&frame.records[frame.order[rank + 12]]);
      const Splat& s = frame.sorted[rank] = frame.records[frame.order[rank]];
      const TileRect rect(s);
      for (int y = rect.y0; y < rect.y1; y++)
        for (int x = rect.x0; x < rect.x1; x++) count[y * frame.tiles_x + x]++;
    }
  });
  uint32_t total = 0;
  for (int tile = 0; tile < tiles; tile++) {
    frame.tile_begin[tile] = total;
    for (int part = 0; part < parts; part++)
      total += std::exchange(frame.histogram[static_cast<size_t>(part) * tiles + tile], total);
  }
  frame.tile_begin[tiles] = total;
  parallel_for(scene.threads, parts, [&](int part) {
    uint32_t* position = frame.histogram.data() + static_cast<size_t>(part) * tiles;
    for (int rank = stretch(part); rank < stretch(part + 1); rank++) {
      const Splat& s = frame.sorted[rank];
      const TileRect rect(s);
      uint64_t entry = static_cast<uint64_t>(frame.slot_begin[s.id]) << 32 | static_cast<uint32_t>(rank);
      for (int y = rect.y0; y < rect.y1; y++)
        for (int x = rect.x0; x < rect.x1; x++, entry += 1ull << 32) frame.list[position[y * frame.tiles_x + x]++] = entry;
    }
  });
}

}  // namespace tgb
