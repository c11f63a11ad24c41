// Data of the rasteriser shared by its stages, whatever instruction set they are compiled for. Plain data only.
//
// Pixel frame: pixel (row i, column j) has its centre at (x, y) = (j, i). Image: row-major, RGB interleaved.
// Screen tiles are 32 x 32 px, each split into 8 x 8 blocks of 4 x 4 px: one block is one AVX-512 vector, and the
// blocks of a tile that a Gaussian touches are one 64-bit mask. (3DGB's 16-px tiles, which decide what a pixel may
// meet, are `Constants::tile` and enter as the rectangle `Splat::x0..y1`.)
#pragma once
#include <cstdint>

#include "buffer.h"

namespace tgb {

constexpr int kTile = 32, kBlock = 4, kLanes = kBlock * kBlock, kBlocksAcross = kTile / kBlock;
constexpr int kBlocks = kBlocksAcross * kBlocksAcross;
constexpr int kSlot = 16;  // floats per gradient slot: one cache line
static_assert(kBlocks == 64, "a block mask is one 64-bit word");

// The structures below are mirrored field by field in src/toonifygb/render/native.py.
struct Constants {
  float near, alpha_max, alpha_min, low_pass, transmittance_min, frustum_margin, radius_sigmas;
  int32_t tile;
};
struct Camera {
  float view[12];          // rows of the world-to-camera transform [R | t]
  float fx, fy, cx, cy;    // px; cx, cy for pixel centres at half-integers
  int32_t width, height;
};
struct Splats {
  int32_t n, sh_stored, sh_degree;  // sh_stored: coefficients per colour in memory, at least (sh_degree + 1)^2
  const float *means, *quats, *scales, *opacities, *sh;
  const float* sh_frames;  // n x 3 x 3, or null
};
struct Scene {
  Constants constants;
  Camera camera;
  Splats splats;
  float background[3];
  int32_t threads;
};
struct Gradients {
  const float *v_color, *v_alpha;                       // what arrives: d loss / d image
  float *means, *quats, *scales, *opacities, *sh;       // what leaves: d loss / d splats
  float* sh_frames;                                     // or null
  float* mean2d_color;                                  // n x 2, colour part only, px; or null
};

// One visible Gaussian, one cache line. log2(alpha) at pixel p: lo - u^2 - v^2 with u = ux dx + uy dy, v = vy dy and
// d = p - (mx, my): the Cholesky factor of the conic, so the exponent cannot cancel or turn positive.
struct alignas(64) Splat {
  float mx, my, ux, uy, vy, lo;
  float width, tip;               // 1 / ux; y - my of the rightmost point that reaches alpha_min (with kSlack)
  float r, g, b;
  float place;                    // in the list of the tile at work
  float x0, y0, x1, y1;           // blocks of the image it may touch: [x0, x1) x [y0, y1)
};
constexpr int kSplatFloats = 16;
static_assert(sizeof(Splat) == kSplatFloats * sizeof(float), "one cache line");

// Everything one rendered image leaves behind for its backward pass, and the workspace of both.
struct Frame {
  int visible = 0, tiles_x = 0, tiles_y = 0;
  uint32_t pairs = 0;                          // (Gaussian, tile) pairs
  Buffer<Splat> records;                       // by input index, like the four below; of those that are drawn
  Buffer<int32_t> tile_columns, tile_rows;     // see TileRect: ordering reads only these and
  Buffer<float> depth;
  Buffer<uint8_t> drawn, clamped;              // is it drawn at all; colour channels clamped at 0 (bits)
  Buffer<int32_t> visible_before;              // per chunk of Gaussians
  Buffer<uint64_t> order, order_swap;          // front to back: input index | bits of the depth << 32
  Buffer<uint32_t> slot_begin;                 // by input index: its first gradient slot
  Buffer<uint32_t> tile_begin, tile_used, histogram;
  Buffer<uint64_t> list;                       // per pair, tile by tile, front to back: input index | slot << 32
  Buffer<uint64_t> masks;                      // per pair: blocks touched while alive
  Buffer<float> transmittance, last;           // per pixel, block-major: final T; list index of the last contribution
  Buffer<float> slots;
  Buffer<float> factors;                       // of playback: psi times step, [channel, row]
};

// Screen tiles [x0, x1) x [y0, y1) of a record. A range is one number below 2^24, so that floats can count it.
struct TileRect {
  static constexpr int kBits = 12;
  int x0, x1, y0, y1;
  TileRect(const Frame& frame, uint32_t i)
      : x0(frame.tile_columns[i] & ((1 << kBits) - 1)),
        x1(frame.tile_columns[i] >> kBits),
        y0(frame.tile_rows[i] & ((1 << kBits) - 1)),
        y1(frame.tile_rows[i] >> kBits) {}
};

constexpr float kSlack = 1e-3f;                // in log2(alpha): block masks may be too large by this, never too small
constexpr int kChunk = 1024;                   // Gaussians per task
inline int chunks(int n) { return (n + kChunk - 1) / kChunk; }

// Stages that need no vector code (raster_order.cpp).
void sort_by_depth(Frame& frame, const Scene& scene);
void bin_into_tiles(Frame& frame, const Scene& scene, bool keep);  // keep: for a backward pass

}  // namespace tgb
