// Line integrals along rays through a stack of slices: linear between the four voxels around the ray's place in each
// slice (Joseph 1982), in any direction, parallel or from a source. The adjoint is exact, and so are the derivatives.
// Slices have a rim of zeros, one voxel wide, on which every ray is held that passes beside the slice.

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "abi.hpp"
#include "threads.hpp"

namespace {

constexpr int64_t kLanes = 32;   // rays that are followed together: their voxels are neighbours
constexpr int64_t kTogether = 1024;  // rays of a task

struct Block {  // of up to kLanes rays, what is missing being the first one again, without weight
  float row[kLanes], row_step[kLanes], column[kLanes], column_step[kLanes], weight[kLanes];
  int64_t count;
};

Block block_of(const HoloRays& rays, int64_t first) {
  Block b;
  b.count = std::min(kLanes, rays.count - first);
  const float* from[5] = {rays.places, rays.places + rays.count, rays.places + 2 * rays.count,
                          rays.places + 3 * rays.count, rays.places + 4 * rays.count};
  float* to[5] = {b.row, b.row_step, b.column, b.column_step, b.weight};
  for (int k = 0; k < 5; ++k) {
    std::memcpy(to[k], from[k] + first, b.count * sizeof(float));
    std::fill(to[k] + b.count, to[k] + kLanes, k == 4 ? 0.0f : from[k][first]);
  }
  return b;
}

// Slices [first, last) outside of which every ray of a block lies on the rim.
void slices_of(const Block& b, const HoloRays& rays, int64_t& first, int64_t& last) {
  const float half = 0.5f * static_cast<float>(rays.depth - 1);
  float low = half, high = -half;
  for (int64_t n = 0; n < b.count; ++n) {
    float from = -half, to = half;
    const auto narrow = [&](float at, float step, float limit) {  // 0 < at + k step < limit
      if (std::abs(step) < 1e-12f) {
        if (!(at > 0 && at < limit)) to = from - 1;
        return;
      }
      const float p = -at / step, q = (limit - at) / step;
      from = std::max(from, std::min(p, q)), to = std::min(to, std::max(p, q));
    };
    narrow(b.row[n], b.row_step[n], static_cast<float>(rays.height - 1));
    narrow(b.column[n], b.column_step[n], static_cast<float>(rays.width - 1));
    if (!(from <= to)) continue;
    low = std::min(low, from), high = std::max(high, to);
  }
  // A slice more at either end: the rounding of the division above.
  first = std::max<int64_t>(0, static_cast<int64_t>(std::floor(low + half)) - 1);
  last = std::min<int64_t>(rays.depth, static_cast<int64_t>(std::ceil(high + half)) + 2);
}

// Where a block of rays meets a slice: the first of four voxels, and how far (0 to 1) the place is from it.
struct Places {
  int32_t cell[kLanes];
  float down[kLanes], right[kLanes];
};

inline void meet(const Block& b, const HoloRays& rays, float depth, Places& p) {
  const float bottom = static_cast<float>(rays.height - 1), end = static_cast<float>(rays.width - 1);
  const int32_t last_row = static_cast<int32_t>(rays.height) - 2, last = static_cast<int32_t>(rays.width) - 2;
  const int32_t width = static_cast<int32_t>(rays.width);
  for (int64_t n = 0; n < kLanes; ++n) {
    float y = b.row[n] + depth * b.row_step[n], x = b.column[n] + depth * b.column_step[n];
    y = y > 0.0f ? y : 0.0f, x = x > 0.0f ? x : 0.0f;
    y = y < bottom ? y : bottom, x = x < end ? x : end;
    int32_t i = static_cast<int32_t>(y), j = static_cast<int32_t>(x);
    i = i < last_row ? i : last_row, j = j < last ? j : last;
    p.cell[n] = i * width + j;
    p.down[n] = y - static_cast<float>(i), p.right[n] = x - static_cast<float>(j);
  }
}

float depth_of(const HoloRays& rays, int64_t k) {
  return static_cast<float>(k) - 0.5f * static_cast<float>(rays.depth - 1);
}

}  // namespace

