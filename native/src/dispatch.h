// Choice of the instruction set at run time.
#pragma once
#include "raster.h"

namespace tgb {

struct Kernels {
  const char* name;
  void (*project_forward)(Frame&, const Scene&, int32_t* radii);
  void (*composite_forward)(Frame&, const Scene&, float* color, float* alpha);
  void (*composite_backward)(Frame&, const Scene&, const Gradients&);
  void (*project_backward)(Frame&, const Scene&, const Gradients&);
};

// The kernels of the best instruction set this machine has, or of the one set_isa chose.
const Kernels& kernels();

}  // namespace tgb
