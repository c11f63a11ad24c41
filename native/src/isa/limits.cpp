// The arithmetic peak of one core, for the floors in benchmarks/.
#include "kernels.h"

namespace tgb {
namespace TGB_ISA {

// Runs fused multiply-adds on registers and returns how many floating-point operations that were.
double measure_flops() {
  constexpr int kChains = 10, kRounds = 2'000'000;  // 2 units x 4 cycles latency need 8 independent chains
  F x[kChains];
  for (int i = 0; i < kChains; i++) x[i] = F(1.f + 0.001f * static_cast<float>(i));
  const F a(0.999999f), b(1e-7f);
  for (int round = 0; round < kRounds; round++)
    for (F& chain : x) chain = fma(chain, a, b);
  F sum(0.f);
  for (const F& chain : x) sum += chain;
  volatile float keep_result = 0;
  float lanes[4];
  sum4(lanes, sum, sum, sum, sum);
  keep_result = lanes[0];
  (void)keep_result;
  return 2.0 * kWidth * kChains * kRounds;
}

}  // namespace TGB_ISA
}  // namespace tgb
