// Line integrals of voxels, voxel by voxel: each is a bilinear hat on the detector, whose variance, 1/6 px^2, is that
// of a pixel-sized cube's shadow seen by a pixel. Any pose; the adjoint is exact, and so are the derivatives by poses.

#include <algorithm>
#include <cmath>
#include <vector>

#include "abi.hpp"
#include "threads.hpp"

namespace {

struct Axis {  // column and row of a voxel: start + z dz + y dy + x dx
  double start, dz, dy, dx;
};

struct Shadow {
  Axis column, row;
};

Shadow shadow_of(const HoloLattice& lattice, const HoloViews& views, int64_t v) {
  const double* r = views.rotations + 9 * v;
  const auto axis = [&](const double* row, double shift, int64_t count) {
    double start = -shift + 0.5 * static_cast<double>(count) - 0.5;
    for (int k = 0; k < 3; ++k) start += row[k] * lattice.origin[k];
    return Axis{start, row[2] * lattice.pitch[2], row[1] * lattice.pitch[1], row[0] * lattice.pitch[0]};
  };
  return {axis(r, views.shifts[2 * v], views.width), axis(r + 3, views.shifts[2 * v + 1], views.height)};
}

// Voxels of the row (z, y) whose four pixels all lie on the detector, where the loop needs no further check:
// [first, last) is found by solving both linear inequalities, give or take a millionth of a pixel.
struct Span {
  int64_t first, last;
  double column, row;  // of voxel 0
};

void narrow(double start, double step, double limit, double& low, double& high) {
  if (std::abs(step) < 1e-12) {
    if (start < 0 || start > limit) high = low - 1;  // empty
    return;
  }
  const double a = -start / step, b = (limit - start) / step;
  low = std::max(low, std::min(a, b));
  high = std::min(high, std::max(a, b));
}

Span span_of(const Shadow& s, const HoloLattice& lattice, const HoloViews& views, int64_t z, int64_t y) {
  const double column = s.column.start + z * s.column.dz + y * s.column.dy;
  const double row = s.row.start + z * s.row.dz + y * s.row.dy;
  const double slack = 1e-6;
  double low = 0.0, high = static_cast<double>(lattice.width) - 1;
  narrow(column + slack, s.column.dx, static_cast<double>(views.width) - 1 + 2 * slack, low, high);
  narrow(row + slack, s.row.dx, static_cast<double>(views.height) - 1 + 2 * slack, low, high);
  if (!(high >= low) || views.width < 2 || views.height < 2) return {0, 0, column, row};
  return {static_cast<int64_t>(std::ceil(low)), static_cast<int64_t>(std::floor(high)) + 1, column, row};
}

constexpr double kKink = 1e-6;  // pixels from a pixel's centre within which a voxel counts as lying on it

struct Slope {
  double column, row;  // derivatives of the interpolated image
};

// The slope at (column, row) of the bilinear function on the cell of pixels that `side` (pixels) leads to.
Slope slope_at(const float* image, const HoloViews& views, double column, double row, double side) {
  const auto cell = [side](double at, int64_t count) {
    return std::clamp<int64_t>(static_cast<int64_t>(std::floor(at + side)), 0, count - 2);
  };
  const int64_t j = cell(column, views.width), i = cell(row, views.height), w = views.width;
  const double a = column - j, b = row - i;
  const float* at = image + i * w + j;
  const double upper = double(at[1]) - at[0], lower = double(at[w + 1]) - at[w];
  const double left = double(at[w]) - at[0], right = double(at[w + 1]) - at[1];
  return {(1 - b) * upper + b * lower, (1 - a) * left + a * right};
}

struct Moments {  // sums of a derivative by one coordinate, and of that times the voxel's x, y, z index
  double all, x, y, z;

  void add(const Moments& other) {
    all += other.all, x += other.x, y += other.y, z += other.z;
  }
};

struct PoseMoments {
  Moments column, row;
};

PoseMoments moments_of_slice(const HoloLattice& lattice, const HoloViews& views, int64_t v, int64_t z,
                             const float* volume, const float* image) {
  const Shadow s = shadow_of(lattice, views, v);
  PoseMoments out{};
  for (int64_t y = 0; y < lattice.height; ++y) {
    const Span span = span_of(s, lattice, views, z, y);
    const float* values = volume + (z * lattice.height + y) * lattice.width;
    Slope sum{}, first{};
    for (int64_t x = span.first; x < span.last; ++x) {
      if (values[x] == 0.0f) continue;
      const double column = span.column + x * s.column.dx, row = span.row + x * s.row.dx;
      const Slope one = slope_at(image, views, column, row, kKink), other = slope_at(image, views, column, row, -kKink);
      const double by_column = 0.5 * values[x] * (one.column + other.column);
      const double by_row = 0.5 * values[x] * (one.row + other.row);
      sum.column += by_column, first.column += by_column * x;
      sum.row += by_row, first.row += by_row * x;
    }
    out.column.add({sum.column, first.column, sum.column * y, sum.column * z});
    out.row.add({sum.row, first.row, sum.row * y, sum.row * z});
  }
  return out;
}

void write_row(const HoloLattice& lattice, const Moments& m, double* rotation, double* shift) {
  const double index[3] = {m.x, m.y, m.z};
  for (int k = 0; k < 3; ++k) rotation[k] = lattice.origin[k] * m.all + lattice.pitch[k] * index[k];
  *shift = -m.all;
}

}  // namespace

