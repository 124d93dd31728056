// What this processor can do: its instruction sets, and the rate at which it multiplies and adds.
#include <omp.h>

#include <cstring>

#include "interface.h"
#include "lanes.hpp"

extern "C" int sph_runs(const char* instruction_set) {
  if (!std::strcmp(instruction_set, "baseline")) return 1;
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (!std::strcmp(instruction_set, "avx2")) return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (!std::strcmp(instruction_set, "avx512"))
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
           __builtin_cpu_supports("avx512bw");
#endif
  return 0;
}

extern "C" double sph_fma_peak(int threads, int64_t turns) {
  using L = sph::Lanes<float>;
  constexpr int chains = 12;  // independent, so that the latency is hidden
  double sink = 0;
  const double begin = omp_get_wtime();
#pragma omp parallel num_threads(threads) reduction(+ : sink)
  {
    L::Vector sum[chains];
    for (int c = 0; c < chains; ++c) sum[c] = L::all(0.1f * float(c));
    L::Vector factor = L::all(0.999f), term = L::all(0.001f);
    for (int64_t t = 0; t < turns; ++t) {
      for (int c = 0; c < chains; ++c) {
        sum[c] = sum[c] * factor + term;
        asm volatile("" : "+m"(sum[c]) : : );
      }
    }
    for (int c = 0; c < chains; ++c) sink += double(sum[c][0]);
  }
  const double seconds = omp_get_wtime() - begin;
  return sink == 12345.0 ? 0.0 : double(turns) * chains * L::count * 2 * threads / seconds;
}
