// The 4 x 4 pixel blocks of a screen tile: their coordinates, and which of them a splat can touch.
#pragma once
#include "raster.h"
#include "simd.h"

namespace tgb {
namespace TGB_ISA {

// Pixel centres of the blocks in each column and row of a tile, and each block's first pixel, relative to the tile.
// Small on purpose: it lives in the L1 cache beside a tile's pixels. A constant expression: code run at load time must
// not use an instruction set the machine may lack.
struct BlockTable {
  alignas(64) float x[kBlocksAcross][kLanes], y[kBlocksAcross][kLanes], left[kBlocks], top[kBlocks];
  constexpr BlockTable() : x{}, y{}, left{}, top{} {
    for (int b = 0; b < kBlocks; b++) {
      left[b] = static_cast<float>(b % kBlocksAcross * kBlock), top[b] = static_cast<float>(b / kBlocksAcross * kBlock);
    }
    for (int i = 0; i < kBlocksAcross; i++)
      for (int l = 0; l < kLanes; l++)
        x[i][l] = static_cast<float>(i * kBlock + l % kBlock), y[i][l] = static_cast<float>(i * kBlock + l / kBlock);
  }
};
static constexpr BlockTable kBlockTable{};
static inline const float* block_x(int block) { return kBlockTable.x[block % kBlocksAcross]; }
static inline const float* block_y(int block) { return kBlockTable.y[block / kBlocksAcross]; }

// One screen tile: its place in the image and its part inside it.
struct TileView {
  int left, top, width, height;
  TileView(const Frame& frame, const Scene& scene, int tile) {
    left = tile % frame.tiles_x * kTile, top = tile / frame.tiles_x * kTile;
    width = imin(kTile, scene.camera.width - left), height = imin(kTile, scene.camera.height - top);
  }
  bool whole() const { return width == kTile && height == kTile; }
  bool holds(int block, int lane) const {
    return block_x(block)[lane] < width && block_y(block)[lane] < height;
  }
};

// Blocks of the tile at (left, top) px that lie in the splat's block rectangle.
static inline uint64_t rectangle_mask(const Splat& s, int left, int top) {
  const int bx = left / kBlock, by = top / kBlock;
  const int x0 = imax(s.x0 - bx, 0), x1 = imin(s.x1 - bx, kBlocksAcross);
  const int y0 = imax(s.y0 - by, 0), y1 = imin(s.y1 - by, kBlocksAcross);
  const uint64_t row = ((1u << x1) - 1) & ~((1u << x0) - 1);
  const uint64_t rows_below = y1 == kBlocksAcross ? ~0ull : (1ull << (8 * y1)) - 1;
  return row * 0x0101010101010101ull & rows_below & ~((1ull << (8 * y0)) - 1);
}

// Four neighbouring pixels of one row of a block, as they stand in an image row.
static inline void copy_quad(float* to, const float* from) { memcpy(to, from, kBlock * sizeof(float)); }

constexpr uint64_t kGroup = (1ull << kWidth) - 1;

// Blocks whose rectangle of pixel centres the ellipse {log2 alpha >= threshold} reaches, exactly up to rounding. The
// exponent is concave, so its largest value over a rectangle is at the point nearest the mean along x (then the best
// y there) or along y (then the best x). `s` has its mean relative to the tile.
//
// Blocks outside `within` are not looked for. Narrow vectors skip groups without any; for 16 lanes a mispredicted
// branch costs more than the test.
static inline uint64_t ellipse_mask(const Splat& s, float threshold, uint64_t within) {
  const F ux(s.ux), uy(s.uy), vy(s.vy), lo(s.lo), zero(0.f), extent(kBlock - 1.f), limit(threshold - 1e-3f);
  uint64_t mask = 0;
  for (int b = 0; b < kBlocks; b += kWidth) {
    if (kWidth < 16 && (within >> b & kGroup) == 0) continue;
    const F x0 = load(kBlockTable.left + b) - F(s.mx), y0 = load(kBlockTable.top + b) - F(s.my);
    const F x1 = x0 + extent, y1 = y0 + extent;
    const F near_x = clamp(zero, x0, x1), near_y = clamp(zero, y0, y1);
    const F best_y = clamp(F(s.slope_y) * near_x, y0, y1), best_x = clamp(F(s.slope_x) * near_y, x0, x1);
    const F u1 = fma(ux, near_x, uy * best_y), v1 = vy * best_y, u2 = fma(ux, best_x, uy * near_y), v2 = vy * near_y;
    const F p1 = fnma(v1, v1, fnma(u1, u1, lo)), p2 = fnma(v2, v2, fnma(u2, u2, lo));
    mask |= static_cast<uint64_t>(bits(ge(vmax(p1, p2), limit))) << b;
  }
  return mask & within;
}

}  // namespace TGB_ISA
}  // namespace tgb
