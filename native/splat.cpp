// Line integrals of a Gaussian cloud in parallel beams or in cones of rays, and their gradients.
//
// In a cone with the source at depth -1/κ, a point at depth z is magnified by m = 1 / (1 + κ z), and the perspective is
// taken as affine about each Gaussian's centre (Zwicker et al. 2001): rows m (R₀ - κ u R₂) and m (R₁ - κ v R₂) for the
// centre's place (u, v) in the plane of the pixels, and a line integral along depth m² times as large.
//
// Forward: a task is a band of rows of one view; it adds every Gaussian in one order (order.hpp), so no two tasks share
// a pixel and no result depends on the number of threads. Backward: a task is a run of Gaussians; each gathers its
// moments from all views in order, so nothing is shared either. Gradients of the views, if wanted, are sums over runs
// of a length that does not depend on the number of threads, added up in order at the end.

#include <array>
#include <numeric>
#include <optional>
#include <vector>

#include "order.hpp"
#include "outline.hpp"
#include "threads.hpp"

namespace holo {
namespace {

constexpr double kSqrtTwoPi = 2.5066282746310002;
constexpr int64_t kRunBlocks = 64;  // 1024 Gaussians gather from one view before the next: it stays in the cache
constexpr int64_t kViewRuns = 128;  // runs of a small cloud when views have gradients: enough for many threads
constexpr int kTurned = 1;        // most scans turn about y

struct View {
  double across[3], down[3], beam[3];  // the rows of R
  double curvature;                    // κ, one over the distance of the source; 0 in parallel beams
  double shift_x, shift_y;             // from lab coordinates to pixel indices
  int width, height;
};

View view_of(const HoloViews& views, int64_t index) {
  View view;
  const double* r = views.rotations + 9 * index;
  for (int d = 0; d < 3; ++d) view.across[d] = r[d], view.down[d] = r[3 + d], view.beam[d] = r[6 + d];
  view.curvature = views.curvatures ? views.curvatures[index] : 0.0;
  view.shift_x = 0.5 * views.width - 0.5 - views.shifts[2 * index];
  view.shift_y = 0.5 * views.height - 0.5 - views.shifts[2 * index + 1];
  view.width = static_cast<int>(views.width), view.height = static_cast<int>(views.height);
  return view;
}

struct alignas(64) Projection {
  Spread spread;
  Outline outline;
  double weight[kBlock];  // peak of the line integral at unit amplitude
};

// How a Gaussian's centre is seen in a cone: its place in the plane of the pixels, its magnification, and the rows of
// the affine map about it. Behind the source the magnification is zero, and so is all that follows from it.
struct Seen {
  double u, v, depth, scale, across[3], down[3];  // depth: 1 / scale

