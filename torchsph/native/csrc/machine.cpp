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

// Chains of x <- x a + b in registers; the caller takes the time. Returns the additions and multiplications done.
extern "C" double sph_fma(int threads, int64_t turns, float factor) {
  using L = sph::Lanes<float>;
  constexpr int chains = 12;  // independent, so that the latency is hidden
  double sink = 0;
#pragma omp parallel num_threads(threads) reduction(+ : sink)
  {
    const L::Vector a = L::all(factor), b = L::all(0.001f);
    L::Vector x[chains];
    for (int c = 0; c < chains; ++c) x[c] = L::all(0.1f * float(c));
    for (int64_t t = 0; t < turns; ++t)
      for (int c = 0; c < chains; ++c) x[c] = x[c] * a + b;
    for (int c = 0; c < chains; ++c) sink += double(x[c][0]);
  }
  return sink == 12345.0 ? 0.0 : 2.0 * double(turns) * chains * L::count * threads;  // sink keeps the loop alive
}
