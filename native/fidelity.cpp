// How alike predicted and measured frames are: L1 and SSIM (Wang et al. 2004, eq. 13) with its derivative, in one pass.
//
// With the local mean u and variance v of the measured frame b known, the kernel works on the difference d = a - b:
// what is small stays a small number, where E[a^2] - E[a]^2 would drown it in rounding. The moments under the window
// are m = E[d], s = E[d^2], x = E[d (b - 1/2)]; with var = s - m^2 and cov = x - m (u - 1/2),
//   1 - SSIM = p + q - p q,  p = m^2 / ((u + m)^2 + u^2 + C1),  q = var / (2 v + 2 cov + var + C2).
// The derivative with respect to a pixel is w * D_m + 2 d (w * D_s) + (b - 1/2) (w * D_x): the derivatives of that
// map, zero outside of it, under the transposed window, which is the window itself.
//
// Rows go in blocks: filters along y first, where a block shares the rows it reads, then those along x.

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "abi.hpp"
#include "simd.hpp"
#include "threads.hpp"

namespace {

constexpr int kTaps = 11, kHalo = kTaps - 1;
constexpr double kSigma = 1.5;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

constexpr int kLanes = holo::kWidest;
using F = holo::Floats<kLanes>;
constexpr int kRows = 8;   // in a block: as many as AVX-512 has registers for, with the halo
constexpr int kRing = 32;  // rows that are kept: a block and its halo, up to a power of two
constexpr int kLead = 16;  // zeros left of a row of derivatives

HOLO_INLINE F fma(F a, F b, F c) { return holo::fused<kLanes>(a, b, c); }

struct Window {  // of the taps 0 … 5, which the others mirror
  double tap[kHalo / 2 + 1];

  Window() {
    double sum = 0.0;
    for (int k = 0; k < kTaps; ++k) {
      const double z = (k - kHalo / 2) / kSigma, weight = std::exp(-0.5 * z * z);
      sum += weight;
      if (k <= kHalo / 2) tap[k] = weight;
    }
    for (double& weight : tap) weight /= sum;
  }
};

struct Weights {  // the same, as vectors
  F tap[kHalo / 2 + 1];

  explicit Weights(const Window& w) {
    for (int k = 0; k <= kHalo / 2; ++k) tap[k] = holo::fill<kLanes>(static_cast<float>(w.tap[k]));
  }
};

// The window over x[0] … x[10]: equal weights share a product.
HOLO_INLINE F windowed(const Weights& w, const F* x) {
  F sum = x[5] * w.tap[5];
#pragma GCC unroll 8
  for (int k = 0; k < 5; ++k) sum = fma(x[k] + x[10 - k], w.tap[k], sum);
  return sum;
}

// A vector from p[K] on, where `p` is aligned. Loads across cache lines are slow, and so are shuffles: half of each
// keeps both ports busy.
template <int K>
HOLO_INLINE F shifted(const float* p) {
#if defined(__AVX512F__)
  if constexpr (K % 2 != 0)
    return (F)_mm512_alignr_epi32((__m512i)holo::load<16>(p + 16), (__m512i)holo::load<16>(p), K);
#endif
  return holo::load<kLanes>(p + K);
}

template <int First, int... K>
HOLO_INLINE F across(const Weights& w, const float* p, std::integer_sequence<int, K...>) {
  const F x[] = {shifted<First + K>(p)...};
  return windowed(w, x);
}

// The window along x, from p[First] on.
template <int First>
HOLO_INLINE F across(const Weights& w, const float* p) {
  return across<First>(w, p, std::make_integer_sequence<int, kTaps>());
}

// The first `n` floats, then zeros.
HOLO_INLINE F load_some(const float* p, int64_t n) {
  if (n >= kLanes) return holo::load<kLanes>(p);
  F v{};
  std::memcpy(&v, p, static_cast<size_t>(n) * sizeof(float));
  return v;
}

HOLO_INLINE void store_some(float* p, F v, int64_t n) {
  std::memcpy(p, &v, static_cast<size_t>(std::min<int64_t>(n, kLanes)) * sizeof(float));
}

// The lanes below `n` of a vector, zero elsewhere.
HOLO_INLINE F keep_some(F v, int64_t n) {
  return n >= kLanes ? v : holo::keep<kLanes>(holo::lanes<kLanes>() < static_cast<int32_t>(n), v);
}

// A sum of many floats, in double: sixteen vectors at a time.
class Sum {
 public:
  HOLO_INLINE void add(F v) {
    part_ += v;
    if (++count_ % 16 == 0) flush();
  }
  double total() {
    flush();
    double sum = 0.0;
    for (int k = 0; k < kLanes; ++k) sum += lanes_[k];
    return sum;
  }

