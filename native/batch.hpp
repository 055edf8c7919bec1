// Patches by the batch. The exponentials that start their recurrences are done for a whole batch at a time, in loops
// without surprises: a processor that has mispredicted the end of each patch's rows would otherwise wait for each.
#pragma once

#include "needle.hpp"

namespace holo {

constexpr int kBatch = 16;

// Jobs to do on rasters of one kind.
template <int C>
struct Batch {
  Strides strides;
  int count = 0;
  Job<C> jobs[kBatch];
  Crest crests[kBatch];
};

// The ladders of the first group of each patch, in one loop over their vectors.
template <int C>
HOLO_INLINE void fill_first(const Batch<C>& batch, Ladders* ladders) {
  constexpr int kVectors = kGroup / kWidest;
  struct {
    int job, from;
  } vectors[kBatch * kVectors + 1];
  int count = 0;
  for (int k = 0; k < batch.count; ++k)
    for (int v = 0; v < kVectors; ++v) {
      vectors[count] = {k, v * kWidest};
      count += v * kWidest <= batch.jobs[k].patch.end;
    }
  for (int v = 0; v < count; ++v) {
    const Job<C>& job = batch.jobs[vectors[v].job];
    ladders[vectors[v].job].fill(job.patch, job.start, 0, vectors[v].from);
  }
}

// The ladders of a later group of a wide patch.
template <int C>
void fill_next(const Job<C>& job, int column, Ladders& ladders) {
  for (int from = 0; from < kGroup; from += kWidest) ladders.fill(job.patch, job.start, column, from);
}

// Adds the jobs' patches to their rasters, in order. Their columns should count from multiples of kUnit: a store that
// straddles 32 bytes takes twice as long as one that does not.
template <int C>
void draw(const Batch<C>& batch) {
  const Strides strides = batch.strides;
  Ladders ladders[kBatch];
  fill_first(batch, ladders);
  for (int k = 0; k < batch.count; ++k) {
    const Job<C>& job = batch.jobs[k];
    if (batch.crests[k].needle) {
      draw_needle(job, strides, batch.crests[k]);
      continue;
    }
    for (int column = 0; column <= job.patch.end; column += kGroup) {
      if (column > 0) fill_next(job, column, ladders[k]);
      switch ((job.patch.end - column) / kUnit) {
        case 0: draw_columns<kUnit, 1>(job, strides, column, ladders[k]); break;
        case 1: draw_columns<kWidest, 2 * kUnit / kWidest>(job, strides, column, ladders[k]); break;
        case 2: draw_columns<kUnit, 3>(job, strides, column, ladders[k]); break;
        default: draw_columns<kWidest, kGroup / kWidest>(job, strides, column, ladders[k]);
      }
    }
  }
}

// Gathers up to kGroup columns.
template <int C>
HOLO_INLINE void gather_group(const Job<C>& job, const Strides& strides, int column, const Ladders& ladders,
                              float* moments) {
  const int more = (job.patch.end - column) / kUnit;
  if constexpr (kWidest == 16) {
    switch (more) {
      case 0: return gather_columns<kUnit, 1>(job, strides, column, ladders, 0, moments);
      case 1: return gather_columns<kWidest, 1>(job, strides, column, ladders, 0, moments);
      case 2: return gather_columns<kUnit, 3>(job, strides, column, ladders, 0, moments);
      default: return gather_columns<kWidest, 2>(job, strides, column, ladders, 0, moments);
    }
  } else {
    for (int n = 0; n <= std::min(more, 3); ++n)
      gather_columns<kWidest, 1>(job, strides, column, ladders, n * kWidest, moments);
  }
}

// The moments [count][kMoments] of the rasters (which hold a gradient) under the jobs' patches.
template <int C>
void gather(const Batch<C>& batch, float (*moments)[kMoments]) {
  const Strides strides = batch.strides;
  Ladders ladders[kBatch];
  fill_first(batch, ladders);
  for (int k = 0; k < batch.count; ++k) {
    const Job<C>& job = batch.jobs[k];
    std::fill_n(moments[k], int(kMoments), 0.0f);
    if (batch.crests[k].needle) {
      gather_needle(job, strides, batch.crests[k], moments[k]);
      continue;
    }
    for (int column = 0; column <= job.patch.end; column += kGroup) {
      if (column > 0) fill_next(job, column, ladders[k]);
      gather_group(job, strides, column, ladders[k], moments[k]);
    }
    moments[k][END] = job.patch.dy + static_cast<float>(job.last + 1 - job.patch.y);
  }
}

}  // namespace holo
