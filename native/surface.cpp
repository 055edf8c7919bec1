// Thickness of closed surfaces along the beam, line by line.
//
// A line of constant row cuts a triangle in a segment whose depth is linear in the column. Over a closed surface the
// segments' ends meet, and the thickness along the line is the sum of their depths, taken positive where the beam
// leaves and negative where it enters. Each segment is integrated exactly over the pixels that it crosses.

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