 private:
  typedef double D __attribute__((vector_size(kLanes * sizeof(double))));

  HOLO_INLINE void flush() {
    lanes_ += __builtin_convertvector(part_, D);
    part_ = F{};
  }

  D lanes_{};
  F part_{};
  int64_t count_ = 0;
};

struct Moments {  // of the difference under the window, or derivatives with respect to them
  F mean, square, cross;
};

// 1 - SSIM for the moments `t` and the target's local mean and variance; t <- its derivatives.
HOLO_INLINE F dissimilarity(F mean, F variance, Moments& t) {
  const F zero{}, one = zero + 1.0f, centred = mean - 0.5f, mean_a = mean + t.mean;
  const F square = t.mean * t.mean, spread = t.square - square;
  const F var = spread > zero ? spread : zero;
  const F total = fma(zero + 2.0f, variance + fma(-t.mean, centred, t.cross), var);
  const F m = fma(mean_a, mean_a, fma(mean, mean, zero + kC1));
  const F n = (total > zero ? total : zero) + kC2;
  const F per_m = one / m, per_n = one / n;  // one division for both would overflow where neither does
  const F p = square * per_m, q = var * per_n, one_p = one - p, one_q = one - q, scale = one_p * per_n;
  const F slope_p = one_q * per_m * fma(-p, mean_a, t.mean);
  const F slope_q = scale * fma(q, t.mean + centred, -t.mean);
  t = {2.0f * (slope_p + slope_q), scale * one_q, -2.0f * scale * q};
  return fma(q, one_p, p);
}

// Rows of a few maps, zero at first; `count` of them, a power of two, are kept.
class Ring {
 public:
  Ring(int64_t count, int64_t maps, int64_t stride)
      : count_(count), maps_(maps), stride_(stride), data_(count * maps * stride + 16) {
    first_ = data_.data() + (-reinterpret_cast<uintptr_t>(data_.data()) / sizeof(float)) % 16;
  }
  Ring(const Ring&) = delete;
  HOLO_INLINE float* row(int64_t map, int64_t y) { return first_ + ((y & (count_ - 1)) * maps_ + map) * stride_; }

 private:
  int64_t count_, maps_, stride_;
  std::vector<float> data_;
  float* first_;
};

// One view, with the arrays of one task that works on some of its rows.
class Band {
 public:
  Band(const HoloTarget& t, int64_t view, const float* predicted, float* gradient)
      : width_(t.width), rows_(t.height - kHalo), columns_(t.width - kHalo),
        predicted_(predicted + view * t.height * t.width), frame_(t.frames + view * t.height * t.width),
        mean_(t.statistics + 2 * view * rows_ * columns_), variance_(mean_ + rows_ * columns_),
        gradient_(gradient ? gradient + view * t.height * t.width : nullptr),
        scale_(holo::fill<kLanes>(static_cast<float>(1 / t.span))),
        offset_(holo::fill<kLanes>(static_cast<float>(-t.low / t.span - 0.5))),
        gradient_scale_(holo::fill<kLanes>(static_cast<float>(1 / (t.span * rows_ * columns_)))),
        weights_(Window()), stride_((t.width + 15) / 16 * 16 + 3 * 16), input_(kRing, 2, stride_),
        moments_(kRows, 3, stride_), slopes_(gradient ? kRing : 0, 3, stride_),
        spread_(gradient ? kRows : 0, 3, stride_) {}

  // Rows first … last - 1: the sums [H, 2] of |d| and 1 - SSIM over each, and the gradient.
  void run(int64_t first, int64_t last, double* sums) {
    const int64_t start = std::max<int64_t>(0, first - kHalo);  // the gradient sees the maps of the rows above
    int64_t read_to = start;
    for (int64_t y = start; y < last; y += kRows) {
      for (; read_to < std::min(y + kRows, last) + kHalo && read_to < rows_ + kHalo; ++read_to) {
        const double sum = read(read_to);
        if (read_to >= first && read_to < last) sums[2 * read_to] = sum;
      }
      const int64_t count = std::min<int64_t>(kRows, last - y), maps = std::clamp<int64_t>(rows_ - y, 0, count);
      if (maps > 0) filter_moments(y);
      for (int64_t k = 0; k < maps; ++k) {
        const double sum = compare(y + k, moments_.row(0, k));
        if (y + k >= first) sums[2 * (y + k) + 1] = sum;
      }
      if (gradient_) differentiate(y, maps, std::max<int64_t>(0, first - y), count);
    }
  }

