#include "kernels.h"

namespace tgb {

#define TGB_JOIN_(a, b) a##b
#define TGB_JOIN(a, b) TGB_JOIN_(a, b)
extern const Kernels TGB_JOIN(kernels_, TGB_ISA);
const Kernels TGB_JOIN(kernels_, TGB_ISA) = {
    TGB_ISA::kIsaName,           TGB_ISA::project_forward,    TGB_ISA::project_playback,
    TGB_ISA::composite_forward,  TGB_ISA::composite_backward, TGB_ISA::project_backward,
    TGB_ISA::blend,              TGB_ISA::add_blends,         TGB_ISA::adam,
    TGB_ISA::blend_adam,         TGB_ISA::l1_dssim,           TGB_ISA::skin,
    TGB_ISA::skin_backward,      TGB_ISA::place,              TGB_ISA::measure_flops,
};

}  // namespace tgb
