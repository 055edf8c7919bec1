// Patches by the batch. Most are narrow, a vector or two wide and a few rows high. The exponentials that start their
// recurrences, and the sums over lanes at the end, are done for a whole batch at a time, in loops without surprises:
// a processor that has mispredicted the end of each patch's rows would otherwise wait for each in turn.
#pragma once

#include "needle.hpp"

namespace holo {

constexpr int kBatch = 16;   // jobs
constexpr int kNarrow = 16;  // columns
// Half a vector is enough for most, and crosses fewer cache lines.
constexpr int kHalf = kWidest > 4 ? kWidest / 2 : kWidest;

template <int C>
HOLO_INLINE bool is_narrow(const Job<C>& job) {
  return !job.patch.needle && job.patch.x1 - job.patch.x0 < kNarrow;
}

struct alignas(64) Ladders {
  float value[kBatch][kNarrow], step[kBatch][kNarrow];

  template <int C>
  HOLO_INLINE void fill(const Job<C>* jobs, int count) {
    for (int k = 0; k < count; ++k) {
      if (!is_narrow(jobs[k])) continue;
      const Patch& p = jobs[k].patch;
      const int row = anchor(p, jobs[k].first);
      for (int column = 0; column <= p.x1 - p.x0; column += kWidest) {
        const Ladder<kWidest> at = ladder<kWidest>(p, column, row);
        store<kWidest>(value[k] + column, at.value);
        store<kWidest>(step[k] + column, at.step);
      }
    }
  }

  template <int W>
  HOLO_INLINE Ladder<W> get(int k, int column) const {
    return {load<W>(value[k] + column), load<W>(step[k] + column)};
  }
};

// Adds the jobs' patches to their rasters, in order.
template <int C>
void draw(const Job<C>* jobs, int count) {
  Ladders ladders;
  ladders.fill(jobs, count);
  for (int k = 0; k < count; ++k) {
    const Patch& p = jobs[k].patch;
    if (p.needle) {
      draw_needle(jobs[k]);
    } else if (kHalf < kWidest && p.x1 - p.x0 < kHalf) {
      draw_columns<kHalf>(jobs[k], 0, ladders.get<kHalf>(k, 0));
    } else if (p.x1 - p.x0 < kNarrow) {
      for (int column = 0; column <= p.x1 - p.x0; column += kWidest)
        draw_columns<kWidest>(jobs[k], column, ladders.get<kWidest>(k, column));
    } else {
      const int row = anchor(p, jobs[k].first);
      for (int column = 0; column <= p.x1 - p.x0; column += kWidest)
        draw_columns<kWidest>(jobs[k], column, ladder<kWidest>(p, column, row));
    }
  }
}

template <int C>
void gather_wide(const Job<C>& job, float* moments) {
  constexpr int W = kWidest;
  const Patch& p = job.patch;
  const int row = anchor(p, job.first);
  Floats<W> sums[kMoments] = {};
  for (int column = 0; column <= p.x1 - p.x0; column += W)
    gather_columns<W>(job, column, ladder<W>(p, column, row)).add_to(sums, job.peak, offsets<W>(p, column));
  sum_each<W>(sums, moments);
}

// The moments [count][kMoments] of the rasters (which hold a gradient) under the jobs' patches.
template <int C>
void gather(const Job<C>* jobs, int count, float (*moments)[kMoments]) {
  constexpr int W = kWidest, kVectors = kNarrow / W;
  Ladders ladders;
  ladders.fill(jobs, count);
  ColumnSums<W, C> sums[kBatch][kVectors];
  for (int k = 0; k < count; ++k) {
    if (!is_narrow(jobs[k])) continue;
    for (int j = 0; j <= (jobs[k].patch.x1 - jobs[k].patch.x0) / W; ++j)
      sums[k][j] = gather_columns<W>(jobs[k], j * W, ladders.get<W>(k, j * W));
  }
  for (int k = 0; k < count; ++k) {
    const Patch& p = jobs[k].patch;
    if (!is_narrow(jobs[k])) continue;
    Floats<W> all[kMoments] = {};
    for (int j = 0; j <= (p.x1 - p.x0) / W; ++j) sums[k][j].add_to(all, jobs[k].peak, offsets<W>(p, j * W));
    sum_each<W>(all, moments[k]);
  }
  for (int k = 0; k < count; ++k) {
    if (is_narrow(jobs[k])) continue;
    (jobs[k].patch.needle ? gather_needle<C> : gather_wide<C>)(jobs[k], moments[k]);
  }
}

}  // namespace holo