 private:
  // input <- d and b - 1/2 of a row; returns the sum of |d|.
  double read(int64_t y) {
    const float *p = predicted_ + y * width_, *f = frame_ + y * width_;
    float *d = input_.row(0, y), *b = input_.row(1, y);
    Sum sum;
    for (int64_t x = 0; x < width_; x += kLanes) {
      const F measured = load_some(f + x, width_ - x), difference = (load_some(p + x, width_ - x) - measured) * scale_;
      holo::store<kLanes>(d + x, difference);
      holo::store<kLanes>(b + x, fma(measured, scale_, offset_));
      sum.add(difference < 0.0f ? -difference : difference);
    }
    return sum.total();
  }

  // moments <- those of rows y … y + kRows - 1, filtered along y.
  void filter_moments(int64_t y) {
    const float *d[kRows + kHalo], *b[kRows + kHalo];
    for (int k = 0; k < kRows + kHalo; ++k) d[k] = input_.row(0, y + k), b[k] = input_.row(1, y + k);
    float* to = moments_.row(0, 0);
    for (int64_t x = 0; x < width_; x += kLanes) {
      down(to + x, [&](int k) { return holo::load<kLanes>(d[k] + x); });
      down(to + stride_ + x, [&](int k) { return holo::load<kLanes>(d[k] + x) * holo::load<kLanes>(d[k] + x); });
      down(to + 2 * stride_ + x, [&](int k) { return holo::load<kLanes>(d[k] + x) * holo::load<kLanes>(b[k] + x); });
    }
  }

  // A block of rows filtered along y, from vectors row(0) … row(kRows + kHalo - 1).
  template <class Row>
  HOLO_INLINE void down(float* to, const Row& row) const {
    F v[kRows + kHalo];
#pragma GCC unroll 32
    for (int k = 0; k < kRows + kHalo; ++k) v[k] = row(k);
#pragma GCC unroll 32
    for (int k = 0; k < kRows; ++k) holo::store<kLanes>(to + k * 3 * stride_, windowed(weights_, v + k));
  }

  // The sum of row y of the map of 1 - SSIM, from its moments; slopes <- the derivatives, if wanted.
  double compare(int64_t y, const float* from) {
    const float *mean = mean_ + y * columns_, *variance = variance_ + y * columns_;
    float* to = gradient_ ? slopes_.row(0, y) + kLead : nullptr;
    Sum sum;
    for (int64_t x = 0; x < columns_; x += kLanes) {
      const int64_t left = columns_ - x;
      Moments t = {across<0>(weights_, from + x), across<0>(weights_, from + stride_ + x),
                   across<0>(weights_, from + 2 * stride_ + x)};
      sum.add(keep_some(dissimilarity(load_some(mean + x, left), load_some(variance + x, left), t), left));
      if (!to) continue;
      holo::store<kLanes>(to + x, keep_some(t.mean, left));
      holo::store<kLanes>(to + stride_ + x, keep_some(t.square, left));
      holo::store<kLanes>(to + 2 * stride_ + x, keep_some(t.cross, left));
    }
    return sum.total();
  }

  // The gradient of rows y + first … y + count - 1, where the map ends after `maps` rows.
  void differentiate(int64_t y, int64_t maps, int64_t first, int64_t count) {
    for (int64_t k = maps; k < kRows; ++k) std::fill_n(slopes_.row(0, y + k), 3 * stride_, 0.0f);
    if (first >= count) return;
    const float* from[kRows + kHalo];
    for (int k = 0; k < kRows + kHalo; ++k) from[k] = slopes_.row(0, y - kHalo + k) + kLead;
    for (int map = 0; map < 3; ++map) {
      const int64_t at = map * stride_;
      float* to = spread_.row(map, 0) + kLead;
      for (int64_t x = 0; x < columns_; x += kLanes)
        down(to + x, [&](int k) { return holo::load<kLanes>(from[k] + at + x); });
    }
    for (int64_t k = first; k < count; ++k) gather(y + k, spread_.row(0, k));
  }

  // The gradient of a row from the derivatives that were filtered along y.
  void gather(int64_t y, const float* from) {
    constexpr int kFirst = kLead - kHalo;
    const float *d = input_.row(0, y), *b = input_.row(1, y);
    float* to = gradient_ + y * width_;
    for (int64_t x = 0; x < width_; x += kLanes) {
      const F mean = across<kFirst>(weights_, from + x), square = across<kFirst>(weights_, from + stride_ + x);
      const F cross = across<kFirst>(weights_, from + 2 * stride_ + x), difference = holo::load<kLanes>(d + x);
      const F sum = fma(difference + difference, square, fma(holo::load<kLanes>(b + x), cross, mean));
      store_some(to + x, sum * gradient_scale_, width_ - x);
    }
  }

