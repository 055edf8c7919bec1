// The pointwise parts of the wave optics, and their adjoints; the Fourier transforms between them are the caller's.
//
// Everything works on pixels in any order, so tasks are runs of pixels or bands of rows, and nothing is shared.

#include <algorithm>
#include <vector>

#include "abi.hpp"
#include "threads.hpp"
#include "waves.hpp"

namespace holo {
namespace {

constexpr int64_t kRun = 4096;  // pixels a task: enough to pay for handing it out

// Calls visit(view, first pixel, number of pixels) for vectors of kWidest pixels, the last of a view being shorter.
template <class Visit>
void each_vector(int64_t views, int64_t pixels, int64_t threads, const Visit& visit) {
  const int64_t runs = (pixels + kRun - 1) / kRun;
  parallel(views * runs, threads, [&](int64_t task) {
    const int64_t view = task / runs, start = task % runs * kRun, end = std::min(pixels, start + kRun);
    for (int64_t i = start; i < end; i += kWidest) visit(view, i, std::min<int64_t>(kWidest, end - i));
  });
}

HOLO_INLINE Floats<kWidest> load_some(const float* from, int64_t count) {
  if (count == kWidest) return load<kWidest>(from);
  Floats<kWidest> v = {};
  std::memcpy(&v, from, count * sizeof(float));
  return v;
}

HOLO_INLINE void store_some(float* to, Floats<kWidest> v, int64_t count) {
  if (count == kWidest) return store<kWidest>(to, v);
  std::memcpy(to, &v, count * sizeof(float));
}

struct Refraction {  // of each channel: phase k delta and loss k beta per unit of line integral
  float phase[2], loss[2];
};

// Of each view, from [V, C, 2].
std::vector<Refraction> refraction_of(const HoloRaster& raster, const double* given) {
  std::vector<Refraction> all(static_cast<size_t>(raster.count));
  for (Refraction& r : all)
    for (int64_t c = 0; c < raster.channels; ++c, given += 2)
      r.phase[c] = static_cast<float>(given[0]), r.loss[c] = static_cast<float>(given[1]);
  return all;
}

// U - 1 of the exit wave U = exp(-loss - i phase).
template <int C>
HOLO_INLINE Wave<kWidest> scattered(const float* lines, int64_t plane, const Refraction& r, int64_t count) {
  Floats<kWidest> loss = {}, phase = {};
  for (int c = 0; c < C; ++c) {
    const Floats<kWidest> line = load_some(lines + c * plane, count);
    loss += r.loss[c] * line, phase += r.phase[c] * line;
  }
  return exit_wave_minus_one<kWidest>(-loss, phase);
}

template <int C>
void exit_wave(const HoloRaster& raster, const double* refraction, const float* lines, float* wave, int64_t threads) {
  const int64_t plane = raster.height * raster.width;
  const std::vector<Refraction> matter = refraction_of(raster, refraction);
  each_vector(raster.count, plane, threads, [&](int64_t view, int64_t i, int64_t count) {
    const Wave<kWidest> u = scattered<C>(lines + view * C * plane + i, plane, matter[view], count);
    store_some_waves(wave + 2 * (view * plane + i), u, count);
  });
}

// For a gradient g (of the real and of the imaginary part): Re(conj(dU/dT) g), dU/dT = -(loss + i phase) U.
template <int C>
void exit_wave_backward(const HoloRaster& raster, const double* refraction, const float* lines,
                        const float* wave_gradient, float* lines_gradient, int64_t threads) {
  const int64_t plane = raster.height * raster.width;
  const std::vector<Refraction> matter = refraction_of(raster, refraction);
  each_vector(raster.count, plane, threads, [&](int64_t view, int64_t i, int64_t count) {
    const int64_t at = view * C * plane + i;
    const Refraction& r = matter[view];
    Wave<kWidest> u = scattered<C>(lines + at, plane, r, count);
    u.re += 1.0f;
    const Wave<kWidest> g = load_some_waves<kWidest>(wave_gradient + 2 * (view * plane + i), count);
    const Floats<kWidest> along = u.re * g.re + u.im * g.im, across = u.re * g.im - u.im * g.re;
    for (int c = 0; c < C; ++c)
      store_some(lines_gradient + at + c * plane, -(r.loss[c] * along + r.phase[c] * across), count);
  });
}

// What the detector's pixels read: `factor` x `factor` samples each, `margin` samples in from the raster's border.
struct Crop {
  int64_t y, x, rows, columns, factor;
  explicit Crop(const HoloDetector& d)
      : y(d.margin_y), x(d.margin_x), rows(d.rows), columns(d.columns), factor(d.factor) {}
  bool row_inside(int64_t row) const { return row >= y && row < y + rows * factor; }
};

// frame <- 1 + the mean over each pixel's samples; contrast(row) gives a pointer to a raster row.
template <class Contrast>
void bin_row(const Crop& crop, const Contrast& contrast, int64_t pixel_row, float* frame) {
  const int64_t factor = crop.factor;
  if (factor == 1) {
    const float* samples = contrast(crop.y + pixel_row) + crop.x;
    for (int64_t j = 0; j < crop.columns; ++j) frame[j] = 1.0f + samples[j];
    return;
  }
  std::fill_n(frame, crop.columns, 0.0f);
  for (int64_t k = 0; k < factor; ++k) {
    const float* samples = contrast(crop.y + pixel_row * factor + k) + crop.x;
    for (int64_t i = 0; i < factor; ++i)
      for (int64_t j = 0; j < crop.columns; ++j) frame[j] += samples[j * factor + i];
  }
  const float share = 1.0f / static_cast<float>(factor * factor);
  for (int64_t j = 0; j < crop.columns; ++j) frame[j] = 1.0f + share * frame[j];
}

// samples <- what each sample of a raster row gives to its pixel's gradient; zero beyond the detector.
void spread_row(const Crop& crop, const float* gradient, int64_t row, int64_t width, float* samples) {
  std::fill_n(samples, width, 0.0f);
  if (!crop.row_inside(row)) return;
  const float* pixels = gradient + (row - crop.y) / crop.factor * crop.columns;
  if (crop.factor == 1) {
    std::copy_n(pixels, crop.columns, samples + crop.x);
    return;
  }
  const float share = 1.0f / static_cast<float>(crop.factor * crop.factor);
  for (int64_t j = 0; j < crop.columns; ++j)
    std::fill_n(samples + crop.x + j * crop.factor, crop.factor, share * pixels[j]);
}

// |1 + w|^2 - 1 of a row of waves.
void contrast_row(const float* wave, int64_t width, float* contrast) {
  for (int64_t x = 0; x < width; ++x) {
    const float re = wave[2 * x], im = wave[2 * x + 1];
    contrast[x] = 2 * re + (re * re + im * im);
  }
}

// wave <- 2 g (1 + wave), the gradient of a row whose contrast has the gradient g.
void contrast_row_backward(const float* g, int64_t width, float* wave) {
  for (int64_t x = 0; x < width; ++x) {
    const float twice = 2 * g[x];
    wave[2 * x] = twice * (1.0f + wave[2 * x]);
    wave[2 * x + 1] *= twice;
  }
}

// Rows of V views as tasks: work(view, row, scratch of `floats` floats).
template <class Work>
void each_row(int64_t views, int64_t rows, int64_t floats, int64_t threads, const Work& work) {
  const int64_t band = 16, bands = (rows + band - 1) / band;
  parallel(views * bands, threads, [&](int64_t task) {
    std::vector<float> scratch(static_cast<size_t>(floats));
    const int64_t view = task / bands, start = task % bands * band;
    for (int64_t row = start; row < std::min(rows, start + band); ++row) work(view, row, scratch.data());
  });
}

// As `each_row`, over complex images that hold one view, or two as real and imaginary part: work(image, first view,
// number of views in it, row, scratch of two rows).
template <class Work>
void each_image_row(const HoloDetector& d, int64_t rows, int64_t threads, const Work& work) {
  each_row((d.count + d.lanes - 1) / d.lanes, rows, 2 * d.width, threads,
           [&](int64_t image, int64_t row, float* scratch) {
             const int64_t view = image * d.lanes;
             work(image, view, std::min(d.lanes, d.count - view), row, scratch);
           });
}

// Two rows of real numbers, and one of complex ones.
void interleave(const float* re, const float* im, int64_t width, float* to) {
  for (int64_t x = 0; x < width; ++x) to[2 * x] = re[x], to[2 * x + 1] = im[x];
}
void separate(const float* from, int64_t width, float* re, float* im) {
  for (int64_t x = 0; x < width; ++x) re[x] = from[2 * x], im[x] = from[2 * x + 1];
}

}  // namespace
}  // namespace holo

