// The picture that a rendering is compared with: a frame of bytes, cut out by its matte, on a background.
#include "buffer.h"
#include "kernels.h"

namespace tgb {
namespace TGB_ISA {
namespace {

// sums[i] += G[i] m[i] + background[i] (1 - m[i]) over the 3 width floats of one row, and matte_sums[x] += m[x].
void add_row(const Picture& in, int y, const float* background, float* spread, float* sums, float* matte_sums) {
  const uint8_t* frame = in.frame + static_cast<size_t>(y) * in.width * 3;
  const float* matte = in.matte + static_cast<size_t>(y) * in.width;
  for (int x = 0; x < in.width; x++) matte_sums[x] += matte[x];
  for (int x = 0; x < in.width; x++) spread[3 * x] = spread[3 * x + 1] = spread[3 * x + 2] = matte[x];
  for (int i = 0; i < 3 * in.width; i++)
    sums[i] += static_cast<float>(frame[i]) * (1.f / 255) * spread[i] + background[i] * (1 - spread[i]);
}

// Means of `factor` neighbours along a row, of `channels` floats each; `scale` is one over all pixels of a square.
void pool_row(const float* sums, int out_width, int channels, int factor, float scale, float* out) {
  if (factor == 1) {
    memcpy(out, sums, sizeof(float) * out_width * channels);
    return;
  }
  for (int x = 0; x < out_width; x++)
    for (int c = 0; c < channels; c++) {
      float sum = 0;
      for (int i = 0; i < factor; i++) sum += sums[(x * factor + i) * channels + c];
      out[x * channels + c] = sum * scale;
    }
}

}  // namespace

void place(const Picture& in, int factor, float* color, float* matte, int threads) {
  const int width = in.width / factor, height = in.height / factor;
  const float scale = 1.f / static_cast<float>(factor * factor);
  parallel_for(threads, imax(1, imin(threads, height)), [&](int part) {
    const int parts = imax(1, imin(threads, height));
    Buffer<float> rows;
    float *background = rows.need(static_cast<size_t>(10) * in.width), *spread = background + 3 * in.width, *sums = spread + 3 * in.width;
    float* matte_sums = sums + 3 * in.width;
    for (int x = 0; x < in.width; x++) memcpy(background + 3 * x, in.background, 3 * sizeof(float));
    const auto first = [&](int p) { return static_cast<int>(static_cast<int64_t>(height) * p / parts); };
    for (int y = first(part); y < first(part + 1); y++) {
      memset(sums, 0, sizeof(float) * 4 * in.width);
      for (int i = 0; i < factor; i++) add_row(in, y * factor + i, background, spread, sums, matte_sums);
      pool_row(sums, width, 3, factor, scale, color + static_cast<size_t>(y) * width * 3);
      pool_row(matte_sums, width, 1, factor, scale, matte + static_cast<size_t>(y) * width);
    }
  });
}

}  // namespace TGB_ISA
}  // namespace tgb
