// AVX-512 (F, DQ, BW, VL): 16 floats, masks in mask registers.
#pragma once
#include <immintrin.h>

namespace tgb {
namespace TGB_ISA {

constexpr int kWidth = 16;
constexpr const char* kIsaName = "avx512";
using M = __mmask16;
struct F {
  __m512 v;
  F() {}
  F(__m512 x) : v(x) {}
  F(float x) : v(_mm512_set1_ps(x)) {}
};

static inline F load(const float* p) { return _mm512_load_ps(p); }
static inline F load_unaligned(const float* p) { return _mm512_loadu_ps(p); }
static inline void store(float* p, F a) { _mm512_store_ps(p, a.v); }
static inline void store_unaligned(float* p, F a) { _mm512_storeu_ps(p, a.v); }
static inline F operator+(F a, F b) { return _mm512_add_ps(a.v, b.v); }
static inline F operator-(F a, F b) { return _mm512_sub_ps(a.v, b.v); }
static inline F operator*(F a, F b) { return _mm512_mul_ps(a.v, b.v); }
static inline F operator/(F a, F b) { return _mm512_div_ps(a.v, b.v); }
static inline F fma(F a, F b, F c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }    // a b + c
static inline F fnma(F a, F b, F c) { return _mm512_fnmadd_ps(a.v, b.v, c.v); }  // c - a b
static inline F vmin(F a, F b) { return _mm512_min_ps(a.v, b.v); }
static inline F vmax(F a, F b) { return _mm512_max_ps(a.v, b.v); }
static inline F vsqrt(F a) { return _mm512_sqrt_ps(a.v); }
static inline F vceil(F a) { return _mm512_roundscale_ps(a.v, 2); }
static inline M ge(F a, F b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ); }
static inline M gt(F a, F b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ); }
static inline M both(M a, M b) { return a & b; }
static inline bool any(M m) { return m != 0; }
static inline uint32_t bits(M m) { return m; }
static inline F select(M m, F a, F b) { return _mm512_mask_blend_ps(m, b.v, a.v); }  // m ? a : b
static inline F keep(M m, F a) { return _mm512_maskz_mov_ps(m, a.v); }               // m ? a : 0
static inline F exp2_split(F x, F& fraction) {
  const __m512 n = _mm512_roundscale_ps(x.v, 0);
  fraction = _mm512_sub_ps(x.v, n);
  return n;
}
static inline F scale_by_power(F a, F n) { return _mm512_scalef_ps(a.v, n.v); }  // a 2^n, n integral
static inline void split_exponent(F x, F& exponent, F& mantissa) {  // normal x > 0: mantissa 2^exponent, in [1, 2)
  exponent = _mm512_getexp_ps(x.v), mantissa = _mm512_getmant_ps(x.v, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_zero);
}
static inline F load_level(const int8_t* p) {
  return _mm512_cvtepi32_ps(_mm512_cvtepi8_epi32(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))));
}
static inline F load_level(const int16_t* p) {
  return _mm512_cvtepi32_ps(_mm512_cvtepi16_epi32(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(p))));
}
// T goes on as `next`, or stops: its sign then says so.
static inline F go_on(M go, F next, F T) { return _mm512_mask_blend_ps(go, _mm512_or_ps(T.v, _mm512_set1_ps(-0.f)), next.v); }
static inline F magnitude(F a) { return _mm512_abs_ps(a.v); }
static inline F reciprocal(F a) {  // one Newton step on the estimate: relative error 1e-7
  const __m512 r = _mm512_rcp14_ps(a.v);
  return _mm512_mul_ps(r, _mm512_fnmadd_ps(a.v, r, _mm512_set1_ps(2.f)));
}
static inline F reciprocal_root(F a) {
  const __m512 r = _mm512_rsqrt14_ps(a.v), h = _mm512_mul_ps(_mm512_mul_ps(_mm512_set1_ps(.5f), a.v), r);
  return _mm512_mul_ps(r, _mm512_fnmadd_ps(h, r, _mm512_set1_ps(1.5f)));
}
// Sums over the lanes of a, b, c, d to four floats.
static inline void sum4(float* out, F a, F b, F c, F d) {
  const __m512 ab = _mm512_add_ps(_mm512_unpacklo_ps(a.v, b.v), _mm512_unpackhi_ps(a.v, b.v));
  const __m512 cd = _mm512_add_ps(_mm512_unpacklo_ps(c.v, d.v), _mm512_unpackhi_ps(c.v, d.v));
  const __m512d lo = _mm512_unpacklo_pd(_mm512_castps_pd(ab), _mm512_castps_pd(cd));
  const __m512d hi = _mm512_unpackhi_pd(_mm512_castps_pd(ab), _mm512_castps_pd(cd));
  const __m512 x = _mm512_add_ps(_mm512_castpd_ps(lo), _mm512_castpd_ps(hi));
  const __m256 y = _mm256_add_ps(_mm512_castps512_ps256(x), _mm512_extractf32x8_ps(x, 1));
  _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(y), _mm256_extractf128_ps(y, 1)));
}
// Rows of `a` and `b`, `size` apart, swap the off-diagonal halves of each square of 2 `size` bits.
static inline void swap_halves(__m512i& a, __m512i& b, int size, long long low) {
  const __m512i swapped = _mm512_and_si512(_mm512_xor_si512(_mm512_srli_epi64(a, size), b), _mm512_set1_epi64(low));
  a = _mm512_xor_si512(a, _mm512_slli_epi64(swapped, size)), b = _mm512_xor_si512(b, swapped);
}
// The same where `other` holds the rows `size` apart from those of `a`: lane i, of row i, is the upper one where i has
// the bit `size`.
static inline __m512i swap_halves_with(__m512i a, __m512i other, int size, long long low) {
  const __m512i upper = _mm512_and_si512(_mm512_set_epi64(7, 6, 5, 4, 3, 2, 1, 0), _mm512_set1_epi64(size));
  const __m512i keep = _mm512_mask_blend_epi64(_mm512_test_epi64_mask(upper, upper), _mm512_set1_epi64(low),
                                               _mm512_set1_epi64(~low));
  const __m512i turn = _mm512_mask_blend_epi64(_mm512_test_epi64_mask(upper, upper), _mm512_set1_epi64(size),
                                               _mm512_set1_epi64(64 - size));
  return _mm512_ternarylogic_epi64(keep, a, _mm512_rolv_epi64(other, turn), 0xCA);  // keep ? a : turned
}
// columns[b] bit j = rows[j] bit b
static inline void transpose_bits(const uint64_t* rows, uint64_t* columns) {
  __m512i v[8];
  for (int k = 0; k < 8; k++) v[k] = _mm512_loadu_si512(rows + 8 * k);
  for (int k = 0; k < 4; k++) swap_halves(v[k], v[k + 4], 32, 0x00000000FFFFFFFF);
  for (int k = 0; k < 8; k += k % 2 ? 3 : 1) swap_halves(v[k], v[k + 2], 16, 0x0000FFFF0000FFFF);
  for (int k = 0; k < 8; k += 2) swap_halves(v[k], v[k + 1], 8, 0x00FF00FF00FF00FF);
  for (int k = 0; k < 8; k++) {
    v[k] = swap_halves_with(v[k], _mm512_shuffle_i64x2(v[k], v[k], 0x4E), 4, 0x0F0F0F0F0F0F0F0F);
    v[k] = swap_halves_with(v[k], _mm512_permutex_epi64(v[k], 0x4E), 2, 0x3333333333333333);
    v[k] = swap_halves_with(v[k], _mm512_permutex_epi64(v[k], 0xB1), 1, 0x5555555555555555);
    _mm512_storeu_si512(columns + 8 * k, v[k]);
  }
}
// Writes `first` plus the numbers of the set bits, lowest first, to `out`, which has room for 64; returns how many.
static inline int list_bits(uint64_t word, int first, uint32_t* out) {
  const int count = __builtin_popcountll(word);
  const __m512i lane = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
  __m512i number = _mm512_add_epi32(lane, _mm512_set1_epi32(first));
  for (int quarter = 0; quarter < 4; quarter++, word >>= 16, number = _mm512_add_epi32(number, _mm512_set1_epi32(16))) {
    const __mmask16 bits = static_cast<__mmask16>(word);
    _mm512_storeu_si512(out, _mm512_maskz_compress_epi32(bits, number));
    out += __builtin_popcount(bits);
  }
  return count;
}
// out[lane] = the lane of eight vectors of whole numbers 0..255 as bytes, rows[0] lowest.
static inline void join_bytes(const F* rows, uint64_t* out) {
  __m512i half[2];
  for (int h = 0; h < 2; h++) {
    half[h] = _mm512_cvtps_epi32(rows[4 * h].v);
    for (int r = 1; r < 4; r++)
      half[h] = _mm512_or_si512(half[h], _mm512_slli_epi32(_mm512_cvtps_epi32(rows[4 * h + r].v), 8 * r));
  }
  const auto widen = [](__m256i low, __m256i high) {
    return _mm512_or_si512(_mm512_cvtepu32_epi64(low), _mm512_slli_epi64(_mm512_cvtepu32_epi64(high), 32));
  };
  _mm512_storeu_si512(out, widen(_mm512_castsi512_si256(half[0]), _mm512_castsi512_si256(half[1])));
  _mm512_storeu_si512(out + 8, widen(_mm512_extracti64x4_epi64(half[0], 1), _mm512_extracti64x4_epi64(half[1], 1)));
}
// Writes 16 vectors as 16 structs of 16 floats.
static inline void store_transposed(float* p, const F* in) {
  __m512 a[16], b[16];
  for (int i = 0; i < 16; i += 2)
    a[i] = _mm512_unpacklo_ps(in[i].v, in[i + 1].v), a[i + 1] = _mm512_unpackhi_ps(in[i].v, in[i + 1].v);
  for (int i = 0; i < 16; i += 4)
    for (int j = 0; j < 2; j++) {
      const __m512d x = _mm512_castps_pd(a[i + j]), y = _mm512_castps_pd(a[i + j + 2]);
      b[i + 2 * j] = _mm512_castpd_ps(_mm512_unpacklo_pd(x, y));
      b[i + 2 * j + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(x, y));
    }
  for (int k = 0; k < 4; k++) {  // b[4 i + k]: fields 4 i .. 4 i + 3 of structs k, k + 4, k + 8, k + 12
    const __m512 low = _mm512_shuffle_f32x4(b[k], b[4 + k], 0x88), high = _mm512_shuffle_f32x4(b[k], b[4 + k], 0xDD);
    const __m512 low2 = _mm512_shuffle_f32x4(b[8 + k], b[12 + k], 0x88), high2 = _mm512_shuffle_f32x4(b[8 + k], b[12 + k], 0xDD);
    _mm512_storeu_ps(p + 16 * k, _mm512_shuffle_f32x4(low, low2, 0x88));
    _mm512_storeu_ps(p + 16 * (k + 4), _mm512_shuffle_f32x4(high, high2, 0x88));
    _mm512_storeu_ps(p + 16 * (k + 8), _mm512_shuffle_f32x4(low, low2, 0xDD));
    _mm512_storeu_ps(p + 16 * (k + 12), _mm512_shuffle_f32x4(high, high2, 0xDD));
  }
}
static inline void store_ints(int32_t* p, F a) { _mm512_storeu_si512(p, _mm512_cvtps_epi32(a.v)); }
// p[0], p[S], p[2 S] ...
template <int S>
static inline F load_strided(const float* p) {
  const __m512i lane = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
  return _mm512_i32gather_ps(_mm512_mullo_epi32(lane, _mm512_set1_epi32(S)), p, 4);
}
// bfloat16 storage: the upper half of a float, rounded to nearest.
static inline F load_bf16(const uint16_t* p) {
  const __m256i half = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
  return _mm512_castsi512_ps(_mm512_slli_epi32(_mm512_cvtepu16_epi32(half), 16));
}

}  // namespace TGB_ISA
}  // namespace tgb
