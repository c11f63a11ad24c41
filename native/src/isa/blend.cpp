// Blendshape evaluation and Adam. All of it is bound by memory traffic: every delta is read once per evaluation, and
// read and written once with its two moments per step; the gradient of row k, the sum of psi_k g over the frames of
// the step, is never stored.
#include "kernels.h"

namespace tgb {
namespace TGB_ISA {
namespace {

constexpr int kSweep = 4096;    // parameters per blending task: they stay in the L1 cache while rows stream past
constexpr int kFrameSweep = 1024;  // the same where several frames' sums share the cache
constexpr int kLiveBlock = 64;    // Gaussians that are left out together where a row moves none of them
constexpr int kAdamChunk = 8192;  // parameters per Adam task: gradient and rates stay in the L2 cache

inline F load_delta(const float* p) { return load_unaligned(p); }
inline F load_delta(const uint16_t* p) { return load_bf16(p); }
inline float scalar_delta(float p) { return p; }
inline float scalar_delta(uint16_t p) {
  const uint32_t word = static_cast<uint32_t>(p) << 16;
  float value;
  memcpy(&value, &word, 4);
  return value;
}

// out = source + w0 rows0 + ... for up to four rows in one pass over out.
template <int N, class T>
inline void add_rows(const float* source, const T* const* rows, const float* weights, float* out, int count) {
  F w[N];
  for (int r = 0; r < N; r++) w[r] = F(weights[r]);
  int i = 0;
  for (; i + kWidth <= count; i += kWidth) {
    F sum = load_unaligned(source + i);
    for (int r = 0; r < N; r++) sum = fma(w[r], load_delta(rows[r] + i), sum);
    store_unaligned(out + i, sum);
  }
  for (; i < count; i++) {
    float sum = source[i];
    for (int r = 0; r < N; r++) sum = __builtin_fmaf(weights[r], scalar_delta(rows[r][i]), sum);
    out[i] = sum;
  }
}

constexpr int kRows = 4;  // deltas added in one pass

template <class T>
inline void add_rows(const float* source, const T* const* rows, const float* weights, int n, float* out, int count) {
  switch (n) {
    case 0: return;
    case 1: return add_rows<1>(source, rows, weights, out, count);
    case 2: return add_rows<2>(source, rows, weights, out, count);
    case 3: return add_rows<3>(source, rows, weights, out, count);
    default: add_rows<kRows>(source, rows, weights, out, count);
  }
}

template <class T>
void blend_typed(const float* base, const T* deltas, const float* psi, int k, int64_t p, float* out, int threads) {
  parallel_for(threads, static_cast<int>((p + kSweep - 1) / kSweep), [&](int task) {
    const int64_t begin = static_cast<int64_t>(task) * kSweep;
    const int count = static_cast<int>(p - begin < kSweep ? p - begin : kSweep);
    const float* source = base + begin;
    for (int row = 0; row < k;) {
      const T* rows[kRows];
      float weights[kRows];
      int n = 0;
      for (; row < k && n < kRows; row++)
        if (psi[row] != 0) rows[n] = deltas + row * p + begin, weights[n++] = psi[row];
      if (n == 0) continue;
      add_rows(source, rows, weights, n, out + begin, count);
      source = out + begin;
    }
    if (source != out + begin)
      memcpy(out + begin, base + begin, count * sizeof(float));
  });
}

struct AdamFactors {
  float beta1, rest1, beta2, rest2, eps, correct1, correct2;
  explicit AdamFactors(const AdamRates& r) {
    const double step = static_cast<double>(r.step);  // 1 - beta in double: 1 - 0.999f is off by 1e-5
    beta1 = static_cast<float>(r.beta1), rest1 = static_cast<float>(1 - r.beta1);
    beta2 = static_cast<float>(r.beta2), rest2 = static_cast<float>(1 - r.beta2);
    eps = static_cast<float>(r.eps);
    correct1 = static_cast<float>(r.factor / (1 - pow(r.beta1, step)));
    correct2 = static_cast<float>(1 / sqrt(1 - pow(r.beta2, step)));
  }
};

// One step on `count` parameters with gradient weight g.
inline void adam_range(const AdamFactors& f, float weight, const float* g, const float* rate, float* p, float* m,
                       float* v, int count) {
  const F b1(f.beta1), n1(f.rest1), b2(f.beta2), n2(f.rest2), c1(f.correct1), c2(f.correct2), eps(f.eps);
  const F w(weight);
  int i = 0;
  for (; i + kWidth <= count; i += kWidth) {
    const F gradient = w * load_unaligned(g + i);
    const F first = fma(b1, load_unaligned(m + i), n1 * gradient);
    const F second = fma(b2, load_unaligned(v + i), n2 * gradient * gradient);
    store_unaligned(m + i, first), store_unaligned(v + i, second);
    const F step = load_unaligned(rate + i) * c1 * first / fma(vsqrt(second), c2, eps);
    store_unaligned(p + i, load_unaligned(p + i) - step);
  }
  for (; i < count; i++) {
    const float gradient = weight * g[i];
    m[i] = f.beta1 * m[i] + f.rest1 * gradient;
    v[i] = f.beta2 * v[i] + f.rest2 * gradient * gradient;
    p[i] -= rate[i] * f.correct1 * m[i] / (sqrtf(v[i]) * f.correct2 + f.eps);
  }
}

inline bool any_live(const float* scale, int g0, int g1) {
  bool live = false;
  for (int g = g0; g < g1; g++) live |= scale[g] != 0;
  return live;
}

// out = the learning rates of n Gaussians, Width each, times their scales.
template <int Width>
inline void scaled_rates(const float* rates, const float* scale, int n, float* out) {
  for (int g = 0; g < n; g++)
    for (int j = 0; j < Width; j++) out[g * Width + j] = scale[g] * rates[g * Width + j];
}

inline void scaled_rates(const float* rates, const float* scale, int n, int width, float* out) {
  switch (width) {  // known widths become vector code
    case 1: return scaled_rates<1>(rates, scale, n, out);
    case 3: return scaled_rates<3>(rates, scale, n, out);
    case 4: return scaled_rates<4>(rates, scale, n, out);
    case 12: return scaled_rates<12>(rates, scale, n, out);
    case 27: return scaled_rates<27>(rates, scale, n, out);
    case 48: return scaled_rates<48>(rates, scale, n, out);
    default:
      for (int g = 0; g < n; g++)
        for (int j = 0; j < width; j++) *out++ = scale[g] * *rates++;
  }
}

// Whether any frame of the step shows row k.
inline bool active(const BlendState& s, int k) {
  for (int b = 0; b < s.frames; b++)
    if (s.psi[static_cast<int64_t>(b) * s.k + k] != 0) return true;
  return false;
}

// out = the gradient of row k, parameters [begin, begin + count): those of the frames, weighed by their psi_k.
inline void sum_frames(const BlendState& s, int k, int64_t begin, int count, float* out) {
  int i = 0;
  for (; i + kWidth <= count; i += kWidth) {
    F sum(0.f);
    for (int b = 0; b < s.frames; b++)
      sum = fma(F(s.psi[static_cast<int64_t>(b) * s.k + k]), load_unaligned(s.gradient + b * s.p + begin + i), sum);
    store_unaligned(out + i, sum);
  }
  for (; i < count; i++) {
    out[i] = 0;
    for (int b = 0; b < s.frames; b++)
      out[i] = __builtin_fmaf(s.psi[static_cast<int64_t>(b) * s.k + k], s.gradient[b * s.p + begin + i], out[i]);
  }
}

// Parameters [begin, begin + count) of row k, with their learning rates.
inline void adam_row(const BlendState& s, const AdamFactors& f, int k, int64_t begin, int count, const float* rates) {
  float sum[kAdamChunk];
  const float* gradient = s.gradient + begin;
  float weight = s.psi[k];
  if (s.frames > 1) sum_frames(s, k, begin, count, sum), gradient = sum, weight = 1;
  const int64_t at = k * s.p + begin;
  adam_range(f, weight, gradient, rates, s.deltas + at, s.first_moment + at, s.second_moment + at, count);
}

// Row k of Gaussians [g0, g1), a task of a group, without the blocks of which the row moves none.
inline void scaled_adam(const BlendState& s, const AdamFactors& f, int64_t offset, int width, int k, int g0, int g1) {
  float rates[kAdamChunk];
  const float* scale = s.scale + static_cast<int64_t>(k) * s.n;
  for (int g = g0; g < g1;) {
    const int first = g;
    while (g < g1 && any_live(scale, g, imin(g1, g + kLiveBlock))) g = imin(g1, g + kLiveBlock);
    if (g == first) {
      g = imin(g1, g + kLiveBlock);
      continue;
    }
    const int64_t begin = offset + static_cast<int64_t>(first) * width;
    scaled_rates(s.learning_rates + begin, scale + first, g - first, width, rates);
    adam_row(s, f, k, begin, (g - first) * width, rates);
  }
}

// Task `task` of group `width` wide, starting at parameter `offset`: some Gaussians, all rows.
void blend_adam_task(const BlendState& s, const AdamFactors& f, int64_t offset, int width, int task, int per_task) {
  const int g0 = task * per_task, g1 = imin(s.n, g0 + per_task), count = (g1 - g0) * width;
  const int64_t begin = offset + static_cast<int64_t>(g0) * width;
  for (int k = 0; k < s.k; k++) {
    if (s.skip_inactive && !active(s, k)) continue;
    if (s.scale == nullptr)
      adam_row(s, f, k, begin, count, s.learning_rates + begin);
    else
      scaled_adam(s, f, offset, width, k, g0, g1);
  }
}

}  // namespace

void blend(const float* base, const void* deltas, bool bf16, const float* psi, int k, int64_t p, float* out,
           int threads) {
  if (bf16)
    blend_typed(base, static_cast<const uint16_t*>(deltas), psi, k, p, out, threads);
  else
    blend_typed(base, static_cast<const float*>(deltas), psi, k, p, out, threads);
}

// Every sweep's deltas come from memory for the first frame and from the cache for the others.
void add_blends(const float* deltas, const float* psi, int frames, int k, int64_t p, float* out, int64_t stride,
                int threads) {
  parallel_for(threads, static_cast<int>((p + kFrameSweep - 1) / kFrameSweep), [&](int task) {
    const int64_t begin = static_cast<int64_t>(task) * kFrameSweep;
    const int count = static_cast<int>(p - begin < kFrameSweep ? p - begin : kFrameSweep);
    for (int row = 0; row < k; row += kRows)
      for (int b = 0; b < frames; b++) {
        const float* rows[kRows];
        float weights[kRows];
        int n = 0;
        for (int r = row; r < imin(k, row + kRows); r++) {
          const float weight = psi[static_cast<int64_t>(b) * k + r];
          if (weight != 0) rows[n] = deltas + r * p + begin, weights[n++] = weight;
        }
        float* sums = out + b * stride + begin;
        add_rows(sums, rows, weights, n, sums, count);
      }
  });
}

void adam(float* parameters, float* first, float* second, const float* gradient, const float* rates, int64_t p,
          const AdamRates& adam_rates, int threads) {
  const AdamFactors factors(adam_rates);
  parallel_for(threads, static_cast<int>((p + kAdamChunk - 1) / kAdamChunk), [&](int task) {
    const int64_t at = static_cast<int64_t>(task) * kAdamChunk;
    const int count = static_cast<int>(p - at < kAdamChunk ? p - at : kAdamChunk);
    adam_range(factors, 1.f, gradient + at, rates + at, parameters + at, first + at, second + at, count);
  });
}

void blend_adam(const BlendState& state, const AdamRates& adam_rates, int threads) {
  const AdamFactors factors(adam_rates);
  int64_t offset = 0;
  for (int group = 0; group < state.groups; group++) {
    const int width = state.widths[group], per_task = kAdamChunk / width;
    parallel_for(threads, (state.n + per_task - 1) / per_task,
                 [&](int task) { blend_adam_task(state, factors, offset, width, task, per_task); });
    offset += static_cast<int64_t>(width) * state.n;
  }
}

}  // namespace TGB_ISA
}  // namespace tgb