  int64_t width_, rows_, columns_;
  const float *predicted_, *frame_, *mean_, *variance_;
  float* gradient_;
  F scale_, offset_, gradient_scale_;
  Weights weights_;
  int64_t stride_;
  Ring input_, moments_, slopes_, spread_;
};

// Calls work(view, first, last) for bands of rows of all views: a few for each thread, and long beside their halo.
template <class Work>
void over_bands(const HoloTarget& t, int64_t threads, const Work& work) {
  const int64_t wanted = t.count * t.height / (4 * threads) + 1;
  const int64_t bands = std::max<int64_t>(1, t.height / std::max<int64_t>(wanted, 8 * kHalo));
  holo::parallel(t.count * bands, threads, [&](int64_t task) {
    const int64_t view = task / bands, band = task % bands;
    work(view, t.height * band / bands, t.height * (band + 1) / bands);
  });
}

// The local moments of `frame` for one row of windows, in double.
void local_moments(const HoloTarget& t, const Window& w, const float* frame, float* mean, float* variance) {
  const int64_t columns = t.width - kHalo;
  std::vector<double> first(t.width), second(t.width);
  const auto tap = [&](int k) { return w.tap[std::min(k, kHalo - k)]; };
  for (int k = 0; k < kTaps; ++k)
    for (int64_t x = 0; x < t.width; ++x) {
      const double b = (frame[k * t.width + x] - t.low) / t.span - 0.5;
      first[x] += tap(k) * b;
      second[x] += tap(k) * b * b;
    }
  for (int64_t x = 0; x < columns; ++x) {
    double m = 0.0, s = 0.0;
    for (int k = 0; k < kTaps; ++k) m += tap(k) * first[x + k], s += tap(k) * second[x + k];
    mean[x] = static_cast<float>(m + 0.5);
    variance[x] = static_cast<float>(std::max(s - m * m, 0.0));
  }
}

}  // namespace

int64_t holosplat_fidelity_statistics(const HoloTarget* target, float* statistics, int64_t threads) {
  return holo::guarded([&] {
    const HoloTarget& t = *target;
    const Window w;
    const int64_t rows = t.height - kHalo, columns = t.width - kHalo;
    holo::parallel_runs(t.count * rows, 16, threads, [&](int64_t first, int64_t last) {
      for (int64_t row = first; row < last; ++row) {
        const int64_t view = row / rows, y = row % rows;
        float* mean = statistics + (2 * view * rows + y) * columns;
        local_moments(t, w, t.frames + (view * t.height + y) * t.width, mean, mean + rows * columns);
      }
    });
  });
}

int64_t holosplat_fidelity(const HoloTarget* target, const float* predicted, double* values, float* gradient,
                           int64_t threads) {
  return holo::guarded([&] {
    const HoloTarget& t = *target;
    std::vector<double> sums(static_cast<size_t>(2 * t.count * t.height));
    over_bands(t, threads, [&](int64_t view, int64_t first, int64_t last) {
      Band(t, view, predicted, gradient).run(first, last, sums.data() + 2 * view * t.height);
    });
    const double windows = static_cast<double>((t.height - kHalo) * (t.width - kHalo));
    for (int64_t view = 0; view < t.count; ++view) {
      double l1 = 0.0, ssim = 0.0;  // in the order of the rows: the same whatever the bands
      for (int64_t y = 0; y < t.height; ++y) {
        l1 += sums[2 * (view * t.height + y)];
        ssim += sums[2 * (view * t.height + y) + 1];
      }
      values[2 * view] = l1 / static_cast<double>(t.height * t.width);
      values[2 * view + 1] = ssim / windows;
    }
  });
}

int64_t holosplat_fidelity_backward(const HoloTarget* target, const float* predicted, const float* upstream,
                                    const float* gradient, float* out, int64_t threads) {
  return holo::guarded([&] {
    const HoloTarget& t = *target;
    const int64_t pixels = t.height * t.width, run = 1 << 15, runs = (pixels + run - 1) / run;
    holo::parallel(t.count * runs, threads, [&](int64_t task) {
      const int64_t view = task / runs, first = view * pixels + task % runs * run;
      const int64_t last = std::min(first + run, (view + 1) * pixels);
      const float step = static_cast<float>(upstream[2 * view] / (t.span * pixels)), slope = upstream[2 * view + 1];
      for (int64_t i = first; i < last; ++i) {
        const float a = predicted[i], b = t.frames[i], sign = a > b ? step : a < b ? -step : 0.0f;
        out[i] = slope * gradient[i] + sign;
      }
    });
  });
}
