// Words of bits, in plain C++.
#pragma once
#include <cstdint>
#include <cstring>

namespace tgb {
namespace TGB_ISA {

// columns[b] bit j = rows[j] bit b, by swapping ever smaller off-diagonal squares.
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

// Writes `first` plus the numbers of the set bits, lowest first, to `out`, which has room for 64; returns how many.
static inline int list_bits(uint64_t word, int first, uint32_t* out) {
  int count = 0;
  for (; word != 0; word &= word - 1) out[count++] = static_cast<uint32_t>(first + __builtin_ctzll(word));
  return count;
}

}  // namespace TGB_ISA
}  // namespace tgb
