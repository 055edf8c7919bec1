// Needles: long thin Gaussians aslant, whose box is mostly empty and whose exponents would underflow in a recurrence.
// Row by row, only the columns near the crest are visited, with an exponential for each pixel.
#pragma once

#include <cmath>

#include "patch.hpp"

namespace holo {

// What is fainter than 2^-26 of the peak is skipped: single precision cannot see it.
constexpr float kFaint = 26.0f;

// The columns of one row that are worth a look, and where they lie.
struct Span {
  int begin, end;  // columns of the patch, end exclusive
  double across;   // offset of the patch's first column from the row's crest
  float dy, faint;
};

HOLO_INLINE Span span(const Patch& p, int row) {
  Span s;
  const double dy = row - p.v;
  s.dy = static_cast<float>(dy);
  s.across = p.x0 - p.u - p.slope * dy;
  s.faint = p.faint + p.down * s.dy * s.dy;
  s.begin = s.end = 0;
  if (s.faint < kFaint) {
    const double reach = std::sqrt((kFaint - s.faint) / p.a), width = p.x1 - p.x0 + 1;
    s.begin = static_cast<int>(std::clamp(-s.across - reach, 0.0, width));
    s.end = static_cast<int>(std::clamp(-s.across + reach + 1, 0.0, width));
  }
  return s;
}

// Calls visit(pixels, value, t, dy) for W columns at a time, with t = dx - slope dy.
template <int W, int C, class Visit>
HOLO_INLINE void scan_needle(const Job<C>& job, const Visit& visit) {
  const Patch& p = job.patch;
  for (int row = job.first; row <= job.last; ++row) {
    const Span s = span(p, row);
    for (int column = s.begin; column < s.end; column += W) {
      const Ints<W> inside = lanes<W>() + column < s.end;
      const Floats<W> t = as_floats<W>(lanes<W>()) + static_cast<float>(s.across + column);
      const Floats<W> value = keep<W>(inside, exp2<W>(-(p.a * t * t + s.faint)));
      visit(job.raster.at(row, p.x0 + column), value, t, s.dy);
    }
  }
}

template <int C>
void draw_needle(const Job<C>& job) {
  constexpr int W = kWidest;
  scan_needle<W>(job, [&](float* pixel, Floats<W> value, Floats<W>, float) {
    for (int c = 0; c < C; ++c) {
      float* channel = pixel + c * job.raster.channel;
      store<W>(channel, fused<W>(fill<W>(job.peak[c]), value, load<W>(channel)));
    }
  });
}

// As the moments of other patches, but with t in the place of dx.
template <int C>
void gather_needle(const Job<C>& job, float* moments) {
  constexpr int W = kWidest;
  Floats<W> sums[kMoments] = {};
  scan_needle<W>(job, [&](float* pixel, Floats<W> value, Floats<W> t, float dy) {
    ColumnSums<W, C> at;
    at.add(value, pixel, job, dy);
    at.add_to(sums, job.peak, t);
  });
  sum_each<W>(sums, moments);
}

}  // namespace holo