  HOLO_INLINE Seen(const Block& g, int k, const View& view) {
    const double x = g.centre[0][k], y = g.centre[1][k], z = g.centre[2][k];
    const auto along = [&](const double* row) { return fused(row[0], x, fused(row[1], y, row[2] * z)); };
    const double ahead = fused(view.curvature, along(view.beam), 1.0);
    const bool before = ahead > 0;
    depth = before ? ahead : 0.0, scale = before ? 1 / ahead : 0.0;
    u = scale * along(view.across), v = scale * along(view.down);
    for (int d = 0; d < 3; ++d) {
      across[d] = scale * fused(-view.curvature * u, view.beam[d], view.across[d]);
      down[d] = scale * fused(-view.curvature * v, view.beam[d], view.down[d]);
    }
  }
};

// pᵀ Σ p' as a sum over the six numbers of Σ: their factors.
struct Form {
  double xx, xy, xz, yy, yz, zz;
  Form(const double* p, const double* q)
      : xx(p[0] * q[0]), xy(p[0] * q[1] + p[1] * q[0]), xz(p[0] * q[2] + p[2] * q[0]), yy(p[1] * q[1]),
        yz(p[1] * q[2] + p[2] * q[1]), zz(p[2] * q[2]) {}
  HOLO_INLINE double of(const Block& g, int k) const {
    const double x = fused(xx, g.covariance[XX][k], fused(xy, g.covariance[XY][k], xz * g.covariance[XZ][k]));
    return fused(yy, g.covariance[YY][k], fused(yz, g.covariance[YZ][k], fused(zz, g.covariance[ZZ][k], x)));
  }
};

template <bool kCone>
void project(const Block& __restrict g, const View& view, const HoloOptions& options, int align,
             Projection& __restrict out) {
  Spread& s = out.spread;
  const View v = view;  // copies: the loop's stores cannot change them
  const double cutoff = options.cutoff, variance = options.variance;
  const Form across(v.across, v.across), mixed(v.across, v.down), down(v.down, v.down);
  for (int k = 0; k < kBlock; ++k) {
    double xx, xy, yy, area = 1;  // area: what the map does to a unit of it
    if constexpr (kCone) {
      const Seen seen(g, k, v);
      s.u[k] = seen.u + v.shift_x, s.v[k] = seen.v + v.shift_y;
      xx = Form(seen.across, seen.across).of(g, k), xy = Form(seen.across, seen.down).of(g, k);
      yy = Form(seen.down, seen.down).of(g, k), area = seen.scale * seen.scale;
    } else {
      const double x = g.centre[0][k], y = g.centre[1][k], z = g.centre[2][k];
      s.u[k] = fused(v.across[0], x, fused(v.across[1], y, fused(v.across[2], z, v.shift_x)));
      s.v[k] = fused(v.down[0], x, fused(v.down[1], y, fused(v.down[2], z, v.shift_y)));
      xx = across.of(g, k), xy = mixed.of(g, k), yy = down.of(g, k);
    }
    xx += variance, yy += variance;
    const double inverse = invert(xx, xy, yy, k, s);
    s.reach_x[k] = cutoff * std::sqrt(xx);
    s.reach_y[k] = cutoff * std::sqrt(yy);
    s.corner[k] = corner_exponent(s, k, s.reach_x[k], s.reach_y[k]);
    // Mass (2π)^{3/2} s₁s₂s₃ over the 2D Gaussian's 2π sqrt(det Σ₂').
    out.weight[k] = area * (kSqrtTwoPi * g.root[k] * std::sqrt(inverse));
  }
  outline(s, v.width, v.height, align, out.outline);
}

// The patches of a block that touch rows first … last of a raster, and which Gaussians they are.
template <int C>
struct Patches {
  Batch<C> batch;
  int gaussian[kBlock];

