// Stages 2 and 3 of the forward pass: depth order, and the list of Gaussians of every screen tile.
#include <cstring>
#include <utility>

#include "pool.h"
#include "raster.h"

namespace tgb {
namespace {

constexpr int kDigitBits = 12, kDigits = 1 << kDigitBits;
constexpr int kAhead = 16;  // entries fetched ahead: they point everywhere

// Elements of a thread's part of `count`.
inline int first_of(int part, int parts, int count) { return static_cast<int>(static_cast<int64_t>(count) * part / parts); }

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
    const TileRect rect(frame, i);
    total += static_cast<uint32_t>((rect.x1 - rect.x0) * (rect.y1 - rect.y0));
  }
  frame.slot_begin[scene.splats.n] = total;
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
  const int parts = scene.threads;
  frame.histogram.need(static_cast<size_t>(parts) * kDigits);
  for (int shift = 0; visible != 0 && shift < 32 && (most - least) >> shift != 0; shift += kDigitBits) {
    const auto digit = [&](uint64_t entry) {
      return (static_cast<uint32_t>(entry >> 32) - least) >> shift & (kDigits - 1);
    };
    const auto counts = [&](int part) { return frame.histogram.data() + static_cast<size_t>(part) * kDigits; };
    parallel_for(parts, parts, [&](int part) {
      uint32_t* count = counts(part);
      memset(count, 0, sizeof(uint32_t) * kDigits);
      const int end = first_of(part + 1, parts, visible);
      for (int i = first_of(part, parts, visible); i < end; i++) count[digit(frame.order[i])]++;
    });
    uint32_t sum = 0;
    for (int d = 0; d < kDigits; d++)
      for (int part = 0; part < parts; part++) sum += std::exchange(counts(part)[d], sum);
    parallel_for(parts, parts, [&](int part) {
      uint32_t* position = counts(part);
      const int end = first_of(part + 1, parts, visible);
      for (int i = first_of(part, parts, visible); i < end; i++)
        frame.order_swap[position[digit(frame.order[i])]++] = frame.order[i];
    });
    frame.order.swap(frame.order_swap);
  }
}

// Counting sort by tile: each thread counts and then scatters its own stretch of the depth order, so lists come out
// front to back without sorting (tile, depth) keys. Both without branches that depend on a splat's size, for most
// splats: nobody can predict those.
void bin_into_tiles(Frame& frame, const Scene& scene, bool keep) {
  if (keep) place_slots(frame, scene);
  const int visible = frame.visible, across = frame.tiles_x, tiles = across * frame.tiles_y, parts = scene.threads;
  // A part's counts by tile, with a column and a row more for the corners of rectangles, and a place for nothing.
  const int stride = across + 1, room = stride * (frame.tiles_y + 1) + 1, nowhere = room - 1;
  frame.histogram.need(static_cast<size_t>(parts) * room);
  frame.tile_begin.need(tiles + 1), frame.tile_used.need(tiles);
  const auto counts = [&](int part) { return frame.histogram.data() + static_cast<size_t>(part) * room; };
  const auto fetch = [&](uint32_t i) {
    __builtin_prefetch(&frame.tile_columns[i]), __builtin_prefetch(&frame.tile_rows[i]);
    if (keep) __builtin_prefetch(&frame.slot_begin[i]);
  };

  parallel_for(scene.threads, parts, [&](int part) {
    uint32_t* count = counts(part);
    memset(count, 0, sizeof(uint32_t) * room);
    const int end = first_of(part + 1, parts, visible);
    for (int rank = first_of(part, parts, visible); rank < end; rank++) {
      if (rank + kAhead < end) fetch(static_cast<uint32_t>(frame.order[rank + kAhead]));
      const TileRect rect(frame, static_cast<uint32_t>(frame.order[rank]));
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
  frame.tile_begin[tiles] = frame.pairs = total;
  frame.list.need(total);
  parallel_for(scene.threads, parts, [&](int part) {
    uint32_t* position = counts(part);
    uint64_t unused;
    const int end = first_of(part + 1, parts, visible);
    for (int rank = first_of(part, parts, visible); rank < end; rank++) {
      if (rank + kAhead < end) fetch(static_cast<uint32_t>(frame.order[rank + kAhead]));
      const uint32_t i = static_cast<uint32_t>(frame.order[rank]);
      const TileRect rect(frame, i);
      const uint64_t entry = (keep ? static_cast<uint64_t>(frame.slot_begin[i]) << 32 : 0) | i, slot = 1ull << 32;
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
