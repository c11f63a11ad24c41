#include "dispatch.h"

#include <cstring>

#include "export.h"

namespace tgb {

extern const Kernels kernels_generic;
#if defined(TGB_X86_DISPATCH)
extern const Kernels kernels_avx2, kernels_avx512;
#endif

namespace {

// Kernels of the instruction set `name`; null where the library or the machine lacks it.
const Kernels* find(const char* name) {
#if defined(TGB_X86_DISPATCH)
  __builtin_cpu_init();
  if (strcmp(name, "avx512") == 0 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl"))
    return &kernels_avx512;
  if (strcmp(name, "avx2") == 0 && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
    return &kernels_avx2;
#endif
  return strcmp(name, "generic") == 0 ? &kernels_generic : nullptr;
}

const Kernels* best() {
  if (const Kernels* found = find("avx512")) return found;
  if (const Kernels* found = find("avx2")) return found;
  return &kernels_generic;
}

const Kernels* chosen = nullptr;

}  // namespace

const Kernels& kernels() {
  if (chosen == nullptr) chosen = best();
  return *chosen;
}

}  // namespace tgb

TGB_API const char* tgb_isa() { return tgb::kernels().name; }

// Makes `name` the instruction set of all later calls; returns 0 and changes nothing where it is not available.
TGB_API int tgb_set_isa(const char* name) {
  const tgb::Kernels* found = tgb::find(name);
  if (found != nullptr) tgb::chosen = found;
  return found != nullptr;
}

// Busies one core with fused multiply-adds; returns their number of floating-point operations.
TGB_API double tgb_measure_flops() { return tgb::kernels().measure_flops(); }