  void list(const Block& g, const Projection& projection, int first, int last, const Raster& raster) {
    const Outline& o = projection.outline;
    batch.strides = raster.strides;
    int count = 0;
    for (int k = 0; k < g.used; ++k) {
      Job<C>& job = batch.jobs[count];
      const int from = std::max(o.top[k], first), to = std::min(o.bottom[k], last);
      for (int c = 0; c < C; ++c) job.peak[c] = static_cast<float>(projection.weight[k]) * g.amplitude[c][k];
      if (from > to || o.begin[k] > o.end[k] || !all_finite<C>(job.peak)) continue;
      job.patch = patch_of(o, k);
      set_rows(o, k, from, to, job);
      job.raster = raster.data;
      batch.crests[count].needle = o.needle[k];
      if (o.needle[k]) batch.crests[count] = crest_of(projection.spread, o, k);
      gaussian[count++] = k;
    }
    batch.count = count;
  }
};

std::unique_ptr<Block[]> load_cloud(const HoloCloud& cloud, int64_t threads) {
  const auto order = drawing_order(cloud, kTurned, threads);
  const int64_t count = blocks(cloud.count);
  std::unique_ptr<Block[]> all(new Block[count]);  // a vector would be zeroed first, by one thread
  parallel_runs(count, kRunBlocks, threads, [&](int64_t first, int64_t last) {
    for (int64_t b = first; b < last; ++b) load_block(cloud, order.get(), b * kBlock, all[b]);
  });
  return all;
}

template <int C, bool kCone>
void splat(const HoloCloud& cloud, const HoloViews& views, const HoloOptions& options, float* image) {
  if (views.count == 0) return;
  const auto all = load_cloud(cloud, options.threads);
  // As few bands as give every thread the same number of them: each band projects every Gaussian anew.
  const int64_t bands = std::min(views.height, options.threads / std::gcd(views.count, options.threads));
  const int64_t rows = (views.height + bands - 1) / bands, stride = row_stride(views.width, C);
  const int64_t plane = views.height * views.width;
  std::vector<Buffer> rasters(static_cast<size_t>(std::max<int64_t>(1, options.threads)));
  parallel(views.count * bands, options.threads, [&](int64_t task, int64_t thread) {
    const View view = view_of(views, task / bands);
    const int64_t first = task % bands * rows, height = std::min(rows, views.height - first);
    if (height <= 0) return;
    Buffer& memory = rasters[thread];
    if (!memory.get()) memory = zeros(rows * C * stride);
    const Raster raster{memory.get() - first * C * stride, {C * stride, stride}};
    Projection projection;
    Patches<C> patches;
    for (int64_t b = 0; b < blocks(cloud.count); ++b) {
      project<kCone>(all[b], view, options, kUnit, projection);
      patches.list(all[b], projection, static_cast<int>(first), static_cast<int>(first + height - 1), raster);
      draw(patches.batch);
    }
    float* to = image + task / bands * C * plane + first * views.width;
    take_rows({memory.get(), {C * stride, stride}}, C, height, views.width, to, plane);
  });
}

// Sums over blocks for one view, lane by lane: ∂L of the rows of R, of the mean, and of the curvature.
struct alignas(64) ViewGradient {
  double across[3][kBlock] = {}, down[3][kBlock] = {}, beam[3][kBlock] = {};
  double mean[2][kBlock] = {}, curvature[kBlock] = {};
};

// The gradients of mean and covariance of one Gaussian in the image plane.
struct PlaneGradient {
  double x, y;        // ∂L/∂mean
  double xx, xy, yy;  // ∂L/∂Σ₂' as a full symmetric matrix
};

// ∂L of the rows of the map A, from Σ₂' = A Σ Aᵀ + variance: 2 ∂L/∂Σ₂' A Σ.
struct RowGradient {
  double across[3], down[3];

  HOLO_INLINE RowGradient(const Block& g, int k, const double* p, const double* q, const PlaneGradient& plane) {
    constexpr int kRow[3][3] = {{XX, XY, XZ}, {XY, YY, YZ}, {XZ, YZ, ZZ}};
    for (int i = 0; i < 3; ++i) {
      double along_p = 0, along_q = 0;
      for (int j = 0; j < 3; ++j) {
        const double sigma = g.covariance[kRow[i][j]][k];
        along_p += sigma * p[j], along_q += sigma * q[j];
      }
      across[i] = 2 * (plane.xx * along_p + plane.xy * along_q);
      down[i] = 2 * (plane.xy * along_p + plane.yy * along_q);
    }
  }
};

// In parallel beams A is the first two rows of R, and mean = A c - shift.
HOLO_INLINE void add_view(const Block& g, int k, const View& v, const PlaneGradient& plane, bool drawn,
                          ViewGradient& out) {
  const RowGradient rows(g, k, v.across, v.down, plane);
  for (int i = 0; i < 3; ++i) {
    out.across[i][k] += drawn ? rows.across[i] + plane.x * g.centre[i][k] : 0.0;
    out.down[i][k] += drawn ? rows.down[i] + plane.y * g.centre[i][k] : 0.0;
  }
  out.mean[0][k] += drawn ? plane.x : 0.0;
  out.mean[1][k] += drawn ? plane.y : 0.0;
}

// In a cone, from ∂L of the map's rows P, Q, of the mean, and of the logarithm of the weight, which holds m²: those of
// the mean with all that hangs on it, of the depth, and of the centre.
struct ConeGradient {
  double u, v, depth, slant;  // ∂L of u and v; of z; and P·R₂ u + Q·R₂ v
  double scale;               // ∂L of m

