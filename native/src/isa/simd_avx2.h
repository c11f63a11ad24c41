// AVX2 + FMA: 8 floats, masks in vector registers.
#pragma once
#include <immintrin.h>

#include "bit_transpose.h"

namespace tgb {
namespace TGB_ISA {

constexpr int kWidth = 8;
constexpr const char* kIsaName = "avx2";
struct M {
  __m256 v;
};
struct F {
  __m256 v;
  F() {}
  F(__m256 x) : v(x) {}
  F(float x) : v(_mm256_set1_ps(x)) {}
};

static inline F load(const float* p) { return _mm256_load_ps(p); }
static inline F load_unaligned(const float* p) { return _mm256_loadu_ps(p); }
static inline void store(float* p, F a) { _mm256_store_ps(p, a.v); }
static inline void store_unaligned(float* p, F a) { _mm256_storeu_ps(p, a.v); }
static inline F operator+(F a, F b) { return _mm256_add_ps(a.v, b.v); }
static inline F operator-(F a, F b) { return _mm256_sub_ps(a.v, b.v); }
static inline F operator*(F a, F b) { return _mm256_mul_ps(a.v, b.v); }
static inline F operator/(F a, F b) { return _mm256_div_ps(a.v, b.v); }
static inline F fma(F a, F b, F c) { return _mm256_fmadd_ps(a.v, b.v, c.v); }    // a b + c
static inline F fnma(F a, F b, F c) { return _mm256_fnmadd_ps(a.v, b.v, c.v); }  // c - a b
static inline F vmin(F a, F b) { return _mm256_min_ps(a.v, b.v); }
static inline F vmax(F a, F b) { return _mm256_max_ps(a.v, b.v); }
static inline F vsqrt(F a) { return _mm256_sqrt_ps(a.v); }
static inline F vceil(F a) { return _mm256_ceil_ps(a.v); }
static inline M ge(F a, F b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
static inline M gt(F a, F b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GT_OQ)}; }
static inline M both(M a, M b) { return {_mm256_and_ps(a.v, b.v)}; }
static inline bool any(M m) { return !_mm256_testz_ps(m.v, m.v); }
static inline uint32_t bits(M m) { return static_cast<uint32_t>(_mm256_movemask_ps(m.v)); }
static inline F select(M m, F a, F b) { return _mm256_blendv_ps(b.v, a.v, m.v); }  // m ? a : b
static inline F keep(M m, F a) { return _mm256_and_ps(m.v, a.v); }                 // m ? a : 0
static inline F exp2_split(F x, F& fraction) {
  x = vmax(x, F(-126.f));
  const __m256 n = _mm256_round_ps(x.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
  fraction = _mm256_sub_ps(x.v, n);
  return n;
}
static inline F scale_by_power(F a, F n) {  // a 2^n, n integral
  const __m256i shifted = _mm256_slli_epi32(_mm256_cvtps_epi32(n.v), 23);
  return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(a.v), shifted));
}
static inline void split_exponent(F x, F& exponent, F& mantissa) {  // normal x > 0: mantissa 2^exponent, in [1, 2)
  const __m256i word = _mm256_castps_si256(x.v);
  exponent = _mm256_cvtepi32_ps(_mm256_sub_epi32(_mm256_srli_epi32(word, 23), _mm256_set1_epi32(127)));
  mantissa = _mm256_castsi256_ps(
      _mm256_or_si256(_mm256_and_si256(word, _mm256_set1_epi32(0x7fffff)), _mm256_set1_epi32(0x3f800000)));
}
static inline F load_level(const int8_t* p) {
  return _mm256_cvtepi32_ps(_mm256_cvtepi8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(p))));
}
static inline F load_level(const int16_t* p) {
  return _mm256_cvtepi32_ps(_mm256_cvtepi16_epi32(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))));
}
static inline F go_on(M go, F next, F T) {  // T goes on as `next`, or stops: its sign then says so
  return _mm256_blendv_ps(_mm256_or_ps(T.v, _mm256_set1_ps(-0.f)), next.v, go.v);
}
static inline F magnitude(F a) { return _mm256_andnot_ps(_mm256_set1_ps(-0.f), a.v); }
static inline F reciprocal(F a) {  // one Newton step on the estimate: relative error 2e-7
  const __m256 r = _mm256_rcp_ps(a.v);
  return _mm256_mul_ps(r, _mm256_fnmadd_ps(a.v, r, _mm256_set1_ps(2.f)));
}
static inline F reciprocal_root(F a) {
  const __m256 r = _mm256_rsqrt_ps(a.v), h = _mm256_mul_ps(_mm256_mul_ps(_mm256_set1_ps(.5f), a.v), r);
  return _mm256_mul_ps(r, _mm256_fnmadd_ps(h, r, _mm256_set1_ps(1.5f)));
}
// Sums over the lanes of a, b, c, d to four floats.
static inline void sum4(float* out, F a, F b, F c, F d) {
  const __m256 ab = _mm256_add_ps(_mm256_unpacklo_ps(a.v, b.v), _mm256_unpackhi_ps(a.v, b.v));
  const __m256 cd = _mm256_add_ps(_mm256_unpacklo_ps(c.v, d.v), _mm256_unpackhi_ps(c.v, d.v));
  const __m256d lo = _mm256_unpacklo_pd(_mm256_castps_pd(ab), _mm256_castps_pd(cd));
  const __m256d hi = _mm256_unpackhi_pd(_mm256_castps_pd(ab), _mm256_castps_pd(cd));
  const __m256 x = _mm256_add_ps(_mm256_castpd_ps(lo), _mm256_castpd_ps(hi));
  _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps(x, 1)));
}
static inline void store_ints(int32_t* p, F a) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), _mm256_cvtps_epi32(a.v));
}
// p[0], p[S], p[2 S] ...
template <int S>
static inline F load_strided(const float* p) {
  const __m256i lane = _mm256_set_epi32(7, 6, 5, 4, 3, 2, 1, 0);
  return _mm256_i32gather_ps(p, _mm256_mullo_epi32(lane, _mm256_set1_epi32(S)), 4);
}
static inline F load_bf16(const uint16_t* p) {
  const __m128i half = _mm_loadu_si128(reinterpret_cast<const __m128i*>(p));
  return _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_cvtepu16_epi32(half), 16));
}

}  // namespace TGB_ISA
}  // namespace tgb
