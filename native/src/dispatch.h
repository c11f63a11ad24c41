// Choice of the instruction set at run time.
#pragma once
#include "playback.h"
#include "raster.h"
#include "training.h"

namespace tgb {

struct Kernels {
  const char* name;
  void (*project_forward)(Frame&, const Scene&, int32_t* radii);
  void (*project_playback)(Frame&, const Scene&, const Playback&, const float* psi, const float* transforms);
  void (*composite_forward)(Frame&, const Scene&, float* color, float* alpha, bool keep);
  void (*composite_backward)(Frame&, const Scene&, const Gradients&);
  void (*project_backward)(Frame&, const Scene&, const Gradients&);
  void (*blend)(const float* base, const void* deltas, bool bf16, const float* psi, int k, int64_t p, float* out,
                int threads);
  void (*add_blends)(const float* deltas, const float* psi, int frames, int k, int64_t p, float* out, int64_t stride,
                     int threads);
  void (*adam)(float* parameters, float* first, float* second, const float* gradient, const float* rates, int64_t p,
               const AdamRates& adam_rates, int threads);
  void (*blend_adam)(const BlendState& state, const AdamRates& adam_rates, int threads);
  double (*l1_dssim)(const float* image, const float* target, int height, int width, float l1_weight,
                     float dssim_weight, float* gradient, SimilarityWork& work, int threads);
  void (*skin)(const Skin& input, const SkinOutput& output, int threads);
  void (*skin_backward)(const Skin& input, const SkinOutput& upstream, const SkinGradient& gradient, int threads);
  void (*place)(const Picture& picture, int factor, float* color, float* matte, int threads);
  double (*measure_flops)();
};

// The kernels of the best instruction set this machine has, or of the one set_isa chose.
const Kernels& kernels();

}  // namespace tgb