  HOLO_INLINE ConeGradient(const View& view, const Seen& seen, const RowGradient& rows, const PlaneGradient& plane,
                           double all) {
    const auto dot = [](const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
    const double p = dot(rows.across, view.beam), q = dot(rows.down, view.beam), bent = view.curvature * seen.scale;
    u = plane.x - bent * p, v = plane.y - bent * q, slant = p * seen.u + q * seen.v;
    scale = seen.depth * (2 * all + dot(rows.across, seen.across) + dot(rows.down, seen.down) + u * seen.u + v * seen.v);
    depth = -view.curvature * seen.scale * seen.scale * scale;
  }
};

HOLO_INLINE void add_cone(const Block& g, int k, const View& v, const Seen& seen, const RowGradient& rows,
                          const ConeGradient& cone, const PlaneGradient& plane, bool drawn, ViewGradient& out) {
  const double m = seen.scale, bent = v.curvature * m;
  double z = 0;
  for (int i = 0; i < 3; ++i) {
    const double c = g.centre[i][k];
    z += v.beam[i] * c;
    out.across[i][k] += drawn ? m * (rows.across[i] + cone.u * c) : 0.0;
    out.down[i][k] += drawn ? m * (rows.down[i] + cone.v * c) : 0.0;
    out.beam[i][k] += drawn ? cone.depth * c - bent * (seen.u * rows.across[i] + seen.v * rows.down[i]) : 0.0;
  }
  out.mean[0][k] += drawn ? plane.x : 0.0;
  out.mean[1][k] += drawn ? plane.y : 0.0;
  out.curvature[k] += drawn ? -m * (cone.slant + z * m * cone.scale) : 0.0;
}

// From a patch's moments to the gradients of mean and covariance in the image plane, and on to 3D; with kViews, also
// to those of the view, from the Gaussians that were drawn.
// With p = Σ₂'⁻¹ d: ∂L/∂mean = Σ p, ∂L/∂Σ₂' = ½ (Σ p pᵀ - S₀ Σ₂'⁻¹), sums over pixels weighted with what they gave.
template <int C, bool kViews, bool kCone>
void pull_back(const Block& __restrict g, const View& view, const Projection& __restrict projection,
               const float (*__restrict moments)[kMoments], const int* __restrict drawn,
               BlockGradient& __restrict out, ViewGradient* __restrict view_out) {
  const Spread& s = projection.spread;
  const View v = view;
  const Form parallel_across(v.across, v.across), parallel_mixed(v.across, v.down), parallel_down(v.down, v.down);
  for (int k = 0; k < kBlock; ++k) {
    const float* m = moments[k];
    const double weight = projection.weight[k];
    // With one channel the moments lack the amplitude and the weight.
    const double scale = C == 1 ? weight * g.amplitude[0][k] : 1.0;
    // As single numbers, as in the moments, from which a multiple of this is subtracted.
    const float peak = static_cast<float>(weight);
    double all = C == 1 ? scale * m[FIRST] : double(peak * g.amplitude[0][k]) * m[FIRST];
    if (C == 2) all += double(peak * g.amplitude[1][k]) * m[SECOND];
    const double slope = s.slope[k], lean = projection.outline.needle[k] ? 0.0 : slope;
    const double end = m[END], x = scale * m[ACROSS];
    const double d = end * all - scale * m[UP], d2 = end * (end * all - 2 * scale * m[UP]) + scale * m[UP2];
    const double xd = end * x - scale * m[ACROSS_UP];
    const double t = x - lean * d;
    const double td = xd - lean * d2;
    const double t2 = scale * m[ACROSS2] - lean * (xd + td);
    // p_x = across t, p_y = down d - slope p_x.
    const double ix = s.across[k], iy = s.down[k];
    const double px = t * ix, py = d * iy - slope * px;
    const double pxx = t2 * ix * ix, cross = td * ix * iy;
    const double pxy = cross - slope * pxx, pyy = d2 * iy * iy - slope * (cross + pxy);
    const double gxx = 0.5 * (pxx - all * ix), gxy = 0.5 * (pxy + all * ix * slope);
    const double gyy = 0.5 * (pyy - all * (iy + ix * slope * slope));
    const auto add_covariance = [&](const Form& across, const Form& mixed, const Form& down) {
      out.covariance[XX][k] += gxx * across.xx + gxy * 2 * mixed.xx + gyy * down.xx;
      out.covariance[XY][k] += 0.5 * (gxx * across.xy + gxy * 2 * mixed.xy + gyy * down.xy);
      out.covariance[XZ][k] += 0.5 * (gxx * across.xz + gxy * 2 * mixed.xz + gyy * down.xz);
      out.covariance[YY][k] += gxx * across.yy + gxy * 2 * mixed.yy + gyy * down.yy;
      out.covariance[YZ][k] += 0.5 * (gxx * across.yz + gxy * 2 * mixed.yz + gyy * down.yz);
      out.covariance[ZZ][k] += gxx * across.zz + gxy * 2 * mixed.zz + gyy * down.zz;
    };
    const PlaneGradient plane{px, py, gxx, gxy, gyy};
    if constexpr (kCone) {
      const Seen seen(g, k, v);
      const double *p = seen.across, *q = seen.down;
      const RowGradient rows(g, k, p, q, plane);
      const ConeGradient cone(v, seen, rows, plane, all);
      for (int i = 0; i < 3; ++i)
        out.centre[i][k] += seen.scale * (cone.u * v.across[i] + cone.v * v.down[i]) + cone.depth * v.beam[i];
      add_covariance(Form(p, p), Form(p, q), Form(q, q));
      if constexpr (kViews) add_cone(g, k, v, seen, rows, cone, plane, drawn[k] != 0, *view_out);
    } else {
      for (int i = 0; i < 3; ++i) out.centre[i][k] += px * v.across[i] + py * v.down[i];
      add_covariance(parallel_across, parallel_mixed, parallel_down);
      if constexpr (kViews) add_view(g, k, v, plane, drawn[k] != 0, *view_out);
    }
    out.log_root[k] += all;
    for (int c = 0; c < C; ++c) out.amplitude[c][k] += weight * m[FIRST + c];
  }
}

template <int C, bool kCone>
void gather_block(const Block& g, const View& view, const HoloOptions& options, const Raster& raster,
                  BlockGradient& out, ViewGradient* view_out) {
  Projection projection;
  Patches<C> patches;
  project<kCone>(g, view, options, 1, projection);
  patches.list(g, projection, 0, view.height - 1, raster);
  alignas(64) float found[kBlock][kMoments], moments[kBlock][kMoments] = {};
  gather(patches.batch, found);
  for (int k = 0; k < patches.batch.count; ++k) std::copy_n(found[k], kMoments, moments[patches.gaussian[k]]);
  if (!view_out) return pull_back<C, false, kCone>(g, view, projection, moments, nullptr, out, nullptr);
  int drawn[kBlock] = {};
  for (int k = 0; k < patches.batch.count; ++k) drawn[patches.gaussian[k]] = 1;
  pull_back<C, true, kCone>(g, view, projection, moments, drawn, out, view_out);
}

// The gradients of all views as sums over runs of Gaussians, each kept until all are there.
class ViewSums {
 public:
  ViewSums(int64_t runs, int64_t views) : runs_(runs), views_(views), sums_(runs * views) {}

