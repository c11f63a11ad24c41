// Data of the training kernels shared by their instruction sets and the C interface.
#pragma once
#include <cstddef>
#include <cstdint>

#include "buffer.h"

namespace tgb {

// Mirrored field by field in src/toonifygb/render/library.py.
struct AdamRates {
  double beta1, beta2, eps, factor;  // factor: of all learning rates
  int64_t step;  // counts from 1
};

// Deltas [k, p], row by row, and what a step of Adam needs of them.
struct BlendState {
  float *deltas, *first_moment, *second_moment;
  const float *psi, *gradient, *learning_rates;  // [frames, k], [frames, p], [p]
  const float* scale;                            // [k, n] factor of the step per row and Gaussian, or null
  const int32_t* widths;                         // floats per Gaussian of each parameter group; sum x n = p
  int64_t p;
  int32_t k, n, groups, skip_inactive, frames;
};

constexpr int kJoints = 5;

// Raw Gaussians and their binding to the joints.
struct Skin {
  const float *means, *quats, *log_scales, *opacity_logits;
  const float *weights, *transforms;  // [n, kJoints]; [kJoints, 4, 4], rest to pose
  int32_t n;
};
struct SkinOutput {  // splats, or d loss / d splats (then sh_frames is not used)
  float *means, *quats, *scales, *opacities, *sh_frames;
};
struct SkinGradient {
  float *means, *quats, *log_scales, *opacity_logits;
};

// A frame of sRGB bytes [height, width, 3], its matte [height, width] 0..1, and what goes behind it.
struct Picture {
  const uint8_t* frame;
  const float *matte, *background;  // background [3]
  int32_t height, width;
};

// Kept between calls.
struct SimilarityWork {
  Buffer<float> derivatives, bands;
  Buffer<double> row_sums;
};

}  // namespace tgb
