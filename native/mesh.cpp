// Depths of closed meshes, hit by hit: the mean over rays through each pixel.
//
// Rays sit at whole numbers of a lattice. Rows and spans are half open, and every edge is evaluated from its lower to
// its upper end, so that triangles of one edge compute the same crossing and each ray of a closed mesh is counted
// exactly once. The fits' `surface.cpp` integrates along rows instead, and shares nothing with this.

#include <algorithm>
#include <cmath>
#include <vector>

#include "abi.hpp"
#include "threads.hpp"

namespace {

constexpr int64_t kRunRows = 16;

struct Point {
  double column, row, depth;
};

struct Span {
  int64_t first, last;
};

// The whole numbers in [low, high) among 0 … count - 1; none where an end is no number.
inline Span half_open(double low, double high, int64_t count) {
  const auto whole = [count](double x) {
    return static_cast<int64_t>(std::max(0.0, std::min(std::ceil(x), double(count))));
  };
  const int64_t first = whole(low);
  return {first, std::max(first, whole(high))};
}

// The column at which the edge low → high crosses `row`.
inline double crossing(const Point& low, const Point& high, double row) {
  return low.column + (row - low.row) * ((high.column - low.column) / (high.row - low.row));
}

struct Triangle {
  Point a, low, middle, high;
  double per_column, per_row, area, least, most;

  explicit Triangle(const Point& a, const Point& b, const Point& c) : a(a), low(a), middle(b), high(c) {
    const Point ab{b.column - a.column, b.row - a.row, b.depth - a.depth};
    const Point ac{c.column - a.column, c.row - a.row, c.depth - a.depth};
    area = ab.column * ac.row - ab.row * ac.column;
    per_column = (ab.depth * ac.row - ab.row * ac.depth) / area;
    per_row = (ab.column * ac.depth - ab.depth * ac.column) / area;
    least = std::min({a.depth, b.depth, c.depth}), most = std::max({a.depth, b.depth, c.depth});
    const auto sort = [](Point& lower, Point& upper) {
      if (upper.row < lower.row) std::swap(lower, upper);
    };
    sort(low, middle), sort(middle, high), sort(low, middle);
  }

  Span columns(double row, int64_t count) const {
    const bool upper = row >= middle.row;
    const double one = crossing(low, high, row);
    const double other = crossing(upper ? middle : low, upper ? high : middle, row);
    return half_open(std::min(one, other), std::max(one, other), count);
  }

  double depth(double column, double row) const {
    return std::clamp(a.depth + per_column * (column - a.column) + per_row * (row - a.row), least, most);
  }
};

}  // namespace

int64_t holosplat_mesh_depths(const HoloSurface* mesh, const HoloRaster* raster, const double* values, int64_t rays,
                              double bent, double* image, int64_t threads) {
  return holo::guarded([&] {
    const int64_t height = raster->height, width = raster->width, channels = raster->channels;
    const auto* points = reinterpret_cast<const Point*>(mesh->points);
    const auto corner = [&](int64_t f, int64_t k) -> const Point& { return points[mesh->corners[3 * f + k]]; };
    std::vector<Span> rows(mesh->faces);
    for (int64_t f = 0; f < mesh->faces; ++f) {
      const auto [low, high] = std::minmax({corner(f, 0).row, corner(f, 1).row, corner(f, 2).row});
      rows[f] = half_open(low, high, rays * height);
    }
    std::fill(image, image + channels * height * width, 0.0);
    const double share = 1.0 / (rays * rays);
    holo::parallel_equal_runs(height, kRunRows, threads, [&](int64_t begin, int64_t end) {
      for (int64_t f = 0; f < mesh->faces; ++f) {
        const int64_t first = std::max(rows[f].first, rays * begin), last = std::min(rows[f].last, rays * end);
        if (first >= last) continue;
        const Triangle triangle(corner(f, 0), corner(f, 1), corner(f, 2));
        if (triangle.area == 0) continue;  // seen edge-on
        const double weight = triangle.area > 0 ? share : -share;
        for (int64_t row = first; row < last; ++row) {
          const auto [start, stop] = triangle.columns(row, rays * width);
          for (int64_t column = start; column < stop;) {
            const int64_t pixel = column / rays, next = std::min(stop, rays * (pixel + 1));
            double sum = 0;
            for (; column < next; ++column) {
              const double z = triangle.depth(column, row);
              sum += bent == 0 ? z : z / (1 - bent * z);
            }
            double* at = image + row / rays * width + pixel;
            for (int64_t c = 0; c < channels; ++c) at[c * height * width] += weight * sum * values[c * mesh->faces + f];
          }
        }
      }
    });
  });
}