  void keep(int64_t run, int64_t view, const ViewGradient& g) {
    Sum& sum = sums_[run * views_ + view];
    for (int k = 0; k < kBlock; ++k) {
      for (int i = 0; i < 3; ++i) sum[i] += g.across[i][k], sum[3 + i] += g.down[i][k], sum[6 + i] += g.beam[i][k];
      for (int i = 0; i < 2; ++i) sum[9 + i] += g.mean[i][k];
      sum[11] += g.curvature[k];
    }
  }

  // The third row of R plays no part in parallel beams. A shift of the detector moves the mean the other way.
  void write(const HoloViewGradients& out) const {
    std::fill_n(out.rotations, 9 * views_, 0.0);
    std::fill_n(out.shifts, 2 * views_, 0.0);
    if (out.curvatures) std::fill_n(out.curvatures, views_, 0.0);
    for (int64_t run = 0; run < runs_; ++run)
      for (int64_t v = 0; v < views_; ++v) {
        const Sum& sum = sums_[run * views_ + v];
        for (int i = 0; i < 9; ++i) out.rotations[9 * v + i] += sum[i];
        for (int i = 0; i < 2; ++i) out.shifts[2 * v + i] -= sum[9 + i];
        if (out.curvatures) out.curvatures[v] += sum[11];
      }
  }

