// The version of the interface, and what this machine can run. Compiled for the baseline instruction set too, so that
// a loader may always ask.

#include "abi.hpp"

int64_t holosplat_abi() { return 11; }

int64_t holosplat_best_isa() {
#if defined(__x86_64__) || defined(_M_X64)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
      __builtin_cpu_supports("avx512bw"))
    return 2;
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return 1;
#endif
  return 0;
}
