// One 2D Gaussian on its box of pixels: drawn onto a raster, or a raster's gradient gathered through it.
//
// The lanes of a vector are neighbouring pixels of one row. Going down the rows, a Gaussian w and its ratio h from
// row to row obey w <- w h, h <- h g with a constant g: two multiplications and no exponential. That holds while
// nothing underflows at the box's corners; long thin Gaussians aslant ("needles", needle.hpp) take an exponential
// per pixel.
#pragma once

#include <algorithm>

#include "simd.hpp"

namespace holo {

// Rounding errors of the recurrence grow with the square of its length, so it starts afresh every so many rows,
// counted from the box's first row: a pixel's value never depends on where a band of rows begins.
constexpr int kRestart = 16;
// Exponents are of base 2: exp(-½ q) = 2^(-kHalfLog2E q).
constexpr double kHalfLog2E = 0.72134752044448170;
// Exponents (of base e) up to which the recurrence is safe; 2^-120 = e^-83.
constexpr double kSafeExponent = 80.0;

// Rows and channels of pixels in memory, which anyone may read a vector past their end.
struct Raster {
  float* data;
  int64_t row, channel;  // strides
  HOLO_INLINE float* at(int64_t y, int64_t x) const { return data + y * row + x; }
};

// Value at an offset (dx, dy) from the mean: 2^-(faint + a dx² + 2 b dx dy + c dy²).
struct Patch {
  float a, b, c;
  float ratio;   // g = 2^(-2 c)
  float faint;   // what the third dimension adds to the exponent
  int x0, x1;    // columns of the box, cut to the raster
  int y0;        // first row of the box, not cut: where the recurrence counts from
  float dx, dy;  // offset of the pixel (x0, y0) from the mean
  bool needle;
  // For needles: the same exponent as faint + a (dx - slope dy)² + down dy², in which nothing cancels.
  double u, v;   // the mean in pixel indices
  double slope;
  float down;
};

// A patch, the rows of it that are wanted, and the peaks of C channels.
template <int C>
struct Job {
  Patch patch;
  int first, last;
  float peak[C];
  Raster raster;
};

// The sums that gradients are made of, over the pixels of a patch: value · gradient, times 1 for each channel, and
// for all channels together (weighted with the peaks if C = 2) times dx, dx², dy, dx dy, dy².
enum { FIRST, SECOND, ACROSS, ACROSS2, DOWN, ACROSS_DOWN, DOWN2, UNUSED, kMoments };

// The recurrence at W pixels of a row, `column` columns into the patch.
template <int W>
struct Ladder {
  Floats<W> value, step;
};

// The row where the recurrence that reaches row `first` starts.
HOLO_INLINE int anchor(const Patch& p, int first) { return p.y0 + (first - p.y0) / kRestart * kRestart; }

template <int W>
HOLO_INLINE Floats<W> offsets(const Patch& p, int column) {
  return as_floats<W>(lanes<W>() + column) + p.dx;
}

template <int W>
HOLO_INLINE Ladder<W> ladder(const Patch& p, int column, int row) {
  const Floats<W> dx = offsets<W>(p, column), bx = 2 * p.b * dx;
  const float dy = p.dy + static_cast<float>(row - p.y0);
  const Ints<W> inside = lanes<W>() + column <= p.x1 - p.x0;
  const Floats<W> across = fused<W>(p.a * dx, dx, fill<W>(p.faint));
  Ladder<W> at;
  at.value = keep<W>(inside, exp2<W>(-fused<W>(bx + p.c * dy, fill<W>(dy), across)));
  at.step = keep<W>(inside, exp2<W>(-(bx + p.c * (2 * dy + 1))));  // or it would end in slow subnormals
  return at;
}

// Calls visit(row, value) for the wanted rows of W columns, given the ladder at the anchor.
template <int W, class Visit>
HOLO_INLINE void descend(const Patch& p, int first, int last, int column, Ladder<W> at, const Visit& visit) {
  int row = anchor(p, first), restart = row + kRestart;
  const float ratio = p.ratio;
  for (; row < first; ++row) at.value *= at.step, at.step *= ratio;
  for (;;) {
    for (const int end = std::min(last + 1, restart); row < end; ++row) {
      visit(row, at.value);
      at.value *= at.step, at.step *= ratio;
    }
    if (row > last) return;
    at = ladder<W>(p, column, row);
    restart = row + kRestart;
  }
}

template <int W, int C>
HOLO_INLINE void draw_columns(const Job<C>& job, int column, Ladder<W> at) {
  // Copies, which the stores below cannot change for all the compiler knows.
  const int64_t row = job.raster.row, channel = job.raster.channel;
  float peak[C];
  for (int c = 0; c < C; ++c) peak[c] = job.peak[c];
  float* pixel = job.raster.at(job.first, job.patch.x0 + column);
  descend<W>(job.patch, job.first, job.last, column, at, [&](int, Floats<W> value) {
    for (int c = 0; c < C; ++c)
      store<W>(pixel + c * channel, fused<W>(fill<W>(peak[c]), value, load<W>(pixel + c * channel)));
    pixel += row;
  });
}

// Sums down W columns: for each channel, and of all channels times dy and dy².
template <int W, int C>
struct ColumnSums {
  Floats<W> each[C] = {}, down = {}, down2 = {};

  HOLO_INLINE void add(Floats<W> value, const float* pixel, const Job<C>& job, float dy) {
    Floats<W> all = {};
    for (int c = 0; c < C; ++c) {
      const Floats<W> given = value * load<W>(pixel + c * job.raster.channel);
      each[c] += given;
      all = C == 1 ? given : fused<W>(fill<W>(job.peak[c]), given, all);
    }
    const Floats<W> pull = all * dy;
    down += pull;
    down2 = fused<W>(pull, fill<W>(dy), down2);
  }

  // Adds to the sums (vectors yet) that make the moments, for columns at the offsets dx.
  HOLO_INLINE void add_to(Floats<W>* sums, const float* peak, Floats<W> dx) const {
    Floats<W> all = each[0];
    if constexpr (C == 2) all = peak[0] * each[0] + peak[1] * each[1];
    for (int c = 0; c < C; ++c) sums[FIRST + c] += each[c];
    sums[ACROSS] += all * dx;
    sums[ACROSS2] += all * dx * dx;
    sums[DOWN] += down;
    sums[ACROSS_DOWN] += down * dx;
    sums[DOWN2] += down2;
  }
};

template <int W, int C>
HOLO_INLINE ColumnSums<W, C> gather_columns(const Job<C>& job, int column, Ladder<W> at) {
  ColumnSums<W, C> sums;
  const float* pixel = job.raster.at(job.first, job.patch.x0 + column);
  float dy = job.patch.dy + static_cast<float>(job.first - job.patch.y0);
  descend<W>(job.patch, job.first, job.last, column, at, [&](int, Floats<W> value) {
    sums.add(value, pixel, job, dy);
    pixel += job.raster.row;
    dy += 1;
  });
  return sums;
}

}  // namespace holo