using namespace holo;

int64_t holosplat_exit_wave(const HoloRaster* raster, const double* refraction, const float* lines, float* wave,
                            int64_t threads) {
  const auto run = raster->channels == 1 ? exit_wave<1> : exit_wave<2>;
  return guarded([&] { run(*raster, refraction, lines, wave, threads); });
}

int64_t holosplat_exit_wave_backward(const HoloRaster* raster, const double* refraction, const float* lines,
                                     const float* wave_gradient, float* lines_gradient, int64_t threads) {
  const auto run = raster->channels == 1 ? exit_wave_backward<1> : exit_wave_backward<2>;
  return guarded([&] { run(*raster, refraction, lines, wave_gradient, lines_gradient, threads); });
}

int64_t holosplat_transfer(const HoloRaster* raster, const float* rows, const float* columns, double scale,
                           int64_t conjugate, float* spectrum, int64_t threads) {
  const int64_t width = raster->width;
  return guarded([&] {
    each_row(raster->count, raster->height, 0, threads, [&](int64_t view, int64_t row, float*) {
      const float* factor = rows + 2 * (view * raster->height + row);
      const float re = static_cast<float>(scale) * factor[0], im = static_cast<float>(scale) * factor[1];
      const float sign = conjugate ? -1.0f : 1.0f, *column = columns + 2 * view * width;
      float* line = spectrum + 2 * (view * raster->height + row) * width;
      for (int64_t x = 0; x < width; ++x) {
        const float a = re * column[2 * x] - im * column[2 * x + 1];
        const float b = sign * (re * column[2 * x + 1] + im * column[2 * x]);
        const float u = line[2 * x], v = line[2 * x + 1];
        line[2 * x] = u * a - v * b, line[2 * x + 1] = u * b + v * a;
      }
    });
  });
}

