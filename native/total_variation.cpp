// Smoothed isotropic total variation of a volume, and its gradient, in one pass.

#include <algorithm>
#include <cmath>
#include <vector>

#include "abi.hpp"
#include "threads.hpp"

namespace {

struct Rows {        // a row of voxels and its neighbours; null beyond the border
  const float *here, *below, *side;
};

// 1 / sqrt(|forward difference|^2 + s^2) of every voxel of a row that has all three neighbours, 0 of the others.
// Returns the sum of sqrt(...) - s.
double inverse_norms(const Rows& r, int64_t n, float smoothing, float* inverse) {
  if (!r.below || !r.side) {
    for (int64_t i = 0; i < n; ++i) inverse[i] = 0.0f;
    return 0.0;
  }
  const float square = smoothing * smoothing;
  double sum = 0.0;
  for (int64_t start = 0; start + 1 < n; start += 256) {
    const int64_t stop = std::min(n - 1, start + 256);
    float part = 0.0f;
    for (int64_t i = start; i < stop; ++i) {
      const float u = r.here[i], a = r.below[i] - u, b = r.side[i] - u, c = r.here[i + 1] - u;
      const float norm = std::sqrt(a * a + b * b + c * c + square);
      inverse[i] = 1.0f / norm;
      part += norm - smoothing;
    }
    sum += part;
  }
  inverse[n - 1] = 0.0f;
  return sum;
}

// Gradient of a row: what its own differences give, and those of its three predecessors.
// `w`, `w_above`, `w_before`: inverse norms of this row and of the preceding rows along z and y (null at the border).
void gradient_row(const Rows& r, const float* above, const float* before, const float* w, const float* w_above,
                  const float* w_before, int64_t n, float* gradient) {
  for (int64_t i = 0; i < n; ++i) gradient[i] = 0.0f;
  if (r.below && r.side)
    for (int64_t i = 0; i + 1 < n; ++i)
      gradient[i] -= w[i] * (r.below[i] + r.side[i] + r.here[i + 1] - 3 * r.here[i]);
  if (above)
    for (int64_t i = 0; i < n; ++i) gradient[i] += w_above[i] * (r.here[i] - above[i]);
  if (before)
    for (int64_t i = 0; i < n; ++i) gradient[i] += w_before[i] * (r.here[i] - before[i]);
  for (int64_t i = 1; i < n; ++i) gradient[i] += w[i - 1] * (r.here[i] - r.here[i - 1]);
}

}  // namespace

int64_t holosplat_tv_smooth(const HoloGrid* grid, const float* u, double smoothing, float* gradient, double* value,
                            int64_t threads) {
  return holo::guarded([&] {
    const int64_t nz = grid->depth, ny = grid->height, nx = grid->width, plane = ny * nx;
    std::vector<double> sums(static_cast<size_t>(nz));
    holo::parallel(nz, threads, [&](int64_t z) {
      // Inverse norms of the slice above and of this one: each slice is computed twice, and nothing is shared.
      std::vector<float> w_above(z > 0 ? plane : 0), w(plane);
      const auto rows = [&](int64_t slice, int64_t y) {
        const float* here = u + slice * plane + y * nx;
        return Rows{here, slice + 1 < nz ? here + plane : nullptr, y + 1 < ny ? here + nx : nullptr};
      };
      const float s = static_cast<float>(smoothing);
      double sum = 0.0;
      for (int64_t y = 0; y < ny; ++y) {
        if (z > 0) inverse_norms(rows(z - 1, y), nx, s, w_above.data() + y * nx);
        sum += inverse_norms(rows(z, y), nx, s, w.data() + y * nx);
      }
      sums[static_cast<size_t>(z)] = sum;
      for (int64_t y = 0; y < ny; ++y) {
        const int64_t at = y * nx;
        const float* here = u + z * plane + at;
        gradient_row(rows(z, y), z > 0 ? here - plane : nullptr, y > 0 ? here - nx : nullptr, w.data() + at,
                     z > 0 ? w_above.data() + at : nullptr, y > 0 ? w.data() + at - nx : nullptr, nx,
                     gradient + z * plane + at);
      }
    });
    double total = 0.0;  // in the order of the slices: the same on every run
    for (const double sum : sums) total += sum;
    *value = total;
  });
}
