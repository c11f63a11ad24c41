// Stages 2 and 3 of the forward pass: depth order, and the list of Gaussians of every screen tile.
#include <cstring>
#include <utility>

#include "pool.h"
#include "raster.h"

namespace tgb {
namespace {

constexpr int kDigitBits = 12, kDigits = 1 << kDigitBits, kPasses = 3;

// The drawn Gaussians in input order. Positive floats order like their bits.
void collect(Frame& frame, const Scene& scene) {
  const int n = scene.splats.n;
  parallel_for(scene.threads, chunks(n), [&](int chunk) {
    int out = frame.visible_before[chunk];
    const int end = n < (chunk + 1) * kChunk ? n : (chunk + 1) * kChunk;
    for (int i = chunk * kChunk; i < end; i++) {
      if (!frame.drawn[i]) continue;
      uint32_t key;
      memcpy(&key, &frame.depth[i], 4);
      frame.order[out++] = static_cast<uint64_t>(key) << 32 | static_cast<uint32_t>(i);
    }
  });
}

// Places of the Gaussians' gradient slots: by input index, so that the final sums read memory in order.
void place_slots(Frame& frame, const Scene& scene) {
  uint32_t total = 0;
  for (int i = 0; i < scene.splats.n; i++) {
    frame.slot_begin[i] = total;
    if (!frame.drawn[i]) continue;
    const TileRect rect = frame.tiles[i];
    total += static_cast<uint32_t>((rect.x1 - rect.x0) * (rect.y1 - rect.y0));
  }
  frame.slot_begin[scene.splats.n] = frame.pairs = total;
}

}  // namespace

// Least-significant-digit radix sort: stable, so equal depths stay in input order. Counted from the least depth, the
// keys of a head fill 23 or 24 bits: two passes.
void sort_by_depth(Frame& frame, const Scene& scene) {
  const int n_chunks = chunks(scene.splats.n);
  frame.visible_before[0] = 0;
  for (int c = 0; c < n_chunks; c++) frame.visible_before[c + 1] += frame.visible_before[c];
  const int visible = frame.visible = frame.visible_before[n_chunks];
  frame.order.need(visible), frame.order_swap.need(visible);
  collect(frame, scene);

  uint32_t least = ~0u, most = 0;
  for (int i = 0; i < visible; i++) {
    const uint32_t key = static_cast<uint32_t>(frame.order[i] >> 32);
    least = key < least ? key : least, most = key > most ? key : most;
  }
  const auto digit = [&](uint64_t entry, int pass) {
    return (static_cast<uint32_t>(entry >> 32) - least) >> (kDigitBits * pass) & (kDigits - 1);
  };
  uint32_t counts[kPasses][kDigits] = {};
  for (int i = 0; i < visible; i++)
    for (int pass = 0; pass < kPasses; pass++) counts[pass][digit(frame.order[i], pass)]++;
  for (int pass = 0; pass < kPasses && visible != 0; pass++) {
    if ((most - least) >> (kDigitBits * pass) == 0) break;
    uint32_t* position = counts[pass];
    uint32_t sum = 0;
    for (int d = 0; d < kDigits; d++) sum += std::exchange(position[d], sum);
    for (int i = 0; i < visible; i++) frame.order_swap[position[digit(frame.order[i], pass)]++] = frame.order[i];
    frame.order.swap(frame.order_swap);
  }
}

// Counting sort by tile: each thread counts and then scatters its own stretch of the depth order, so lists come out
// front to back without sorting (tile, depth) keys. Both without branches that depend on a splat's size, for most
// splats: nobody can predict those.
void bin_into_tiles(Frame& frame, const Scene& scene) {
  place_slots(frame, scene);
  const int visible = frame.visible, across = frame.tiles_x, tiles = across * frame.tiles_y, parts = scene.threads;
  // A part's counts by tile, with a column and a row more for the corners of rectangles, and a place for nothing.
  const int stride = across + 1, room = stride * (frame.tiles_y + 1) + 1, nowhere = room - 1;
  frame.histogram.need(static_cast<size_t>(parts) * room);
  frame.tile_begin.need(tiles + 1), frame.tile_used.need(tiles);
  frame.list.need(frame.pairs + 1);
  const auto stretch = [&](int part) { return static_cast<int>(static_cast<int64_t>(visible) * part / parts); };
  const auto counts = [&](int part) { return frame.histogram.data() + static_cast<size_t>(part) * room; };

  parallel_for(scene.threads, parts, [&](int part) {
    uint32_t* count = counts(part);
    memset(count, 0, sizeof(uint32_t) * room);
    for (int rank = stretch(part); rank < stretch(part + 1); rank++) {
      const TileRect rect = frame.tiles[static_cast<uint32_t>(frame.order[rank])];
      count[rect.y0 * stride + rect.x0]++, count[rect.y0 * stride + rect.x1]--;
      count[rect.y1 * stride + rect.x0]--, count[rect.y1 * stride + rect.x1]++;
    }
    for (int y = 0; y <= frame.tiles_y; y++)
      for (int x = 1; x <= across; x++) count[y * stride + x] += count[y * stride + x - 1];
    for (int i = stride; i < nowhere; i++) count[i] += count[i - stride];
  });
  uint32_t total = 0;
  for (int tile = 0; tile < tiles; tile++) {
    frame.tile_begin[tile] = total;
    for (int part = 0; part < parts; part++)
      total += std::exchange(counts(part)[tile / across * stride + tile % across], total);
  }
  frame.tile_begin[tiles] = total;
  parallel_for(scene.threads, parts, [&](int part) {
    uint32_t* position = counts(part);
    uint64_t unused;
    for (int rank = stretch(part); rank < stretch(part + 1); rank++) {
      const uint32_t i = static_cast<uint32_t>(frame.order[rank]);
      const TileRect rect = frame.tiles[i];
      const uint64_t entry = static_cast<uint64_t>(frame.slot_begin[i]) << 32 | i, slot = 1ull << 32;
      const int width = rect.x1 - rect.x0, height = rect.y1 - rect.y0;
      if (width <= 2 && height <= 2) {
        const int first = rect.y0 * stride + rect.x0;
        const auto put = [&](bool there, int tile, uint64_t what) {
          uint64_t* to = there ? &frame.list[position[tile]] : &unused;
          *to = what, position[there ? tile : nowhere]++;
        };
        put(true, first, entry), put(width > 1, first + 1, entry + slot);
        put(height > 1, first + stride, entry + width * slot);
        put(width > 1 && height > 1, first + stride + 1, entry + 3 * slot);
        continue;
      }
      uint64_t next = entry;
      for (int y = rect.y0; y < rect.y1; y++)
        for (int x = rect.x0; x < rect.x1; x++, next += slot) frame.list[position[y * stride + x]++] = next;
    }
  });
}

}  // namespace tgb
