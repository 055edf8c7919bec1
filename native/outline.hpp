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
  float a[kBlock], b[kBlock], c[kBlock], ratio[kBlock], down[kBlock];  // as in Patch and Crest
  float dx[kBlock], dy[kBlock], lift[kBlock], step[kBlock];
  int x[kBlock], y[kBlock], begin[kBlock], end[kBlock];  // as in Patch; empty if end < begin
  int top[kBlock], bottom[kBlock];  // rows, cut to the raster
  int needle[kBlock];
};

// Largest integer <= x, for |x| < 2^31, in operations every instruction set can vectorise.
HOLO_INLINE int floor_int(double x) {
  const int cut = static_cast<int>(x);
  return cut - (x < cut);
}
HOLO_INLINE int ceil_int(double x) { return -floor_int(-x); }
// Not a number becomes `low`.
HOLO_INLINE double within(double x, double low, double high) {
  const double above = x > low ? x : low;
  return above < high ? above : high;
}

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

// 2^x for 0 <= x <= 4, relative error below 1e-9; in steps that a compiler vectorises.
HOLO_INLINE double grow(double x) {
  const double y = 0.086643397569993164 * x;  // ln 2 / 8, and Taylor's series for exp(y)
  double e = fused(1.0 / 40320, y, 1.0 / 5040);
  e = fused(e, y, 1.0 / 720);
  e = fused(e, y, 1.0 / 120);
  e = fused(e, y, 1.0 / 24);
  e = fused(e, y, 1.0 / 6);
  e = fused(e, y, 0.5);
  e = fused(e, y, 1.0);
  e = fused(e, y, 1.0);
  const double squared = e * e, fourth = squared * squared;
  return fourth * fourth;
}

// The recurrence multiplies with a ratio in single precision, again and again. Changes `c` to that of the Gaussian
// whose ratio it exactly is, or nearly: what is far from the mean is off a little then, not what is far from the start.
HOLO_INLINE double exact_for(float ratio, double c) {
  const double excess = fused(ratio, grow(-2 * c), -1.0);
  return c > -2 ? c + kHalfLog2E * excess : c;
}

// The fast kernels must draw the reference's boxes exactly: `reference._boxes` defines these roundings.
// Columns count from a multiple of `align`, a power of two.
inline void outline(const Spread& __restrict s, int width, int height, int align, Outline& __restrict o) {
  constexpr double kFar = 1 << 30, kHuge = 1e300;
  const auto c_of = [&](int k) { return -kHalfLog2E * (s.down[k] + s.across[k] * s.slope[k] * s.slope[k]); };
  for (int k = 0; k < kBlock; ++k) o.ratio[k] = static_cast<float>(2 * c_of(k));
  for (int k = 0; k < kBlock; k += kWidest) store<kWidest>(o.ratio + k, fade<kWidest>(load<kWidest>(o.ratio + k)));
  for (int k = 0; k < kBlock; ++k) {
    const double a = -kHalfLog2E * s.across[k], down = -kHalfLog2E * s.down[k];
    o.a[k] = static_cast<float>(a);
    o.b[k] = static_cast<float>(-2 * a * s.slope[k]);
    o.c[k] = static_cast<float>(exact_for(o.ratio[k], c_of(k)));
    o.down[k] = static_cast<float>(down);
    o.needle[k] = s.corner[k] > kSafeExponent;
    const int x0 = ceil_int(within(s.u[k] - s.reach_x[k], 0, width));
    o.x[k] = x0 & -align;
    o.begin[k] = x0 - o.x[k];
    const double last = s.corner[k] < kHuge ? s.u[k] + s.reach_x[k] : -1;  // no numbers have no box
    o.end[k] = floor_int(within(last, -1, width - 1)) - o.x[k];
    o.y[k] = ceil_int(within(s.v[k] - s.reach_y[k], -kFar, height));
    o.top[k] = o.y[k] > 0 ? o.y[k] : 0;
    o.bottom[k] = floor_int(within(s.v[k] + s.reach_y[k], -1, height - 1));
    o.dx[k] = static_cast<float>(o.x[k] - s.u[k]);
    const float c = o.c[k], dy = static_cast<float>(o.y[k] - s.v[k]);
    o.dy[k] = dy, o.lift[k] = c * dy, o.step[k] = c * (2 * dy + 1);
  }
}

HOLO_INLINE Patch patch_of(const Outline& o, int k) {
  return {o.a[k], o.b[k], o.c[k], o.ratio[k], 0, o.dx[k], o.dy[k], o.x[k], o.y[k], o.begin[k], o.end[k]};
}

// Whether peaks can be drawn. (Only the kernels' callers are to blame for those that cannot.)
template <int C>
HOLO_INLINE bool all_finite(const float* peak) {
  bool finite = true;
  for (int c = 0; c < C; ++c) finite &= std::isfinite(peak[c]);
  return finite;
}

// The rows first … last of a patch.
template <int C>
HOLO_INLINE void set_rows(const Outline& o, int k, int first, int last, Job<C>& job) {
  job.first = first, job.last = last;
  job.start = {o.dy[k], o.lift[k], o.step[k]};
  if (first - o.y[k] >= kRestart) job.start = anchor_at(job.patch, anchor(job.patch, first));
}

HOLO_INLINE Crest crest_of(const Spread& s, const Outline& o, int k) {
  return {o.needle[k] != 0, o.down[k], s.u[k], s.v[k], s.slope[k]};
}

// A row of pixels in memory: room for a vector past its end, and no stride near a power of two, whose rows would
// fight for the same cache lines.
inline int64_t row_stride(int64_t width, int64_t channels) {
  int64_t stride = (width + 31) / 16 * 16;
  while (stride * channels % 128 == 0) stride += 16;
  return stride;
}

// Numbers that are not set yet and start with a cache line, so that every row does.
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(int64_t floats) : memory_(new float[floats + 15]) {
    start_ = memory_.get() + (-reinterpret_cast<uintptr_t>(memory_.get()) % 64) / sizeof(float);
  }
  float* get() const { return start_; }

 private:
  std::unique_ptr<float[]> memory_;
  float* start_ = nullptr;
};

inline Buffer zeros(int64_t floats) {
  Buffer memory(floats);
  std::fill_n(memory.get(), floats, 0.0f);
  return memory;
}

// Copies [channels] planes of height × width pixels, `plane` apart, onto a raster.
inline void pad_rows(const float* from, int64_t plane, int64_t channels, int64_t height, int64_t width, Raster to) {
  for (int64_t y = 0; y < height; ++y)
    for (int64_t c = 0; c < channels; ++c) {
      float* row = to.at(y, 0) + c * to.strides.channel;
      std::copy_n(from + c * plane + y * width, width, row);
      std::fill_n(row + width, 16, 0.0f);
    }
}

// Takes them off a raster, and leaves zeros behind, while they are at hand, for the next to draw on.
inline void take_rows(Raster from, int64_t channels, int64_t height, int64_t width, float* to, int64_t plane) {
  for (int64_t y = 0; y < height; ++y)
    for (int64_t c = 0; c < channels; ++c) {
      float* row = from.at(y, 0) + c * from.strides.channel;
      std::copy_n(row, width, to + c * plane + y * width);
      std::fill_n(row, width, 0.0f);
    }
}

}  // namespace holo
