// One step of Adam (Kingma & Ba 2015) over a few arrays.

#include <algorithm>
#include <cmath>

#include "abi.hpp"
#include "threads.hpp"

namespace {

constexpr int64_t kRun = 1 << 14;   // elements of one task
constexpr int64_t kTasksEach = 12;  // of a thread, at least: starting one takes as long as a few tasks

void step(float* __restrict parameter, const float* __restrict gradient, float* __restrict first,
          float* __restrict second, int64_t n, float factor, float epsilon) {
  for (int64_t i = 0; i < n; ++i) {
    const float g = gradient[i], m = first[i] + 0.1f * (g - first[i]), v = second[i] + 0.001f * (g * g - second[i]);
    first[i] = m;
    second[i] = v;
    parameter[i] -= factor * m / (std::sqrt(v) + epsilon);
  }
}

}  // namespace

int64_t holosplat_adam(const HoloAdam* adam, const float* factors, int64_t threads) {
  return holo::guarded([&] {
    int64_t tasks = 0;
    for (int64_t k = 0; k < adam->count; ++k) tasks += (adam->lengths[k] + kRun - 1) / kRun;
    holo::parallel(tasks, std::min(threads, tasks / kTasksEach + 1), [&](int64_t task) {
      int64_t k = 0, runs = 0;
      while (task >= (runs = (adam->lengths[k] + kRun - 1) / kRun)) task -= runs, ++k;
      const int64_t at = task * kRun, n = std::min(kRun, adam->lengths[k] - at);
      step(adam->parameters[k] + at, adam->gradients[k] + at, adam->first[k] + at, adam->second[k] + at, n, factors[k],
           factors[adam->count]);
    });
  });
}
