// The order in which Gaussians are drawn: neighbours in space one after the other, whose pixels are then still in the
// nearest caches. It depends on the cloud alone, so it is the same in every view and for every number of threads.
//
// Space is cut into slices along one axis, and each slice is walked through along a Z-order curve. With the axis that
// a scan turns about, a slice is the same band of rows in every view: so few pages of memory that the processor finds
// all their addresses at once (which matters more than the cache lines). The voxeliser takes its slowest axis.
#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <vector>

#include "abi.hpp"
#include "threads.hpp"

namespace holo {

// The bits of x, below 2^8, with a zero after each.
inline uint32_t spread_bits(uint32_t x) {
  x = (x | x << 4) & 0x0f0f;
  x = (x | x << 2) & 0x3333;
  return (x | x << 1) & 0x5555;
}

// From positions to cells, numbered as they are walked through: 2^bits of them along each axis.
struct Cells {
  int axis, bits = 0;
  float low[3], scale[3];

  Cells(const HoloCloud& cloud, int slices_along) : axis(slices_along) {
    while (bits < 6 && (int64_t{16} << (3 * bits)) <= cloud.count) ++bits;  // a few Gaussians in a cell
    float high[3];
    for (int d = 0; d < 3; ++d) low[d] = 1e30f, high[d] = -1e30f;
    for (int64_t n = 0; n < cloud.count; ++n)
      for (int d = 0; d < 3; ++d) {
        const float x = cloud.centres[3 * n + d];
        low[d] = x < low[d] ? x : low[d], high[d] = x > high[d] ? x : high[d];
      }
    for (int d = 0; d < 3; ++d) scale[d] = static_cast<float>(1 << bits) / std::max(high[d] - low[d], 1e-30f);
  }

  // Positions that are no numbers go anywhere.
  uint32_t of(const float* centre) const {
    const float top = static_cast<float>((1 << bits) - 1);
    uint32_t at[3];
    for (int d = 0; d < 3; ++d) {
      const float x = (centre[d] - low[d]) * scale[d];
      at[d] = static_cast<uint32_t>(x > 0 ? (x < top ? x : top) : 0);
    }
    const uint32_t one = at[axis == 0 ? 1 : 0], other = at[axis == 2 ? 1 : 2];
    return at[axis] << 2 * bits | spread_bits(one) | spread_bits(other) << 1;
  }
};

// The Gaussians' numbers, sorted by cell; those of one cell in the order of their numbers.
inline std::unique_ptr<int64_t[]> drawing_order(const HoloCloud& cloud, int axis, int64_t threads) {
  const Cells cells(cloud, axis);
  std::unique_ptr<uint32_t[]> cell(new uint32_t[cloud.count]);
  parallel_runs(cloud.count, 1 << 14, threads, [&](int64_t first, int64_t last) {
    for (int64_t n = first; n < last; ++n) cell[n] = cells.of(cloud.centres + 3 * n);
  });
  std::vector<int64_t> next((size_t{1} << (3 * cells.bits)) + 1);
  for (int64_t n = 0; n < cloud.count; ++n) ++next[cell[n] + 1];
  for (size_t k = 1; k < next.size(); ++k) next[k] += next[k - 1];
  std::unique_ptr<int64_t[]> order(new int64_t[cloud.count]);
  for (int64_t n = 0; n < cloud.count; ++n) order[next[cell[n]]++] = n;
  return order;
}

}  // namespace holo
