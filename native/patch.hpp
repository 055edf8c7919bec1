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
constexpr int kRestart = 32;
// Exponents are of base 2: exp(-½ q) = 2^(-kHalfLog2E q).
constexpr double kHalfLog2E = 0.72134752044448170;
// Exponents (of base e) up to which the recurrence is safe; 2^-120 = e^-83.
constexpr double kSafeExponent = 80.0;
// A row of a patch is drawn in blocks of so many pixels, up to four at a time.
constexpr int kUnit = kWidest < 8 ? kWidest : 8;  // half of the widest vector wastes fewer lanes
constexpr int kGroup = 4 * kUnit;

struct Strides {
  int64_t row, channel;
};

// Rows and channels of pixels in memory, which start at cache lines and which anyone may read a vector past their end.
struct Raster {
  float* data;
  Strides strides;
  HOLO_INLINE float* at(int64_t y, int64_t x) const { return data + y * strides.row + x; }
};

// Value at an offset (dx, dy) from the mean: 2^(faint + a dx² + b dx dy + c dy²).
struct Patch {
  float a, b, c;
  float ratio;   // g = 2^(2 c)
  float faint;   // what the third dimension adds to the exponent
  float dx, dy;  // offset of the pixel (x, y) from the mean
  int x;         // where columns count from: at or a little before the box's first
  int y;         // first row of the box, not cut: where the recurrence counts from
  int begin, end;  // first and last column of the box, cut to the raster, from x
};

// Where a recurrence starts: a row's dy, c dy, and c (2 dy + 1), by which the exponent grows to the next row at dx = 0.
struct Anchor {
  float dy, lift, step;
};

// A patch, the rows of it that are wanted, and the peaks of C channels.
template <int C>
struct Job {
  Patch patch;
  int first, last;
  Anchor start;  // of the recurrence that reaches the first
  float peak[C];
  float* raster;
};

// The sums that gradients are made of, over the pixels of a patch: value · gradient, times 1 for each channel, and
// for all channels together (weighted with the peaks if C = 2) times dx, dx², m, dx m, m². Rows are counted from
// below, dy = end - m, and `end` is kept with the sums.
enum { FIRST, SECOND, ACROSS, ACROSS2, UP, ACROSS_UP, UP2, END, kMoments };

// The recurrence at W pixels of a row.
template <int W>
struct Ladder {
  Floats<W> value, step;
};

// The row where the recurrence that reaches row `first` starts.
HOLO_INLINE int anchor(const Patch& p, int first) { return p.y + ((first - p.y) & -kRestart); }

HOLO_INLINE Anchor anchor_at(const Patch& p, int row) {
  const float dy = p.dy + static_cast<float>(row - p.y);
  return {dy, p.c * dy, p.c * (2 * dy + 1)};
}

struct alignas(64) Columns {
  float real[kGroup];
  int whole[kGroup];
};
constexpr Columns columns() {
  Columns c{};
  for (int k = 0; k < kGroup; ++k) c.real[k] = static_cast<float>(k), c.whole[k] = k;
  return c;
}
constexpr Columns kColumns = columns();

// dx at W columns of the group that starts at `column`, `from` columns into it.
template <int W>
HOLO_INLINE Floats<W> offsets(const Patch& p, int column, int from) {
  return load<W>(kColumns.real + from) + (p.dx + static_cast<float>(column));
}

// The recurrence there.
template <int W>
HOLO_INLINE Ladder<W> ladder(const Patch& p, const Anchor& at, int column, int from) {
  const Floats<W> dx = offsets<W>(p, column, from), bx = p.b * dx;
  Ints<W> columns;
  std::memcpy(&columns, kColumns.whole + from, sizeof columns);
  const Ints<W> inside = (columns >= p.begin - column) & (columns <= p.end - column);
  const Floats<W> across = fused<W>(p.a * dx, dx, fill<W>(p.faint));
  return {keep<W>(inside, exp2<W>(fused<W>(bx + at.lift, fill<W>(at.dy), across))),
          keep<W>(inside, exp2<W>(bx + at.step))};
}

// The ladders of a group of columns at an anchor, in memory.
struct alignas(64) Ladders {
  float value[kGroup], step[kGroup];

  // Fills in those of the vector `from` columns into the group that starts at `column`.
  HOLO_INLINE void fill(const Patch& p, const Anchor& start, int column, int from) {
    const Ladder<kWidest> at = ladder<kWidest>(p, start, column, from);
    store<kWidest>(value + from, at.value);
    store<kWidest>(step + from, at.step);
  }

  template <int W>
  HOLO_INLINE Ladder<W> get(int from) const {
    return {load<W>(value + from), load<W>(step + from)};
  }
};

// N vectors of columns on their way down the rows, each times M factors.
template <int W, int N, int M>
struct Walk {
  Floats<W> value[N][M], step[N];

  HOLO_INLINE void start(int n, const Ladder<W>& at, const float* factors) {
    for (int m = 0; m < M; ++m) value[n][m] = at.value * factors[m];
    step[n] = at.step;
  }