int64_t holosplat_rays_project(const HoloRays* rays, const float* volume, float* image, int64_t threads) {
  return holo::guarded([&] {
    const int64_t voxels = rays->height * rays->width, w = rays->width;
    holo::parallel_runs(rays->count, kTogether, threads, [&](int64_t begin, int64_t end) {
      for (int64_t first = begin; first < end; first += kLanes) {
        const Block b = block_of(*rays, first);
        int64_t from, to;
        slices_of(b, *rays, from, to);
        float sum[kLanes] = {};
        Places p;
        for (int64_t k = from; k < to; ++k) {
          meet(b, *rays, depth_of(*rays, k), p);
          const float *upper = volume + k * voxels, *lower = upper + w;
          for (int64_t n = 0; n < kLanes; ++n) {
            const int32_t at = p.cell[n];
            const float above = upper[at] + p.right[n] * (upper[at + 1] - upper[at]);
            const float below = lower[at] + p.right[n] * (lower[at + 1] - lower[at]);
            sum[n] += above + p.down[n] * (below - above);
          }
        }
        const int64_t count = std::min(b.count, end - first);
        for (int64_t n = 0; n < count; ++n) image[first + n] = sum[n] * b.weight[n];
      }
    });
  });
}

int64_t holosplat_rays_backproject(const HoloRays* rays, const float* image, float* volume, int64_t threads) {
  return holo::guarded([&] {
    const int64_t voxels = rays->height * rays->width, w = rays->width;
    struct Span {
      int64_t first, last;
    };
    std::vector<Span> spans((rays->count + kLanes - 1) / kLanes);
    holo::parallel_runs(static_cast<int64_t>(spans.size()), kTogether, threads, [&](int64_t begin, int64_t end) {
      for (int64_t n = begin; n < end; ++n) slices_of(block_of(*rays, n * kLanes), *rays, spans[n].first, spans[n].last);
    });
    holo::parallel(rays->depth, threads, [&](int64_t k) {
      float *upper = volume + k * voxels, *lower = upper + w;
      Places p;
      for (int64_t first = 0; first < rays->count; first += kLanes) {
        const Span& span = spans[first / kLanes];
        if (k < span.first || k >= span.last) continue;
        const Block b = block_of(*rays, first);
        meet(b, *rays, depth_of(*rays, k), p);
        for (int64_t n = 0; n < b.count; ++n) {
          const int32_t at = p.cell[n];
          const float value = image[first + n] * b.weight[n], below = value * p.down[n], above = value - below;
          const float right = p.right[n];
          upper[at] += above - above * right, upper[at + 1] += above * right;
          lower[at] += below - below * right, lower[at + 1] += below * right;
        }
      }
    });
  });
}

int64_t holosplat_rays_gradients(const HoloRays* rays, const float* volume, const float* image_gradient,
                                 float* gradients, int64_t threads) {
  return holo::guarded([&] {
    const int64_t voxels = rays->height * rays->width, w = rays->width;
    const float bottom = static_cast<float>(rays->height - 1), end = static_cast<float>(rays->width - 1);
    holo::parallel_runs(rays->count, kTogether, threads, [&](int64_t begin, int64_t stop) {
      for (int64_t first = begin; first < stop; first += kLanes) {
        const Block b = block_of(*rays, first);
        int64_t from, to;
        slices_of(b, *rays, from, to);
        double sums[5][kLanes] = {};
        Places p;
        for (int64_t k = from; k < to; ++k) {
          const float depth = depth_of(*rays, k);
          meet(b, *rays, depth, p);
          const float *upper = volume + k * voxels, *lower = upper + w;
          for (int64_t n = 0; n < b.count; ++n) {
            const int32_t at = p.cell[n];
            const float y = b.row[n] + depth * b.row_step[n], x = b.column[n] + depth * b.column_step[n];
            const float above = upper[at] + p.right[n] * (upper[at + 1] - upper[at]);
            const float below = lower[at] + p.right[n] * (lower[at + 1] - lower[at]);
            sums[4][n] += above + p.down[n] * (below - above);
            if (!(y > 0 && y < bottom && x > 0 && x < end)) continue;
            const float across = (1 - p.down[n]) * (upper[at + 1] - upper[at]) + p.down[n] * (lower[at + 1] - lower[at]);
            sums[0][n] += below - above, sums[1][n] += depth * (below - above);
            sums[2][n] += across, sums[3][n] += depth * across;
          }
        }
        const int64_t count = std::min(b.count, stop - first);
        for (int64_t n = 0; n < count; ++n) {
          const double upstream = image_gradient[first + n];
          for (int q = 0; q < 5; ++q)
            gradients[q * rays->count + first + n] =
                static_cast<float>(upstream * (q == 4 ? 1.0 : double(b.weight[n])) * sums[q][n]);
        }
      }
    });
  });
}
