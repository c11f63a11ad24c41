// GCC/Clang vector extensions, 4 floats: SSE2 on x86-64, NEON on arm64, and whatever else the compiler knows.
#pragma once
#include <cmath>

#include "bit_transpose.h"
#if defined(__SSE2__)
#include <emmintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif
#if defined(__FAST_MATH__)
#error "exp2_split relies on (x + magic) - magic: compile without -ffast-math"
#endif

namespace tgb {
namespace TGB_ISA {

constexpr int kWidth = 4;
constexpr const char* kIsaName = "generic";
typedef float v4f __attribute__((vector_size(16)));
typedef int32_t v4i __attribute__((vector_size(16)));
using M = v4i;
struct F {
  v4f v;
  F() {}
  F(v4f x) : v(x) {}
  F(float x) : v(v4f{x, x, x, x}) {}
};

static inline F load(const float* p) { return *reinterpret_cast<const v4f*>(p); }
static inline F load_unaligned(const float* p) {
  v4f r;
  memcpy(&r, p, 16);
  return r;
}
static inline void store(float* p, F a) { *reinterpret_cast<v4f*>(p) = a.v; }
static inline void store_unaligned(float* p, F a) { memcpy(p, &a.v, 16); }
static inline F operator+(F a, F b) { return a.v + b.v; }
static inline F operator-(F a, F b) { return a.v - b.v; }
static inline F operator*(F a, F b) { return a.v * b.v; }
static inline F operator/(F a, F b) { return a.v / b.v; }
static inline F fma(F a, F b, F c) { return a.v * b.v + c.v; }   // fused where the target can
static inline F fnma(F a, F b, F c) { return c.v - a.v * b.v; }
static inline F select(M m, F a, F b) { return (v4f)((m & (v4i)a.v) | (~m & (v4i)b.v)); }  // m ? a : b
static inline F keep(M m, F a) { return (v4f)(m & (v4i)a.v); }                             // m ? a : 0
static inline M ge(F a, F b) { return a.v >= b.v; }
static inline M gt(F a, F b) { return a.v > b.v; }
static inline F vmin(F a, F b) { return select(a.v < b.v, a, b); }
static inline F vmax(F a, F b) { return select(a.v > b.v, a, b); }
static inline F vsqrt(F a) { return v4f{sqrtf(a.v[0]), sqrtf(a.v[1]), sqrtf(a.v[2]), sqrtf(a.v[3])}; }
static inline F vceil(F a) { return v4f{ceilf(a.v[0]), ceilf(a.v[1]), ceilf(a.v[2]), ceilf(a.v[3])}; }
static inline M both(M a, M b) { return a & b; }
#if defined(__SSE2__)
static inline uint32_t bits(M m) { return static_cast<uint32_t>(_mm_movemask_ps((__m128)m)); }
#elif defined(__aarch64__)
static inline uint32_t bits(M m) { return vaddvq_u32((uint32x4_t)(m & v4i{1, 2, 4, 8})); }
#else
static inline uint32_t bits(M m) { return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8); }
#endif
static inline bool any(M m) { return bits(m) != 0; }
static inline F exp2_split(F x, F& fraction) {
  x = vmax(x, F(-126.f));
  const v4f magic = {12582912.f, 12582912.f, 12582912.f, 12582912.f};  // 1.5 x 2^23: adding it rounds to integers
  const v4f n = (x.v + magic) - magic;
  fraction = x.v - n;
  return n;
}
static inline F scale_by_power(F a, F n) {  // a 2^n, n integral
  return (v4f)((v4i)a.v + (__builtin_convertvector(n.v, v4i) << 23));
}
static inline void split_exponent(F x, F& exponent, F& mantissa) {  // normal x > 0: mantissa 2^exponent, in [1, 2)
  const v4i word = (v4i)x.v;
  exponent = __builtin_convertvector((word >> 23) - 127, v4f);
  mantissa = (v4f)((word & 0x7fffff) | 0x3f800000);
}
template <class Level>
static inline F load_level(const Level* p) {
  return __builtin_convertvector((v4i{p[0], p[1], p[2], p[3]}), v4f);
}
static inline F magnitude(F a) { return (v4f)((v4i)a.v & 0x7fffffff); }
static inline F go_on(M go, F next, F T) { return select(go, next, -magnitude(T).v); }  // T goes on, or stops: negative
static inline F reciprocal(F a) { return F(1.f) / a; }
static inline F reciprocal_root(F a) { return F(1.f) / vsqrt(a); }
static inline float sum(F a) { return (a.v[0] + a.v[1]) + (a.v[2] + a.v[3]); }
static inline void sum4(float* out, F a, F b, F c, F d) {
  out[0] = sum(a), out[1] = sum(b), out[2] = sum(c), out[3] = sum(d);
}
static inline void store_ints(int32_t* p, F a) {
  const v4i whole = __builtin_convertvector(a.v, v4i);
  memcpy(p, &whole, 16);
}
// p[0], p[S], p[2 S] ...
template <int S>
static inline F load_strided(const float* p) {
  return v4f{p[0], p[S], p[2 * S], p[3 * S]};
}
static inline F load_bf16(const uint16_t* p) {
  return (v4f)(v4i{p[0] << 16, p[1] << 16, p[2] << 16, p[3] << 16});
}

}  // namespace TGB_ISA
}  // namespace tgb
