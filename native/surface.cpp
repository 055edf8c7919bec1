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

constexpr int64_t kRunFaces = 8192;

struct Point {
  double column, row, depth;
};

// An edge from its lower to its upper end: the same numbers for both of its triangles.
struct Edge {
  double column, row, depth, columns, depths;  // of the lower end; per row

  Edge(const Point& low, const Point& high) : column(low.column), row(low.row), depth(low.depth) {
    const double per_row = 1 / (high.row - low.row);  // of a level edge, which no line meets, no number
    columns = (high.column - low.column) * per_row, depths = (high.depth - low.depth) * per_row;
  }
};

// Adds the integrals of the depth, which is `from` at the column `left` and `to` at `right`, over the pixels of one
// image row, times `weight`.
inline void integrate(double left, double from, double right, double to, double weight, double* row, int64_t width) {
  const double length = right - left;
  if (!(length > 0)) return;
  double begin = std::max(left, -0.5);
  const double last = std::min(right, width - 0.5);
  int64_t j = static_cast<int64_t>(begin + 0.5);  // begin + 0.5 is not negative
  if (left == begin && right <= j + 0.5 && j < width) {  // within one pixel
    row[j] += weight * length * (0.5 * (from + to));
    return;
  }
  const double slope = (to - from) / length;
  for (; begin < last; ++j) {
    const double end = std::min(last, j + 0.5);
    if (j < width) row[j] += weight * (end - begin) * (from + slope * (0.5 * (begin + end) - left));
    begin = end;
  }
}

// Adds a triangle's lines first … last - 1, each from the edge `left` to the edge `right`.
inline void draw_lines(int64_t first, int64_t last, const Edge& left, const Edge& right, double weight, int64_t lines,
                       double* image, int64_t width) {
  const double apart = 1.0 / lines;
  int64_t more = lines - first % lines;  // lines of this row of pixels that are still to come
  double* pixels = image + first / lines * width;
  for (int64_t s = first; s < last; ++s) {
    const double row = (s + 0.5) * apart - 0.5, up = row - left.row, on = row - right.row;
    integrate(left.column + up * left.columns, left.depth + up * left.depths, right.column + on * right.columns,
              right.depth + on * right.depths, weight, pixels, width);
    if (--more == 0) more = lines, pixels += width;
  }
}

void draw(const Point& a, const Point& b, const Point& c, int64_t lines, double* image, int64_t height,
          int64_t width) {
  const double area = (b.column - a.column) * (c.row - a.row) - (b.row - a.row) * (c.column - a.column);
  if (area == 0) return;
  const Point *low = &a, *middle = &b, *high = &c;
  bool rightwards = area > 0;  // whether the middle corner is to the right of the edge from low to high
  const auto sort = [&](const Point*& lower, const Point*& upper) {
    if (upper->row < lower->row) std::swap(lower, upper), rightwards = !rightwards;
  };
  sort(low, middle), sort(middle, high), sort(low, middle);
  // Line s lies at row (s + 1/2) / lines - 1/2. The first one at a corner or above it is the same for all triangles of
  // the corner, which so share out the lines between them.
  const auto line = [&](double row) {
    return static_cast<int64_t>(std::clamp(std::ceil((row + 0.5) * lines - 0.5), 0.0, double(height * lines)));
  };
  const int64_t first = line(low->row), turn = line(middle->row), last = line(high->row);
  if (first == last) return;
  const double weight = (area > 0 ? 1.0 : -1.0) / lines;
  const Edge whole(*low, *high);
  const auto between = [&](int64_t begin, int64_t end, const Edge& part) {
    draw_lines(begin, end, rightwards ? whole : part, rightwards ? part : whole, weight, lines, image, width);
  };
  if (first < turn) between(first, turn, Edge(*low, *middle));
  if (turn < last) between(turn, last, Edge(*middle, *high));
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

// shares[k] += weight Σ_q image(q) λ_k(q), λ_k the hat of corner k, q the triangle's three points of equal weight.
void add_shares(const Point* const corner[3], const double* image, int64_t height, int64_t width, double weight,
                double* shares) {
  for (int q = 0; q < 3; ++q) {
    const Point &near = *corner[q], &one = *corner[(q + 1) % 3], &other = *corner[(q + 2) % 3];
    const double column = (4 * near.column + one.column + other.column) / 6;
    const double row = (4 * near.row + one.row + other.row) / 6;
    const double value = weight * interpolated(image, height, width, column, row) / 6;
    for (int k = 0; k < 3; ++k) shares[k] += k == q ? 4 * value : value;
  }
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
  add_shares(corner, image, height, width, 1.0 / 6, share);
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

int64_t holosplat_surface_shares(const HoloSurface* surface, const HoloRaster* raster, const double* image_gradient,
                                 const double* weights, double* shares, int64_t threads) {
  return holo::guarded([&] {
    const int64_t h = raster->height, w = raster->width;
    const auto* points = reinterpret_cast<const Point*>(surface->points);
    holo::parallel_runs(surface->faces, kRunFaces, threads, [&](int64_t begin, int64_t end) {
      std::fill(shares + 3 * begin, shares + 3 * end, 0.0);
      for (int64_t view = 0; view < raster->count; ++view) {  // one image at a time stays in the cache
        const Point* seen = points + view * surface->vertices;
        for (int64_t f = begin; f < end; ++f) {
          const int64_t* at = surface->corners + 3 * f;
          const Point* const corner[3] = {seen + at[0], seen + at[1], seen + at[2]};
          add_shares(corner, image_gradient + view * h * w, h, w, weights[view], shares + 3 * f);
        }
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
