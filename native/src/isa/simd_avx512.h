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
// columns[b] bit j = rows[j] bit b
static inline void transpose_bits(const uint64_t* rows, uint64_t* columns) {
  __m512i v[8];
  for (int k = 0; k < 8; k++) v[k] = _mm512_loadu_si512(rows + 8 * k);
  for (int b = 0; b < 64; b++) {
    const __m512i bit = _mm512_set1_epi64(static_cast<long long>(1ull << b));
    uint64_t column = 0;
    for (int k = 0; k < 8; k++) column |= static_cast<uint64_t>(_mm512_test_epi64_mask(v[k], bit)) << (8 * k);
    columns[b] = column;
  }
}
// bfloat16 storage: the upper half of a float, rounded to nearest.
static inline F load_bf16(const uint16_t* p) {
  const __m256i half = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
  return _mm512_castsi512_ps(_mm512_slli_epi32(_mm512_cvtepu16_epi32(half), 16));
}

}  // namespace TGB_ISA
}  // namespace tgb
