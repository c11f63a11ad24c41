// The functions that exist once per instruction set, and the table by which the library calls them.
#pragma once
#include "dispatch.h"
#include "pool.h"
#include "raster.h"
#include "simd.h"

namespace tgb {
namespace TGB_ISA {

void project_forward(Frame& frame, const Scene& scene, int32_t* radii);
void composite_forward(Frame& frame, const Scene& scene, float* color, float* alpha);
void composite_backward(Frame& frame, const Scene& scene, const Gradients& gradients);
void project_backward(Frame& frame, const Scene& scene, const Gradients& gradients);

}  // namespace TGB_ISA
}  // namespace tgb