int64_t holosplat_intensity(const HoloDetector* detector, const float* wave, float* frames, int64_t threads) {
  const HoloDetector& d = *detector;
  const Crop crop(d);
  return guarded([&] {
    each_row(d.count, d.rows, d.width, threads, [&](int64_t view, int64_t pixel_row, float* scratch) {
      const auto contrast = [&](int64_t row) {
        const int64_t used = crop.columns * crop.factor;
        contrast_row(wave + 2 * ((view * d.height + row) * d.width + crop.x), used, scratch + crop.x);
        return static_cast<const float*>(scratch);
      };
      bin_row(crop, contrast, pixel_row, frames + (view * d.rows + pixel_row) * d.columns);
    });
  });
}

int64_t holosplat_intensity_backward(const HoloDetector* detector, const float* frame_gradient, float* wave,
                                     int64_t threads) {
  const HoloDetector& d = *detector;
  const Crop crop(d);
  return guarded([&] {
    each_row(d.count, d.height, d.width, threads, [&](int64_t view, int64_t row, float* scratch) {
      spread_row(crop, frame_gradient + view * d.rows * d.columns, row, d.width, scratch);
      contrast_row_backward(scratch, d.width, wave + 2 * (view * d.height + row) * d.width);
    });
  });
}

int64_t holosplat_contrast(const HoloDetector* detector, const float* wave, float* images, int64_t threads) {
  const HoloDetector& d = *detector;
  return guarded([&] {
    each_image_row(d, d.height, threads, [&](int64_t image, int64_t view, int64_t views, int64_t row, float* scratch) {
      if (views == 1) std::fill_n(scratch + d.width, d.width, 0.0f);
      for (int64_t k = 0; k < views; ++k)
        contrast_row(wave + 2 * ((view + k) * d.height + row) * d.width, d.width, scratch + k * d.width);
      interleave(scratch, scratch + d.width, d.width, images + 2 * (image * d.height + row) * d.width);
    });
  });
}

int64_t holosplat_contrast_backward(const HoloDetector* detector, const float* images, float* wave, int64_t threads) {
  const HoloDetector& d = *detector;
  return guarded([&] {
    each_image_row(d, d.height, threads, [&](int64_t image, int64_t view, int64_t views, int64_t row, float* scratch) {
      separate(images + 2 * (image * d.height + row) * d.width, d.width, scratch, scratch + d.width);
      for (int64_t k = 0; k < views; ++k)
        contrast_row_backward(scratch + k * d.width, d.width, wave + 2 * ((view + k) * d.height + row) * d.width);
    });
  });
}

int64_t holosplat_bin(const HoloDetector* detector, const float* images, float* frames, int64_t threads) {
  const HoloDetector& d = *detector;
  const Crop crop(d);
  return guarded([&] {
    each_image_row(d, d.rows, threads, [&](int64_t image, int64_t view, int64_t views, int64_t row, float* scratch) {
      for (int64_t k = 0; k < views; ++k) {
        const auto contrast = [&](int64_t y) {
          separate(images + 2 * (image * d.height + y) * d.width, d.width, scratch, scratch + d.width);
          return static_cast<const float*>(scratch + k * d.width);
        };
        bin_row(crop, contrast, row, frames + ((view + k) * d.rows + row) * d.columns);
      }
    });
  });
}

int64_t holosplat_bin_backward(const HoloDetector* detector, const float* frame_gradient, float* images,
                               int64_t threads) {
  const HoloDetector& d = *detector;
  const Crop crop(d);
  return guarded([&] {
    each_image_row(d, d.height, threads, [&](int64_t image, int64_t view, int64_t views, int64_t row, float* scratch) {
      if (views == 1) std::fill_n(scratch + d.width, d.width, 0.0f);
      for (int64_t k = 0; k < views; ++k)
        spread_row(crop, frame_gradient + (view + k) * d.rows * d.columns, row, d.width, scratch + k * d.width);
      interleave(scratch, scratch + d.width, d.width, images + 2 * (image * d.height + row) * d.width);
    });
  });
}
