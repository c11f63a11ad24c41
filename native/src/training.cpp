// C interface of the training kernels; toonifygb.render.fused says what each one computes.
#include "training.h"

#include <mutex>
#include <new>

#include "dispatch.h"
#include "export.h"

TGB_API void tgb_blend(const float* base, const void* deltas, int32_t bf16, const float* psi, int32_t k, int64_t p,
                       float* out, int32_t threads) {
  tgb::kernels().blend(base, deltas, bf16 != 0, psi, k, p, out, threads);
}

TGB_API void tgb_add_blends(const float* deltas, const float* psi, int32_t frames, int32_t k, int64_t p, float* out,
                            int64_t stride, int32_t threads) {
  tgb::kernels().add_blends(deltas, psi, frames, k, p, out, stride, threads);
}

TGB_API void tgb_adam(float* parameters, float* first, float* second, const float* gradient, const float* rates,
                      int64_t p, const tgb::AdamRates* adam_rates, int32_t threads) {
  tgb::kernels().adam(parameters, first, second, gradient, rates, p, *adam_rates, threads);
}

TGB_API void tgb_blend_adam(const tgb::BlendState* state, const tgb::AdamRates* adam_rates, int32_t threads) {
  tgb::kernels().blend_adam(*state, *adam_rates, threads);
}

TGB_API void tgb_skin(const tgb::Skin* input, const tgb::SkinOutput* output, int32_t threads) {
  tgb::kernels().skin(*input, *output, threads);
}

TGB_API void tgb_skin_backward(const tgb::Skin* input, const tgb::SkinOutput* upstream,
                               const tgb::SkinGradient* gradient, int32_t threads) {
  tgb::kernels().skin_backward(*input, *upstream, *gradient, threads);
}

// Returns 0 when out of memory.
TGB_API int tgb_place(const tgb::Picture* picture, int32_t factor, float* color, float* matte, int32_t threads) {
  try {
    tgb::kernels().place(*picture, factor, color, matte, threads);
    return 1;
  } catch (const std::bad_alloc&) {
    return 0;
  }
}

// Returns the loss, or NaN when out of memory.
TGB_API double tgb_l1_dssim(const float* image, const float* target, int32_t height, int32_t width, float l1_weight,
                            float dssim_weight, float* gradient, int32_t threads) {
  static std::mutex mutex;
  static tgb::SimilarityWork* work = new tgb::SimilarityWork;  // never freed, like the thread pool
  std::lock_guard<std::mutex> lock(mutex);
  try {
    return tgb::kernels().l1_dssim(image, target, height, width, l1_weight, dssim_weight, gradient, *work, threads);
  } catch (const std::bad_alloc&) {
    return __builtin_nan("");
  }
}
