// 64 x 64 bit-matrix transpose by swapping ever smaller off-diagonal blocks.
#pragma once
#include <cstdint>
#include <cstring>

namespace tgb {
namespace TGB_ISA {

// columns[b] bit j = rows[j] bit b
static inline void transpose_bits(const uint64_t* rows, uint64_t* columns) {
  memcpy(columns, rows, 64 * sizeof(uint64_t));
  uint64_t mask = 0x00000000FFFFFFFFull;
  for (int size = 32; size != 0; size >>= 1, mask ^= mask << size) {
    for (int row = 0; row < 64; row = ((row | size) + 1) & ~size) {
      const uint64_t swapped = ((columns[row] >> size) ^ columns[row | size]) & mask;
      columns[row] ^= swapped << size;
      columns[row | size] ^= swapped;
    }
  }
}

}  // namespace TGB_ISA
}  // namespace tgb