int64_t holosplat_lattice_project(const HoloLattice* lattice, const HoloViews* views, const float* volume,
                                  float* image, int64_t threads) {
  return holo::guarded([&] {
    const int64_t pixels = views->height * views->width, w = views->width;
    holo::parallel(views->count, threads, [&](int64_t v) {
      float* out = image + v * pixels;
      std::fill(out, out + pixels, 0.0f);
      const Shadow s = shadow_of(*lattice, *views, v);
      for (int64_t z = 0; z < lattice->depth; ++z)
        for (int64_t y = 0; y < lattice->height; ++y) {
          const Span span = span_of(s, *lattice, *views, z, y);
          const float* values = volume + (z * lattice->height + y) * lattice->width;
          for (int64_t x = span.first; x < span.last; ++x) {
            if (values[x] == 0.0f) continue;
            const double column = span.column + x * s.column.dx, row = span.row + x * s.row.dx;
            const int64_t j = std::min(static_cast<int64_t>(column), views->width - 2);
            const int64_t i = std::min(static_cast<int64_t>(row), views->height - 2);
            const float a = static_cast<float>(column - j), b = static_cast<float>(row - i);
            float* at = out + i * w + j;
            const float lower = values[x] * b, upper = values[x] - lower;
            at[0] += upper * (1 - a);
            at[1] += upper * a;
            at[w] += lower * (1 - a);
            at[w + 1] += lower * a;
          }
        }
    });
  });
}

int64_t holosplat_lattice_backproject(const HoloLattice* lattice, const HoloViews* views, const float* image,
                                      float* volume, int64_t threads) {
  return holo::guarded([&] {
    const int64_t pixels = views->height * views->width, w = views->width;
    holo::parallel(lattice->depth, threads, [&](int64_t z) {
      float* slice = volume + z * lattice->height * lattice->width;
      std::fill(slice, slice + lattice->height * lattice->width, 0.0f);
      for (int64_t v = 0; v < views->count; ++v) {
        const Shadow s = shadow_of(*lattice, *views, v);
        const float* in = image + v * pixels;
        for (int64_t y = 0; y < lattice->height; ++y) {
          const Span span = span_of(s, *lattice, *views, z, y);
          float* values = slice + y * lattice->width;
          for (int64_t x = span.first; x < span.last; ++x) {
            const double column = span.column + x * s.column.dx, row = span.row + x * s.row.dx;
            const int64_t j = std::min(static_cast<int64_t>(column), views->width - 2);
            const int64_t i = std::min(static_cast<int64_t>(row), views->height - 2);
            const float a = static_cast<float>(column - j), b = static_cast<float>(row - i);
            const float* at = in + i * w + j;
            values[x] += (1 - b) * ((1 - a) * at[0] + a * at[1]) + b * ((1 - a) * at[w] + a * at[w + 1]);
          }
        }
      }
    });
  });
}

int64_t holosplat_lattice_poses(const HoloLattice* lattice, const HoloViews* views, const float* volume,
                                const float* image_gradient, double* rotations, double* shifts, int64_t threads) {
  return holo::guarded([&] {
    const int64_t pixels = views->height * views->width, slices = lattice->depth;
    std::vector<PoseMoments> found(views->count * slices);
    holo::parallel(views->count * slices, threads, [&](int64_t task) {
      const int64_t v = task / slices;
      found[task] = moments_of_slice(*lattice, *views, v, task % slices, volume, image_gradient + v * pixels);
    });
    for (int64_t v = 0; v < views->count; ++v) {
      PoseMoments sum{};
      for (int64_t z = 0; z < slices; ++z) {
        sum.column.add(found[v * slices + z].column);
        sum.row.add(found[v * slices + z].row);
      }
      write_row(*lattice, sum.column, rotations + 6 * v, shifts + 2 * v);
      write_row(*lattice, sum.row, rotations + 6 * v + 3, shifts + 2 * v + 1);
    }
  });
}
