// Needles: long thin Gaussians aslant, whose box is mostly empty and whose exponents would underflow in a recurrence.
// Row by row, only the columns near the crest are visited, with an exponential for each pixel.
#pragma once

#include <cmath>

#include "patch.hpp"

namespace holo {

// What is fainter than 2^-26 of the peak is skipped: single precision cannot see it.
constexpr float kFaint = 26.0f;

// What a patch needs to be drawn as a needle: its exponent as faint + a (dx - slope dy)² + down dy², in which
// nothing cancels.
struct Crest {
  bool needle;
  float down;
  double u, v;  // the mean in pixel indices
  double slope;
};

// The columns of one row that are worth a look, and where they lie.
struct Span {
  int begin, end;  // columns of the patch, end exclusive
  double across;   // offset of the patch's column 0 from the row's crest
  float dy, faint;
};

HOLO_INLINE Span span(const Patch& p, const Crest& crest, int row) {
  Span s;
  const double dy = row - crest.v;
  s.dy = static_cast<float>(dy);
  s.across = p.x - crest.u - crest.slope * dy;
  s.faint = p.faint + crest.down * s.dy * s.dy;
  s.begin = s.end = 0;
  if (s.faint > -kFaint) {
    const double reach = std::sqrt((kFaint + s.faint) / -p.a), begin = p.begin, end = p.end + 1;
    s.begin = static_cast<int>(std::clamp(-s.across - reach, begin, end));
    s.end = static_cast<int>(std::clamp(-s.across + reach + 1, begin, end));
  }
  return s;
}

// Calls visit(pixels, value, t, dy) for W columns at a time, with t = dx - slope dy.
template <int W, int C, class Visit>
HOLO_INLINE void scan_needle(const Job<C>& job, const Strides& strides, const Crest& crest, const Visit& visit) {
  const Patch& p = job.patch;
  for (int row = job.first; row <= job.last; ++row) {
    const Span s = span(p, crest, row);
    for (int column = s.begin; column < s.end; column += W) {
      const Ints<W> inside = lanes<W>() + column < s.end;
      const Floats<W> t = as_floats<W>(lanes<W>()) + static_cast<float>(s.across + column);
      const Floats<W> value = keep<W>(inside, fade<W>(p.a * t * t + s.faint));
      visit(job.raster + row * strides.row + p.x + column, value, t, s.dy);
    }
  }
}

template <int C>
void draw_needle(const Job<C>& job, const Strides& strides, const Crest& crest) {
  constexpr int W = kWidest;
  scan_needle<W>(job, strides, crest, [&](float* pixel, Floats<W> value, Floats<W>, float) {
    for (int c = 0; c < C; ++c) {
      float* channel = pixel + c * strides.channel;
      store<W>(channel, fused<W>(fill<W>(job.peak[c]), value, load<W>(channel)));
    }
  });
}

// As the moments of other patches, but with t in the place of dx, and m = -dy.
template <int C>
void gather_needle(const Job<C>& job, const Strides& strides, const Crest& crest, float* moments) {
  constexpr int W = kWidest;
  Floats<W> sums[kMoments] = {};
  scan_needle<W>(job, strides, crest, [&](float* pixel, Floats<W> value, Floats<W> t, float dy) {
    Floats<W> all = {};
    for (int c = 0; c < C; ++c) {
      const Floats<W> given = value * load<W>(pixel + c * strides.channel);
      sums[FIRST + c] += given;
      all = C == 1 ? given : fused<W>(fill<W>(job.peak[c]), given, all);
    }
    sums[ACROSS] += all * t;
    sums[ACROSS2] += all * t * t;
    sums[UP] -= all * dy;
    sums[ACROSS_UP] -= all * t * dy;
    sums[UP2] += all * dy * dy;
  });
  sum_each(sums, moments);
}

}  // namespace holo
