// L1 + D-SSIM, value and gradient in two passes over the image.
//
// Pass 1 blurs a, b, a^2 + b^2, ab and turns them into SSIM and its derivatives with respect to the blurred a, a^2, ab;
// pass 2 blurs those (the window is symmetric, so the blur is its own adjoint) and collects the gradient with
// respect to a. Rows are interleaved RGB: a horizontal tap is 3 floats. Blurs are separable and kept in a ring of 11
// horizontally filtered rows. Every row's sums are stored and added in row order.
#include "kernels.h"

namespace tgb {
namespace TGB_ISA {
namespace {

constexpr int kTaps = 11, kHalf = 5, kPad = 16;  // padding >= 3 kHalf, one full vector
constexpr float kSsimC1 = 0.01f * 0.01f, kSsimC2 = 0.03f * 0.03f;

struct Window {
  float weight[kHalf + 1];  // centre first
  Window() {
    float sum = 0;
    for (int i = -kHalf; i <= kHalf; i++) sum += expf(-i * i / (2 * 1.5f * 1.5f));
    for (int i = 0; i <= kHalf; i++) weight[i] = expf(-i * i / (2 * 1.5f * 1.5f)) / sum;
  }
};

inline int padded(int n) { return (n + 15) / 16 * 16; }

inline void filter_row(const Window& w, const float* in, float* out, int n) {
  for (int i = 0; i < n; i += kWidth) {
    F sum = F(w.weight[0]) * load_unaligned(in + i);
    for (int t = 1; t <= kHalf; t++)
      sum = fma(F(w.weight[t]), load_unaligned(in + i - 3 * t) + load_unaligned(in + i + 3 * t), sum);
    store_unaligned(out + i, sum);
  }
}

// The `Maps` images of one band, blurred row by row. `fill(y, rows)` writes the unfiltered rows of line y;
// `use(y, rows)` gets the blurred ones. All rows are `padded` long.
template <int Maps>
struct Blur {
  const Window& window;
  float* memory;  // Blur::floats(width)
  int width, height;

  static size_t floats(int width) {
    const size_t n = padded(width);
    return Maps * kTaps * n + Maps * (n + 2 * kPad) + Maps * n;
  }