  HOLO_INLINE void next(float ratio) {
    for (int n = 0; n < N; ++n) {
      for (int m = 0; m < M; ++m) value[n][m] *= step[n];
      step[n] *= ratio;
    }
  }
};

// Calls visit(walk) for the wanted rows of the N vectors that start `from` columns into a group, whose ladders at the
// anchor are given.
template <int W, int N, int M, int C, class Visit>
HOLO_INLINE void descend(const Job<C>& job, int column, int from, const Ladders& ladders, const float* factors,
                         const Visit& visit) {
  const Patch& p = job.patch;
  const int last = job.last;
  const float ratio = p.ratio;
  int row = anchor(p, job.first), restart = row + kRestart;
  Walk<W, N, M> walk;
  for (int n = 0; n < N; ++n) walk.start(n, ladders.get<W>(from + n * W), factors);
  for (; row < job.first; ++row) walk.next(ratio);
  for (;;) {
    for (const int end = std::min(last + 1, restart); row < end; ++row) visit(walk), walk.next(ratio);
    if (row > last) return;
    const Anchor start = anchor_at(p, row);
    for (int n = 0; n < N; ++n) walk.start(n, ladder<W>(p, start, column, from + n * W), factors);
    restart = row + kRestart;
  }
}

// Adds N vectors of columns to the raster. The peaks go down with the values: processors add beside multiplying.
template <int W, int N, int C>
HOLO_INLINE void draw_columns(const Job<C>& job, const Strides& strides, int column, const Ladders& ladders) {
  // Copies, which the stores below cannot change for all the compiler knows.
  const int64_t row = strides.row, channel = strides.channel;
  float* pixel = job.raster + job.first * row + job.patch.x + column;
  descend<W, N, C>(job, column, 0, ladders, job.peak, [&](const Walk<W, N, C>& walk) {
    for (int n = 0; n < N; ++n)
      for (int c = 0; c < C; ++c) {
        float* to = pixel + c * channel + n * W;
        store<W>(to, load<W>(to) + walk.value[n][c]);
      }
    pixel += row;
  });
}

// Sums down W columns of one channel, sums of those sums as they grew, and sums of these. For n rows they hold the
// sums of what a row gave times 1, m and ½ m (m + 1), where m = n, n - 1, … 1: two additions and no multiplication.
template <int W>
struct ColumnSums {
  Floats<W> once = {}, twice = {}, thrice = {};

  HOLO_INLINE void add(Floats<W> value, const float* pixel) {
    once = fused<W>(value, load<W>(pixel), once);
    twice += once;
    thrice += twice;
  }
};

// The moments of W columns at the offsets dx, as vectors yet.
template <int W, int C>
HOLO_INLINE void column_moments(const ColumnSums<W>* sums, const float* peak, Floats<W> dx, Floats<W>* moments) {
  Floats<W> once = sums[0].once, twice = sums[0].twice, thrice = sums[0].thrice;
  if constexpr (C == 2) {
    const Floats<W> p = fill<W>(peak[0]), q = fill<W>(peak[1]);
    once = fused<W>(q, sums[1].once, p * once);
    twice = fused<W>(q, sums[1].twice, p * twice);
    thrice = fused<W>(q, sums[1].thrice, p * thrice);
  }
  for (int c = 0; c < C; ++c) moments[FIRST + c] = sums[c].once;
  moments[ACROSS] = once * dx;
  moments[ACROSS2] = moments[ACROSS] * dx;
  moments[UP] = twice;
  moments[ACROSS_UP] = twice * dx;
  moments[UP2] = thrice + thrice - twice;
}

// Gathers N vectors of columns, `from` columns into a group.
template <int W, int N, int C>
HOLO_INLINE void gather_columns(const Job<C>& job, const Strides& strides, int column, const Ladders& ladders,
                                int from, float* moments) {
  const int64_t row = strides.row, channel = strides.channel;
  const float* pixel = job.raster + job.first * row + job.patch.x + column + from;
  ColumnSums<W> sums[N][C];
  constexpr float kOne = 1;
  descend<W, N, 1>(job, column, from, ladders, &kOne, [&](const Walk<W, N, 1>& walk) {
    for (int n = 0; n < N; ++n)
      for (int c = 0; c < C; ++c) sums[n][c].add(walk.value[n][0], pixel + c * channel + n * W);
    pixel += row;
  });
  Floats<W> all[kMoments] = {};
  column_moments<W, C>(sums[0], job.peak, offsets<W>(job.patch, column, from), all);
  for (int n = 1; n < N; ++n) {
    Floats<W> more[kMoments] = {};
    column_moments<W, C>(sums[n], job.peak, offsets<W>(job.patch, column, from + n * W), more);
    for (int m = 0; m < END; ++m) all[m] += more[m];
  }
  alignas(32) float sum[kMoments];
  sum_each(all, sum);
  for (int m = 0; m < kMoments; ++m) moments[m] += sum[m];
}

}  // namespace holo
