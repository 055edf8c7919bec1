// The two passes over the voxels of a primal-dual iteration with total variation (Chambolle & Pock 2011).
// Fused, because the iteration is bound by memory: each array is read once and written once a pass.

#include <algorithm>
#include <cmath>

#include "abi.hpp"
#include "simd.hpp"
#include "threads.hpp"

namespace {

// By value: of the references of std::max, and of rows that might overlap, compilers make no vectors.
HOLO_INLINE float larger(float a, float b) { return a < b ? b : a; }

// One voxel of the gradient's dual variable: q += step * forward difference, then onto the ball of `radius`.
HOLO_INLINE void ascend(float* q0, float* q1, float* q2, float down, float side, float along, float step,
                        float radius) {
  const float a = *q0 + step * down, b = *q1 + step * side, c = *q2 + step * along;
  // The tiny number keeps 0 / 0 away where there is no total variation at all.
  const float scale = radius / larger(larger(std::sqrt(a * a + b * b + c * c), radius), 1e-30f);
  *q0 = a * scale;
  *q1 = b * scale;
  *q2 = c * scale;
}

// One row. `down` and `side` are the neighbouring rows along the two slower axes, null at the border (difference 0).
void ascend_row(int64_t n, const float* __restrict u, const float* __restrict down, const float* __restrict side,
                float* __restrict q0, float* __restrict q1, float* __restrict q2, float step, float radius) {
  if (!down) down = u;
  if (!side) side = u;
  const int64_t last = n - 1;
  for (int64_t i = 0; i < last; ++i)
    ascend(q0 + i, q1 + i, q2 + i, down[i] - u[i], side[i] - u[i], u[i + 1] - u[i], step, radius);
  ascend(q0 + last, q1 + last, q2 + last, down[last] - u[last], side[last] - u[last], 0.0f, step, radius);
}

struct Step {
  float coupling, lower, upper;
};

// One row of the primal variable: u - tau (slope + coupling * adjoint gradient of q), clamped to [lower, upper],
// and its extrapolation 2 new - old. `above` and `before` are the neighbouring rows of q0 and q1, null at the border.
template <bool kAbove, bool kBefore>
void descend_row(int64_t n, const float* __restrict slope, const float* __restrict tau, const float* __restrict q0,
                 const float* __restrict above, const float* __restrict q1, const float* __restrict before,
                 const float* __restrict q2, Step step, float* __restrict u, float* __restrict extrapolated) {
  const auto descend = [=](int64_t i, float last) {
    const float inflow = (kAbove ? above[i] : 0.0f) + (kBefore ? before[i] : 0.0f) + last;
    const float divergence = inflow - q0[i] - q1[i] - q2[i];
    const float moved = u[i] - tau[i] * (slope[i] + step.coupling * divergence);
    const float fresh = -larger(-larger(moved, step.lower), -step.upper);
    extrapolated[i] = 2 * fresh - u[i];
    u[i] = fresh;
  };
  descend(0, 0.0f);
  for (int64_t i = 1; i < n; ++i) descend(i, q2[i - 1]);
}

}  // namespace

int64_t holosplat_tv_ascend(const HoloGrid* grid, const float* u, float* q, double step, double radius,
                            int64_t threads) {
  return holo::guarded([&] {
    const int64_t ny = grid->height, nx = grid->width, plane = ny * nx, all = grid->depth * plane;
    holo::parallel(grid->depth, threads, [&](int64_t z) {
      for (int64_t y = 0; y < ny; ++y) {
        const int64_t at = z * plane + y * nx;
        ascend_row(nx, u + at, z + 1 < grid->depth ? u + at + plane : nullptr, y + 1 < ny ? u + at + nx : nullptr,
                   q + at, q + all + at, q + 2 * all + at, static_cast<float>(step), static_cast<float>(radius));
      }
    });
  });
}

int64_t holosplat_tv_descend(const HoloGrid* grid, const float* slope, const float* tau, const float* q,
                             double coupling, double lower, double upper, float* u, float* extrapolated, int64_t threads) {
  return holo::guarded([&] {
    const int64_t ny = grid->height, nx = grid->width, plane = ny * nx, all = grid->depth * plane;
    const Step step{static_cast<float>(coupling), static_cast<float>(lower), static_cast<float>(upper)};
    holo::parallel(grid->depth, threads, [&](int64_t z) {
      for (int64_t y = 0; y < ny; ++y) {
        const int64_t at = z * plane + y * nx;
        const auto row = z > 0 ? (y > 0 ? descend_row<true, true> : descend_row<true, false>)
                               : (y > 0 ? descend_row<false, true> : descend_row<false, false>);
        row(nx, slope + at, tau + at, q + at, z > 0 ? q + at - plane : nullptr, q + all + at,
            y > 0 ? q + all + at - nx : nullptr, q + 2 * all + at, step, u + at, extrapolated + at);
      }
    });
  });
}
