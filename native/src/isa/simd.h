// A small vector layer: a vector F of kWidth floats and a mask M with the same operators for every instruction set,
// so that kernels read like scalar code. Only what the kernels use.
//
// Everything compiled per instruction set stays in the namespace tgb::TGB_ISA and calls no function template of the
// standard library: the linker would merge such code across instruction sets and could pick one the machine lacks.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>

#if defined(__AVX512F__)
#include "simd_avx512.h"
#elif defined(__AVX2__)
#include "simd_avx2.h"
#else
#include "simd_generic.h"
#endif

namespace tgb {
namespace TGB_ISA {

static inline F& operator+=(F& a, F b) { return a = a + b; }
static inline F operator-(F a) { return F(0.f) - a; }
static inline F vfloor(F a) { return -vceil(-a); }
static inline F clamp(F a, F lo, F hi) { return vmin(vmax(a, lo), hi); }
static inline int imin(int a, int b) { return a < b ? a : b; }
static inline int imax(int a, int b) { return a > b ? a : b; }

#if !defined(__AVX512F__)
// out[lane] = the lane of eight vectors of whole numbers 0..255 as bytes, rows[0] lowest.
static inline void join_bytes(const F* rows, uint64_t* out) {
  alignas(64) float lanes[kWidth];
  memset(out, 0, kWidth * sizeof(uint64_t));
  for (int r = 0; r < 8; r++) {
    store(lanes, rows[r]);
    for (int i = 0; i < kWidth; i++) out[i] |= static_cast<uint64_t>(lanes[i]) << (8 * r);
  }
}
#endif

// Square root, fast; of 1e-20 for less.
static inline F root(F a) {
  a = vmax(a, F(1e-20f));
  return a * reciprocal_root(a);
}

// 2^x with a relative error below 3e-7 for x in [-126, 126]: 2^n times a degree-5 minimax polynomial of the rest.
static inline F exp2(F x) {
  F f;
  const F n = exp2_split(x, f), f2 = f * f;
  const F a = fma(F(0.0013264727252686875f), f, F(0.009671512785855915f));
  const F b = fma(F(0.05550733744471606f), f, F(0.24022242083110573f));
  const F c = fma(F(0.693146977597677f), f, F(1.f));
  return scale_by_power(fma(fma(a, f2, b), f2, c), n);
}

// log2(x) for x > 0 with an absolute error below 2e-7: the exponent, and the artanh series of the rest,
// moved to [sqrt(1/2), sqrt(2)].
static inline F log2(F x) {
  F exponent, m;
  split_exponent(x, exponent, m);  // x = m 2^exponent, m in [1, 2)
  const M high = gt(m, F(1.41421356f));
  m = select(high, m * F(0.5f), m), exponent = select(high, exponent + F(1.f), exponent);
  const F t = (m - F(1.f)) / (m + F(1.f)), t2 = t * t;
  const F series = fma(fma(fma(fma(F(1.f / 9), t2, F(1.f / 7)), t2, F(1.f / 5)), t2, F(1.f / 3)), t2, F(1.f));
  return fma(t * F(2.8853900817779268f), series, exponent);
}

// Array of structs of S floats, `count` <= kWidth items (the last one repeated), to S vectors.
template <int S>
static inline void load_structs(const float* p, int count, F* out) {
  if (count == kWidth) {
    for (int s = 0; s < S; s++) out[s] = load_strided<S>(p + s);
    return;
  }
  alignas(64) float t[S][kWidth];
  for (int i = 0; i < kWidth; i++)
    for (int s = 0; s < S; s++) t[s][i] = p[imin(i, count - 1) * S + s];
  for (int s = 0; s < S; s++) out[s] = load(t[s]);
}

template <int S>
static inline void store_structs(float* p, int count, const F* in) {
#if defined(__AVX512F__)
  if (S == kWidth && count == kWidth) return store_transposed(p, in);
#endif
  alignas(64) float t[S][kWidth];
  for (int s = 0; s < S; s++) store(t[s], in[s]);
  for (int i = 0; i < count; i++)
    for (int s = 0; s < S; s++) p[i * S + s] = t[s][i];
}

}  // namespace TGB_ISA
}  // namespace tgb
