// Whether this processor runs a library that was compiled for an instruction set of toolchain.py.
#pragma once
#include <cstring>

inline int processor_runs(const char* instruction_set) {
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