 private:
  using Sum = std::array<double, 12>;
  int64_t runs_, views_;
  std::vector<Sum> sums_;  // [runs, views], zero at first
};

template <int C, bool kCone>
void splat_backward(const HoloCloud& cloud, const HoloViews& views, const HoloOptions& options, const float* gradient,
                    const HoloGradients& out, const HoloViewGradients* views_out) {
  const int64_t stride = row_stride(views.width, C), plane = views.height * views.width;
  const auto order = drawing_order(cloud, kTurned, options.threads);
  const Buffer memory(views.count * views.height * C * stride);
  const auto raster_of = [&](int64_t v) {
    return Raster{memory.get() + v * views.height * C * stride, {C * stride, stride}};
  };
  parallel(views.count, options.threads, [&](int64_t v) {
    pad_rows(gradient + v * C * plane, plane, C, views.height, views.width, raster_of(v));
  });
  const int64_t count = blocks(cloud.count), length = std::clamp<int64_t>(count / kViewRuns, 1, kRunBlocks);
  ViewSums sums(views_out ? (count + length - 1) / length : 0, views.count);
  const auto gather_run = [&](int64_t first, int64_t last) {
    const int64_t size = last - first;
    std::vector<Block> all(size);
    std::vector<BlockGradient> gradients(size, BlockGradient{});
    for (int64_t b = 0; b < size; ++b) load_block(cloud, order.get(), (first + b) * kBlock, all[b]);
    for (int64_t v = 0; v < views.count; ++v) {
      const View view = view_of(views, v);
      std::optional<ViewGradient> found;
      if (views_out) found.emplace();
      ViewGradient* const wanted = found ? &*found : nullptr;
      for (int64_t b = 0; b < size; ++b) gather_block<C, kCone>(all[b], view, options, raster_of(v), gradients[b], wanted);
      if (found) sums.keep(first / length, v, *found);
    }
    for (int64_t b = 0; b < size; ++b) write_gradient(cloud, order.get(), (first + b) * kBlock, gradients[b], out);
  };
  if (!views_out) return parallel_runs(count, kRunBlocks, options.threads, gather_run);
  parallel_equal_runs(count, length, options.threads, gather_run);
  sums.write(*views_out);
}

}  // namespace
}  // namespace holo

int64_t holosplat_splat(const HoloCloud* cloud, const HoloViews* views, const HoloOptions* options, float* image) {
  const bool cone = views->curvatures;
  const auto forward = cloud->channels == 1 ? cone ? holo::splat<1, true> : holo::splat<1, false>
                                            : cone ? holo::splat<2, true> : holo::splat<2, false>;
  return holo::guarded([&] { forward(*cloud, *views, *options, image); });
}

int64_t holosplat_splat_backward(const HoloCloud* cloud, const HoloViews* views, const HoloOptions* options,
                                 const float* image_gradient, const HoloGradients* out,
                                 const HoloViewGradients* views_out) {
  const bool cone = views->curvatures;
  const auto backward = cloud->channels == 1 ? cone ? holo::splat_backward<1, true> : holo::splat_backward<1, false>
                                             : cone ? holo::splat_backward<2, true> : holo::splat_backward<2, false>;
  return holo::guarded([&] { backward(*cloud, *views, *options, image_gradient, *out, views_out); });
}