  template <class Fill, class Use>
  void run(int begin, int end, const Fill& fill, const Use& use) {
    const int n = padded(width);
    float *ring = memory, *in = ring + static_cast<size_t>(Maps) * kTaps * n, *out = in + Maps * (n + 2 * kPad);
    float *in_rows[Maps], *out_rows[Maps];
    for (int m = 0; m < Maps; m++) in_rows[m] = in + m * (n + 2 * kPad) + kPad, out_rows[m] = out + m * n;
    memset(in, 0, sizeof(float) * Maps * (n + 2 * kPad));
    const auto ring_row = [&](int m, int y) {
      return ring + (static_cast<size_t>(m) * kTaps + (y + kTaps) % kTaps) * n;
    };
    for (int y = begin - kHalf; y < end + kHalf; y++) {
      const bool inside = y >= 0 && y < height;
      if (inside) fill(y, in_rows);
      for (int m = 0; m < Maps; m++) {
        if (inside)
          filter_row(window, in_rows[m], ring_row(m, y), n);
        else
          memset(ring_row(m, y), 0, sizeof(float) * n);
      }
      const int centre = y - kHalf;
      if (centre < begin) continue;
      for (int m = 0; m < Maps; m++) {
        const float* row[kTaps];
        for (int t = 0; t < kTaps; t++) row[t] = ring_row(m, centre - kHalf + t);
        for (int i = 0; i < n; i += kWidth) {
          F sum = F(window.weight[0]) * load_unaligned(row[kHalf] + i);
          for (int t = 1; t <= kHalf; t++)
            sum = fma(F(window.weight[t]), load_unaligned(row[kHalf - t] + i) + load_unaligned(row[kHalf + t] + i), sum);
          store_unaligned(out_rows[m] + i, sum);
        }
      }
      use(centre, out_rows);
    }
  }
};

// Lane by lane first: one long chain of additions would take as long as a blur.
inline double row_sum(const float* row, int n) {
  F lanes(0.f);
  int i = 0;
  for (; i + kWidth <= n; i += kWidth) lanes = lanes + load_unaligned(row + i);
  float parts[kWidth];
  store_unaligned(parts, lanes);
  double sum = 0;
  for (int lane = 0; lane < kWidth; lane++) sum += parts[lane];
  for (; i < n; i++) sum += row[i];
  return sum;
}

// SSIM of a row from its blurred maps (a, b, a^2 + b^2, ab), and derivatives by the blurred a, a^2 and ab.
inline void ssim_row(float* const* blurred, float* ssim, float* by_a, float* by_aa, float* by_ab, int n) {
  const F c1(kSsimC1), c2(kSsimC2), two(2.f);
  for (int i = 0; i < n; i += kWidth) {
    const F ma = load_unaligned(blurred[0] + i), mb = load_unaligned(blurred[1] + i), product = ma * mb;
    const F squares = fma(ma, ma, mb * mb), both_squares = load_unaligned(blurred[2] + i);
    const F A1 = fma(two, product, c1), A2 = fma(two, load_unaligned(blurred[3] + i) - product, c2);
    const F B1 = squares + c1, B2 = both_squares - squares + c2;
    const F inverse = F(1.f) / (B1 * B2), value = A1 * A2 * inverse, ratio = value * inverse;
    store_unaligned(ssim + i, value);
    store_unaligned(by_a + i, two * (mb * (A2 - A1) * inverse - ma * ratio * (B2 - B1)));
    store_unaligned(by_aa + i, -(ratio * B1));
    store_unaligned(by_ab + i, two * A1 * inverse);
  }
}

}  // namespace

double l1_dssim(const float* image, const float* target, int height, int width, float l1_weight, float dssim_weight,
                float* gradient, SimilarityWork& work, int threads) {
  const Window window;
  const int row = 3 * width, n = padded(row), bands = imax(1, imin(threads, height / 8));
  const size_t plane = static_cast<size_t>(height) * n, per_band = Blur<4>::floats(row) + 4 * static_cast<size_t>(n);
  float* derivatives = work.derivatives.need(3 * plane);
  float* memory = work.bands.need(bands * per_band);
  double* sums = work.row_sums.need(2 * static_cast<size_t>(height));
  const float inverse = 1.f / (static_cast<float>(height) * row);
  const auto first_row = [&](int band) { return static_cast<int>(static_cast<int64_t>(height) * band / bands); };
  const size_t bytes = sizeof(float) * row;

  parallel_for(threads, bands, [&](int band) {
    Blur<4> blur{window, memory + band * per_band, row, height};
    float* ssim = memory + band * per_band + Blur<4>::floats(row);
    const auto fill = [&](int y, float* const* out) {
      const size_t at = static_cast<size_t>(y) * row;
      memcpy(out[0], image + at, bytes), memcpy(out[1], target + at, bytes);
      for (int i = 0; i < n; i += kWidth) {
        const F a = load_unaligned(out[0] + i), b = load_unaligned(out[1] + i);
        store_unaligned(out[2] + i, fma(a, a, b * b)), store_unaligned(out[3] + i, a * b);
      }
    };
    const auto use = [&](int y, float* const* blurred) {
      float* by_a = derivatives + static_cast<size_t>(y) * n;
      ssim_row(blurred, ssim, by_a, by_a + plane, by_a + 2 * plane, n);
      sums[y] = row_sum(ssim, row);
    };
    blur.run(first_row(band), first_row(band + 1), fill, use);
  });

  const F l1_step(l1_weight * inverse), ssim_step(-dssim_weight * inverse), two(2.f), zero(0.f);
  parallel_for(threads, bands, [&](int band) {
    Blur<3> blur{window, memory + band * per_band, row, height};
    float* scratch = memory + band * per_band + Blur<4>::floats(row);
    float *a = scratch, *b = scratch + n, *distance = scratch + 2 * n, *out = scratch + 3 * n;
    const auto fill = [&](int y, float* const* rows) {  // beyond the row's end the padding must stay zero
      for (int m = 0; m < 3; m++) memcpy(rows[m], derivatives + m * plane + static_cast<size_t>(y) * n, bytes);
    };
    const auto use = [&](int y, float* const* blurred) {
      const size_t at = static_cast<size_t>(y) * row;
      memcpy(a, image + at, bytes), memcpy(b, target + at, bytes);
      for (int i = 0; i < n; i += kWidth) {
        const F x = load_unaligned(a + i), t = load_unaligned(b + i), d = x - t;
        store_unaligned(distance + i, vmax(d, -d));
        const F sign = keep(gt(d, zero), l1_step) - keep(gt(zero, d), l1_step);
        const F from_squares = fma(two * x, load_unaligned(blurred[1] + i), load_unaligned(blurred[0] + i));
        const F similar = fma(t, load_unaligned(blurred[2] + i), from_squares);
        store_unaligned(out + i, fma(ssim_step, similar, sign));
      }
      memcpy(gradient + at, out, bytes);
      sums[height + y] = row_sum(distance, row);
    };
    blur.run(first_row(band), first_row(band + 1), fill, use);
  });

  double ssim = 0, l1 = 0;
  for (int y = 0; y < height; y++) ssim += sums[y], l1 += sums[height + y];
  const double count = static_cast<double>(height) * row;
  return l1_weight * l1 / count + dssim_weight * (1 - ssim / count);
}

}  // namespace TGB_ISA
}  // namespace tgb
