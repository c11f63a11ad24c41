// The 4 x 4 pixel blocks of a screen tile: their coordinates, and which of them a splat can touch.
#pragma once
#include "raster.h"
#include "simd.h"

namespace tgb {
namespace TGB_ISA {

// Pixel centres of the blocks in each column and row of a tile, relative to the tile.
// Small on purpose: it lives in the L1 cache beside a tile's pixels. A constant expression: code run at load time must
// not use an instruction set the machine may lack.
struct BlockTable {
  alignas(64) float x[kBlocksAcross][kLanes], y[kBlocksAcross][kLanes];
  constexpr BlockTable() : x{}, y{} {
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

// Four neighbouring pixels of one row of a block, as they stand in an image row.
static inline void copy_quad(float* to, const float* from) { memcpy(to, from, kBlock * sizeof(float)); }

// For kWidth splats with means relative to the tile: the blocks of the tile that each one's rectangle holds and its
// ellipse {u^2 + v^2 <= L} reaches, exactly up to kSlack: L is lo - threshold + kSlack. Row by row of the tile: the
// part of the ellipse between the first and the last pixel row of a block row is convex; its leftmost and rightmost
// points are those of the whole ellipse where they are in there, else on the edge nearer to them.
static inline void block_masks(const Splat* splats, const TileView& view, float threshold, uint64_t* masks) {
  const auto field = [&](float Splat::*member) { return load_strided<kSplatFloats>(&(splats->*member)); };
  const F mx = field(&Splat::mx), my = field(&Splat::my), vy = field(&Splat::vy), width = field(&Splat::width);
  const F tip = field(&Splat::tip), lean = field(&Splat::uy) * width;
  const F reach = field(&Splat::lo) + F(kSlack - threshold), zero(0.f), one(1.f), quarter(1.f / kBlock);
  const F left_block(static_cast<float>(view.left / kBlock)), top_block(static_cast<float>(view.top / kBlock));
  const F columns(static_cast<float>(kBlocksAcross));
  const F x0 = clamp(field(&Splat::x0) - left_block, zero, columns), x1 = clamp(field(&Splat::x1) - left_block, zero, columns);
  const F y0 = field(&Splat::y0) - top_block, y1 = field(&Splat::y1) - top_block;
  F rows[kBlocksAcross];
  for (int row = 0; row < kBlocksAcross; row++) {
    const F top = F(static_cast<float>(row * kBlock)) - my, bottom = top + F(kBlock - 1.f), number(static_cast<float>(row));
    const F left_y = clamp(-tip, top, bottom), right_y = clamp(tip, top, bottom);
    const F left_v = vy * left_y, right_v = vy * right_y;
    const F left_rest = fnma(left_v, left_v, reach), right_rest = fnma(right_v, right_v, reach);
    const F left = fnma(width, root(left_rest), fnma(lean, left_y, mx));
    const F right = fma(width, root(right_rest), fnma(lean, right_y, mx));
    const F first = clamp(vceil((left - F(kBlock - 1.f)) * quarter), x0, x1);
    const F end = clamp(one - vceil(-(right * quarter)), x0, x1);
    const M inside = both(both(ge(left_rest, zero), ge(right_rest, zero)), both(ge(number, y0), gt(y1, number)));
    // 2^end - 2^first: the bits between
    rows[row] = keep(inside, vmax(zero, scale_by_power(one, end) - scale_by_power(one, first)));
  }
  join_bytes(rows, masks);
}

}  // namespace TGB_ISA
}  // namespace tgb
