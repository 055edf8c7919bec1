// How 16 2D Gaussians are drawn: conics, boxes of pixels, and which of them are needles.
#pragma once

#include <cmath>
#include <cstdint>
#include <memory>

#include "batch.hpp"
#include "gaussians.hpp"

namespace holo {

// The inputs of an outline, in double: mean in pixel indices, the factors of the inverse covariance, and the box.
// With t = dx - slope dy, the exponent ½ q is ½ (across t² + down dy²): a sum in which nothing cancels.
struct alignas(64) Spread {
  double u[kBlock], v[kBlock];
  double across[kBlock];  // 1 / variance of x at fixed y = Σyy / det Σ
  double down[kBlock];    // 1 / Σyy
  double slope[kBlock];   // Σxy / Σyy
  double reach_x[kBlock], reach_y[kBlock];  // half-widths of the box
  double corner[kBlock];                    // bound on the exponent ½ q anywhere in the box
};

struct alignas(64) Outline {
  float a[kBlock], b[kBlock], c[kBlock], ratio[kBlock], down[kBlock];  // as in Patch
  float dx[kBlock], dy[kBlock];
  int x0[kBlock], x1[kBlock];  // columns of the box, cut to the raster; empty if x1 < x0
  int y0[kBlock];              // first row, not cut
  int top[kBlock], bottom[kBlock];  // rows, cut to the raster
  int needle[kBlock];
};

// Largest integer <= x, for |x| < 2^31, in operations every instruction set can vectorise.
HOLO_INLINE int floor_int(double x) {
  const int cut = static_cast<int>(x);
  return cut - (x < cut);
}
HOLO_INLINE int ceil_int(double x) { return -floor_int(-x); }
HOLO_INLINE double within(double x, double low, double high) { return x < low ? low : (x > high ? high : x); }

// Fills a spread's inverse covariance from Σ, which must have a positive determinant; returns 1 / det Σ.
HOLO_INLINE double invert(double xx, double xy, double yy, int k, Spread& s) {
  const double least = 1e-30 * (xx * yy) + 1e-200, exact = xx * yy - xy * xy;
  const double det = exact > least ? exact : least;
  const double both = 1 / (det * yy);  // one division for two
  s.across[k] = yy * yy * both;
  s.down[k] = det * both;
  s.slope[k] = xy * s.down[k];
  return yy * both;
}

// ½ q at the worst corner of a box of half-widths (rx, ry): nowhere in the box is the Gaussian fainter.
HOLO_INLINE double corner_exponent(const Spread& s, int k, double rx, double ry) {
  const double t = rx + std::fabs(s.slope[k]) * ry;
  return 0.5 * (s.across[k] * t * t + s.down[k] * ry * ry);
}

// The fast kernels must draw the reference's boxes exactly: `reference._boxes` defines these roundings.
inline void outline(const Spread& __restrict s, int width, int height, Outline& __restrict o) {
  constexpr double kFar = 1 << 30;
  for (int k = 0; k < kBlock; ++k) {
    const double a = kHalfLog2E * s.across[k], down = kHalfLog2E * s.down[k];
    o.a[k] = static_cast<float>(a);
    o.b[k] = static_cast<float>(-a * s.slope[k]);
    o.c[k] = static_cast<float>(down + a * s.slope[k] * s.slope[k]);
    o.down[k] = static_cast<float>(down);
    o.needle[k] = s.corner[k] > kSafeExponent;
    o.x0[k] = ceil_int(within(s.u[k] - s.reach_x[k], 0, width));
    o.x1[k] = floor_int(within(s.u[k] + s.reach_x[k], -1, width - 1));
    o.y0[k] = ceil_int(within(s.v[k] - s.reach_y[k], -kFar, height));
    o.top[k] = o.y0[k] > 0 ? o.y0[k] : 0;
    o.bottom[k] = floor_int(within(s.v[k] + s.reach_y[k], -1, height - 1));
    o.dx[k] = static_cast<float>(o.x0[k] - s.u[k]);
    o.dy[k] = static_cast<float>(o.y0[k] - s.v[k]);
  }
  for (int k = 0; k < kBlock; k += kWidest) store<kWidest>(o.ratio + k, exp2<kWidest>(-2 * load<kWidest>(o.c + k)));
}

HOLO_INLINE Patch patch_of(const Spread& s, const Outline& o, int k) {
  Patch p;
  p.a = o.a[k], p.b = o.b[k], p.c = o.c[k], p.ratio = o.ratio[k], p.faint = 0;
  p.x0 = o.x0[k], p.x1 = o.x1[k], p.y0 = o.y0[k], p.dx = o.dx[k], p.dy = o.dy[k];
  p.needle = o.needle[k];
  p.u = s.u[k], p.v = s.v[k], p.slope = s.slope[k], p.down = o.down[k];
  return p;
}

// A row of pixels in memory: room for a vector past its end, and no stride near a power of two, whose rows would
// fight for the same cache lines.
inline int64_t row_stride(int64_t width, int64_t channels) {
  int64_t stride = (width + 31) / 16 * 16;
  while (stride * channels % 128 == 0) stride += 16;
  return stride;
}

inline std::unique_ptr<float[]> buffer(int64_t floats) { return std::unique_ptr<float[]>(new float[floats]); }

// Copies [channels] planes of height × width pixels from or to C-contiguous planes `plane` apart.
inline void pad_rows(const float* from, int64_t plane, int64_t channels, int64_t height, int64_t width, Raster to) {
  for (int64_t y = 0; y < height; ++y)
    for (int64_t c = 0; c < channels; ++c) {
      float* row = to.at(y, 0) + c * to.channel;
      std::copy_n(from + c * plane + y * width, width, row);
      std::fill_n(row + width, 16, 0.0f);
    }
}

inline void crop_rows(Raster from, int64_t channels, int64_t height, int64_t width, float* to, int64_t plane) {
  for (int64_t y = 0; y < height; ++y)
    for (int64_t c = 0; c < channels; ++c)
      std::copy_n(from.at(y, 0) + c * from.channel, width, to + c * plane + y * width);
}

}  // namespace holo
