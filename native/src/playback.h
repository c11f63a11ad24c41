// Data of playback: an avatar as one pass over memory reads it.
//
// Gaussians come in blocks of kPlaybackBlock, all quantities lane by lane: [block][channel][Gaussian of the block].
// Channels of a Gaussian: position 3, quaternion 4 (w, x, y, z), log scale 3, opacity logit 1, then harmonics,
// coefficient by coefficient, r g b. The last block is filled up with copies of anything.
#pragma once
#include <cstdint>

namespace tgb {

constexpr int kPlaybackBlock = 64, kDeltaGroups = 3;

// Deltas of channels [first, first + width) as whole levels times a step for every channel and row. A row is left out
// of the blocks in which it changes nothing.
struct DeltaGroup {
  int32_t first, width, bytes;  // bytes of a level: 1 or 2, signed
  const int32_t* begin;         // [blocks + 1]: entries (block, row) before each block
  const int32_t* row;           // [entries]
  const float* steps;           // [width, rows]
  const void* levels;           // block by block: [width][entries of the block][kPlaybackBlock]
};

// Mirrored field by field in src/toonifygb/render/library.py.
struct Playback {
  int32_t n, rows, sh_degree;
  const float* neutral;  // [blocks][channels][kPlaybackBlock]
  const float* weights;  // [blocks][kJoints][kPlaybackBlock]
  DeltaGroup groups[kDeltaGroups];
};

}  // namespace tgb
