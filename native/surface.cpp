// Thickness of closed surfaces along the beam, line by line.
//
// A line of constant row cuts a triangle in a segment whose depth is linear in the column. Over a closed surface the
// segments' ends meet, and the thickness along the line is the sum of their depths, taken positive where the beam
// leaves and negative where it enters. Each segment is integrated exactly over the pixels that it crosses.
//
// The derivative by a pose is the surface integral of G λ n (Hadamard's formula, see the Python package), G the image of
// derivatives, λ n the motion of the surface along its normal, on three points of equal weight a triangle.

#include <algorithm>
#include <cmath>

#include "abi.hpp"
#include "threads.hpp"

namespace {

struct Point {
  double column, row, depth;
};

// Where the edge from `low` up to `high` meets the line at `row`; the same numbers for both triangles of an edge.
Point crossing(const Point& low, const Point& high, double row) {
  const double share = (row - low.row) / (high.row - low.row);
  return {low.column + share * (high.column - low.column), row, low.depth + share * (high.depth - low.depth)};
}

// Adds the integrals of the depth over the pixels of one image row, times `weight`.
void integrate(Point a, Point b, double weight, double* row, int64_t width) {
  if (a.column > b.column) std::swap(a, b);
  const double length = b.column - a.column;
  if (!(length > 0)) return;
  const double slope = (b.depth - a.depth) / length;
  const double last = std::min(b.column, width - 0.5);
  double left = std::max(a.column, -0.5);
  for (int64_t j = static_cast<int64_t>(std::floor(left + 0.5)); left < last; ++j) {
    const double right = std::min(last, j + 0.5);
    if (j < width) row[j] += weight * (right - left) * (a.depth + slope * (0.5 * (left + right) - a.column));
    left = right;
  }
}

void draw(const Point& a, const Point& b, const Point& c, int64_t lines, double* image, int64_t height,
          int64_t width) {
  const double area = (b.column - a.column) * (c.row - a.row) - (b.row - a.row) * (c.column - a.column);
  if (area == 0) return;
  const Point *low = &a, *middle = &b, *high = &c;
  if (middle->row < low->row) std::swap(low, middle);
  if (high->row < middle->row) std::swap(middle, high);
  if (middle->row < low->row) std::swap(low, middle);
  // Line s lies at row (s + 1/2) / lines - 1/2; a line through a vertex counts with what is above it (half-open).
  const auto line = [&](double row) {
    return static_cast<int64_t>(std::clamp(std::ceil((row + 0.5) * lines - 0.5), 0.0, double(height * lines)));
  };
  const double weight = (area > 0 ? 1.0 : -1.0) / lines;
  const int64_t last = std::min(line(high->row) + 1, height * lines);  // `line` may be off by its rounding
  for (int64_t s = std::max<int64_t>(line(low->row) - 1, 0); s < last; ++s) {
    const double row = (s + 0.5) / lines - 0.5;
    if (row < low->row || row >= high->row) continue;
    const Point one = crossing(*low, *high, row);
    const Point other = row < middle->row ? crossing(*low, *middle, row) : crossing(*middle, *high, row);
    integrate(one, other, weight, image + (s / lines) * width, width);
  }
}

// The image at (column, row), linear between the pixels' centres and zero beyond them. A single row or column stands
// for all.
double interpolated(const double* image, int64_t height, int64_t width, double column, double row) {
  if (width == 1) column = 0;
  if (height == 1) row = 0;
  if (!(column > -1 && column < width && row > -1 && row < height)) return 0;
  const auto j = static_cast<int64_t>(std::floor(column)), i = static_cast<int64_t>(std::floor(row));
  const double a = column - j, b = row - i;
  const auto at = [&](int64_t y, int64_t x) {
    return y < 0 || y >= height || x < 0 || x >= width ? 0.0 : image[y * width + x];
  };
  return (1 - b) * ((1 - a) * at(i, j) + a * at(i, j + 1)) + b * ((1 - a) * at(i + 1, j) + a * at(i + 1, j + 1));
}

struct PoseGradient {
  double rotation[3][3], position[3];  // by the rotation, and by a common motion in the lab frame
};

// Adds what one triangle, of these corners in the lab and in the object frame, has to say.
void add_triangle(const Point* const corner[3], const double* const vertex[3], const double* image, int64_t height,
                  int64_t width, PoseGradient& out) {
  const Point &a = *corner[0], &b = *corner[1], &c = *corner[2];
  const double u[3] = {b.column - a.column, b.row - a.row, b.depth - a.depth};
  const double v[3] = {c.column - a.column, c.row - a.row, c.depth - a.depth};
  const double normal[3] = {u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]};
  double share[3] = {};  // of the corners
  for (int q = 0; q < 3; ++q) {
    const Point &near = *corner[q], &one = *corner[(q + 1) % 3], &other = *corner[(q + 2) % 3];
    const double column = (4 * near.column + one.column + other.column) / 6;
    const double row = (4 * near.row + one.row + other.row) / 6;
    const double value = interpolated(image, height, width, column, row) / 36;
    for (int k = 0; k < 3; ++k) share[k] += k == q ? 4 * value : value;
  }
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) {
      out.position[i] += share[k] * normal[i];
      for (int j = 0; j < 3; ++j) out.rotation[i][j] += share[k] * normal[i] * vertex[k][j];
    }
}

}  // namespace

int64_t holosplat_surface(const HoloSurface* surface, const HoloRaster* raster, int64_t lines, double* image,
                          int64_t threads) {
  return holo::guarded([&] {
    const int64_t pixels = raster->height * raster->width;
    holo::parallel(raster->count, threads, [&](int64_t view) {
      const auto* points = reinterpret_cast<const Point*>(surface->points) + view * surface->vertices;
      double* out = image + view * pixels;
      std::fill(out, out + pixels, 0.0);
      for (int64_t f = 0; f < surface->faces; ++f) {
        const int64_t* corner = surface->corners + 3 * f;
        draw(points[corner[0]], points[corner[1]], points[corner[2]], lines, out, raster->height, raster->width);
      }
    });
  });
}

int64_t holosplat_surface_poses(const HoloSurface* surface, const HoloRaster* raster, const double* vertices,
                                const double* image_gradient, double* rotations, double* shifts, int64_t threads) {
  return holo::guarded([&] {
    const int64_t h = raster->height, w = raster->width;
    holo::parallel(raster->count, threads, [&](int64_t view) {
      const auto* points = reinterpret_cast<const Point*>(surface->points) + view * surface->vertices;
      PoseGradient sum{};
      for (int64_t f = 0; f < surface->faces; ++f) {
        const int64_t* at = surface->corners + 3 * f;
        const Point* const corner[3] = {points + at[0], points + at[1], points + at[2]};
        const double* const vertex[3] = {vertices + 3 * at[0], vertices + 3 * at[1], vertices + 3 * at[2]};
        add_triangle(corner, vertex, image_gradient + view * h * w, h, w, sum);
      }
      std::copy_n(&sum.rotation[0][0], 9, rotations + 9 * view);
      for (int i = 0; i < 2; ++i) shifts[2 * view + i] = -sum.position[i];
    });
  });
}
