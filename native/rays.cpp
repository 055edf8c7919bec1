// Line integrals along rays through a stack of slices: linear between the four voxels around the ray's place in each
// slice (Joseph 1982), in any direction, parallel or from a source. The adjoint is exact, and so are the derivatives.
// Slices have a rim of zeros, one voxel wide, on which every ray is held that passes beside the slice.

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "abi.hpp"
#include "simd.hpp"
#include "threads.hpp"

namespace {

constexpr int64_t kLanes = 128;      // rays that are followed together: their voxels are neighbours
constexpr int64_t kLevel = 8;        // rays of one row, at least, that are followed along it
constexpr int64_t kTogether = 1024;  // rays of a task
constexpr int64_t kTurns = 16;       // parts of a block whose rays are cast back in turns

struct Block {  // of up to kLanes rays, what is missing being the first one again, without weight
  float row[kLanes], row_step[kLanes], column[kLanes], column_step[kLanes], weight[kLanes];
  int64_t first, count, lanes;  // lanes: a whole number of vectors
  bool level;  // all rays meet the same row of each slice
};

Block block_of(const HoloRays& rays, int64_t first, int64_t end) {
  Block b;
  const float *rows = rays.places, *steps = rays.places + rays.count;
  const int64_t most = std::min(kLanes, end - first);
  int64_t alike = 1;
  while (alike < most && rows[first + alike] == rows[first] && steps[first + alike] == steps[first]) ++alike;
  b.first = first, b.level = alike >= kLevel, b.count = b.level ? alike : most;
  b.lanes = (b.count + 15) / 16 * 16;
  float* to[5] = {b.row, b.row_step, b.column, b.column_step, b.weight};
  for (int k = 0; k < 5; ++k) {
    const float* from = rays.places + k * rays.count + first;
    std::memcpy(to[k], from, b.count * sizeof(float));
    std::fill(to[k] + b.count, to[k] + b.lanes, k == 4 ? 0.0f : from[0]);
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
  int32_t row[kLanes], column[kLanes];
  float down[kLanes], right[kLanes];
};

inline void along(const float* at, const float* step, float depth, int64_t lanes, int64_t count, int32_t* cell,
                  float* beyond) {
  const float end = static_cast<float>(count - 1);
  const int32_t last = static_cast<int32_t>(count) - 2;
  for (int64_t n = 0; n < lanes; ++n) {
    float x = at[n] + depth * step[n];
    x = x > 0.0f ? x : 0.0f;
    x = x < end ? x : end;
    int32_t j = static_cast<int32_t>(x);
    j = j < last ? j : last;
    cell[n] = j;
    beyond[n] = x - static_cast<float>(j);
  }
}

inline void meet(const Block& b, const HoloRays& rays, float depth, Places& p) {
  along(b.row, b.row_step, depth, b.lanes, rays.height, p.row, p.down);
  along(b.column, b.column_step, depth, b.lanes, rays.width, p.column, p.right);
}

// Of a level block: its row, and the columns [low, high] whose voxels it meets.
struct Level {
  int64_t row, low, high;
  float down;
};

inline Level meet_level(const Block& b, const HoloRays& rays, float depth, Places& p) {
  along(b.column, b.column_step, depth, b.lanes, rays.width, p.column, p.right);
  const float end = static_cast<float>(rays.height - 1);
  const float y = std::min(std::max(b.row[0] + depth * b.row_step[0], 0.0f), end);
  const int64_t i = std::min(static_cast<int64_t>(y), rays.height - 2);
  int32_t low = p.column[0], high = low;
  for (int64_t n = 0; n < b.lanes; ++n) low = std::min(low, p.column[n]), high = std::max(high, p.column[n]);
  return {i, low, high + 1, y - static_cast<float>(i)};
}

// sum += the line, linear between its numbers, at a level block's columns: each pair is loaded at once.
inline void add_pairs(const float* line, const Places& p, int64_t lanes, float* sum) {
  typedef float Four __attribute__((vector_size(16)));
  for (int64_t n = 0; n < lanes; n += 4) {
    Four first, second;
    const auto load = [&](Four& to, int64_t q) {
      float both[4];
      std::memcpy(both, line + p.column[n + q], 8), std::memcpy(both + 2, line + p.column[n + q + 1], 8);
      std::memcpy(&to, both, sizeof(Four));
    };
    load(first, 0), load(second, 2);
    const Four left = HOLO_SHUFFLE(4, first, second, 0, 2, 4, 6), right = HOLO_SHUFFLE(4, first, second, 1, 3, 5, 7);
    Four beyond, total;
    std::memcpy(&beyond, p.right + n, sizeof(Four)), std::memcpy(&total, sum + n, sizeof(Four));
    total += left + beyond * (right - left);
    std::memcpy(sum + n, &total, sizeof(Four));
  }
}

float depth_of(const HoloRays& rays, int64_t k) {
  return static_cast<float>(k) - 0.5f * static_cast<float>(rays.depth - 1);
}

void see(const Block& b, const HoloRays& rays, const float* volume, float* __restrict line,
         float* __restrict sum) {
  const int64_t voxels = rays.height * rays.width, w = rays.width;
  int64_t from, to;
  slices_of(b, rays, from, to);
  Places p;
  for (int64_t k = from; k < to; ++k) {
    if (b.level) {
      const Level at = meet_level(b, rays, depth_of(rays, k), p);
      const float *upper = volume + k * voxels + at.row * w, *lower = upper + w;
      for (int64_t j = at.low; j <= at.high; ++j) line[j] = upper[j] + at.down * (lower[j] - upper[j]);
      add_pairs(line, p, b.lanes, sum);
      continue;
    }
    meet(b, rays, depth_of(rays, k), p);
    for (int64_t n = 0; n < b.lanes; ++n) {
      const float *upper = volume + k * voxels + p.row[n] * w + p.column[n], *lower = upper + w;
      const float above = upper[0] + p.right[n] * (upper[1] - upper[0]);
      const float below = lower[0] + p.right[n] * (lower[1] - lower[0]);
      sum[n] += above + p.down[n] * (below - above);
    }
  }
}

void cast_back(const Block& b, const HoloRays& rays, const float* image, float depth, float* slice, float* line) {
  const int64_t w = rays.width;
  Places p;
  if (b.level) {
    const Level at = meet_level(b, rays, depth, p);
    std::fill(line + at.low, line + at.high + 1, 0.0f);
    float left[kLanes], right[kLanes];
    for (int64_t n = 0; n < b.count; ++n) {
      const float value = image[b.first + n] * b.weight[n];
      right[n] = value * p.right[n], left[n] = value - right[n];
    }
    // Neighbouring rays share voxels, and each would wait for the one before: rays of kTurns parts take turns.
    const int64_t part = (b.count + kTurns - 1) / kTurns;
    for (int64_t m = 0; m < part; ++m)
      for (int64_t n = m; n < b.count; n += part)
        line[p.column[n]] += left[n], line[p.column[n] + 1] += right[n];
    float *upper = slice + at.row * w, *lower = upper + w;
    for (int64_t j = at.low; j <= at.high; ++j) {
      const float below = at.down * line[j];
      upper[j] += line[j] - below, lower[j] += below;
    }
    return;
  }
  meet(b, rays, depth, p);
  for (int64_t n = 0; n < b.count; ++n) {
    float *upper = slice + p.row[n] * w + p.column[n], *lower = upper + w;
    const float value = image[b.first + n] * b.weight[n], below = value * p.down[n], above = value - below;
    const float right = p.right[n];
    upper[0] += above - above * right, upper[1] += above * right;
    lower[0] += below - below * right, lower[1] += below * right;
  }
}

}  // namespace

int64_t holosplat_rays_project(const HoloRays* rays, const float* volume, float* image, int64_t threads) {
  return holo::guarded([&] {
    holo::parallel_runs(rays->count, kTogether, threads, [&](int64_t begin, int64_t end) {
      std::vector<float> line(rays->width);
      for (int64_t first = begin; first < end;) {
        const Block b = block_of(*rays, first, end);
        float sum[kLanes] = {};
        see(b, *rays, volume, line.data(), sum);
        for (int64_t n = 0; n < b.count; ++n) image[first + n] = sum[n] * b.weight[n];
        first += b.count;
      }
    });
  });
}

int64_t holosplat_rays_backproject(const HoloRays* rays, const float* image, float* volume, int64_t threads) {
  return holo::guarded([&] {
    struct Seen {
      Block block;
      int64_t first, last;
    };
    std::vector<Seen> blocks;
    for (int64_t first = 0; first < rays->count; first += blocks.back().block.count) {
      blocks.push_back({block_of(*rays, first, rays->count), 0, 0});
      slices_of(blocks.back().block, *rays, blocks.back().first, blocks.back().last);
    }
    holo::parallel(rays->depth, threads, [&](int64_t k) {
      std::vector<float> line(rays->width);
      float* slice = volume + k * rays->height * rays->width;
      for (const Seen& seen : blocks)
        if (k >= seen.first && k < seen.last) cast_back(seen.block, *rays, image, depth_of(*rays, k), slice, line.data());
    });
  });
}

int64_t holosplat_rays_gradients(const HoloRays* rays, const float* volume, const float* image_gradient,
                                 float* gradients, int64_t threads) {
  return holo::guarded([&] {
    const int64_t voxels = rays->height * rays->width, w = rays->width;
    const float bottom = static_cast<float>(rays->height - 1), right_end = static_cast<float>(rays->width - 1);
    holo::parallel_runs(rays->count, kTogether, threads, [&](int64_t begin, int64_t end) {
      for (int64_t first = begin; first < end;) {
        const Block b = block_of(*rays, first, end);
        int64_t from, to;
        slices_of(b, *rays, from, to);
        double sums[5][kLanes] = {};
        Places p;
        for (int64_t k = from; k < to; ++k) {
          const float depth = depth_of(*rays, k);
          meet(b, *rays, depth, p);
          for (int64_t n = 0; n < b.count; ++n) {
            const float *upper = volume + k * voxels + p.row[n] * w + p.column[n], *lower = upper + w;
            const float y = b.row[n] + depth * b.row_step[n], x = b.column[n] + depth * b.column_step[n];
            const float above = upper[0] + p.right[n] * (upper[1] - upper[0]);
            const float below = lower[0] + p.right[n] * (lower[1] - lower[0]);
            sums[4][n] += above + p.down[n] * (below - above);
            if (!(y > 0 && y < bottom && x > 0 && x < right_end)) continue;
            const float across = (1 - p.down[n]) * (upper[1] - upper[0]) + p.down[n] * (lower[1] - lower[0]);
            sums[0][n] += below - above, sums[1][n] += depth * (below - above);
            sums[2][n] += across, sums[3][n] += depth * across;
          }
        }
        for (int64_t n = 0; n < b.count; ++n) {
          const double upstream = image_gradient[first + n];
          for (int q = 0; q < 5; ++q)
            gradients[q * rays->count + first + n] =
                static_cast<float>(upstream * (q == 4 ? 1.0 : double(b.weight[n])) * sums[q][n]);
        }
        first += b.count;
      }
    });
  });
}
