// Line integrals of a Gaussian cloud in parallel beams, and their gradients.
//
// Forward: a task is a band of rows of one view; it adds every Gaussian in index order, so no two tasks share a pixel
// and no result depends on the number of threads. Backward: a task is a run of Gaussians; each gathers its moments
// from all views in order, so nothing is shared either.

#include <numeric>
#include <vector>

#include "outline.hpp"
#include "threads.hpp"

namespace holo {
namespace {

constexpr double kSqrtTwoPi = 2.5066282746310002;
constexpr int64_t kRunBlocks = 64;  // 1024 Gaussians gather from one view before the next: it stays in the cache

struct View {
  double across[3], down[3];  // the first two rows of R
  double shift_x, shift_y;    // from lab coordinates to pixel indices
  int width, height;
};

View view_of(const HoloViews& views, int64_t index) {
  View view;
  const double* r = views.rotations + 9 * index;
  for (int d = 0; d < 3; ++d) view.across[d] = r[d], view.down[d] = r[3 + d];
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

// pᵀ Σ p' as a sum over the six numbers of Σ: their factors.
struct Form {
  double xx, xy, xz, yy, yz, zz;
  Form(const double* p, const double* q)
      : xx(p[0] * q[0]), xy(p[0] * q[1] + p[1] * q[0]), xz(p[0] * q[2] + p[2] * q[0]), yy(p[1] * q[1]),
        yz(p[1] * q[2] + p[2] * q[1]), zz(p[2] * q[2]) {}
  HOLO_INLINE double of(const Block& g, int k) const {
    return xx * g.covariance[XX][k] + xy * g.covariance[XY][k] + xz * g.covariance[XZ][k] +
           yy * g.covariance[YY][k] + yz * g.covariance[YZ][k] + zz * g.covariance[ZZ][k];
  }
};

void project(const Block& __restrict g, const View& view, const HoloOptions& options, Projection& __restrict out) {
  Spread& s = out.spread;
  const View v = view;  // copies: the loop's stores cannot change them
  const double cutoff = options.cutoff, variance = options.variance;
  const Form across(v.across, v.across), mixed(v.across, v.down), down(v.down, v.down);
  for (int k = 0; k < kBlock; ++k) {
    const double x = g.centre[0][k], y = g.centre[1][k], z = g.centre[2][k];
    s.u[k] = v.across[0] * x + v.across[1] * y + v.across[2] * z + v.shift_x;
    s.v[k] = v.down[0] * x + v.down[1] * y + v.down[2] * z + v.shift_y;
    const double xx = across.of(g, k) + variance, yy = down.of(g, k) + variance;
    const double inverse = invert(xx, mixed.of(g, k), yy, k, s);
    s.reach_x[k] = cutoff * std::sqrt(xx);
    s.reach_y[k] = cutoff * std::sqrt(yy);
    s.corner[k] = corner_exponent(s, k, s.reach_x[k], s.reach_y[k]);
    // Mass (2π)^{3/2} s₁s₂s₃ over the 2D Gaussian's 2π sqrt(det Σ₂').
    out.weight[k] = kSqrtTwoPi * g.root[k] * std::sqrt(inverse);
  }
  outline(s, v.width, v.height, out.outline);
}

// The patches of a block that touch rows first … last of a raster, and which Gaussians they are.
template <int C>
struct Jobs {
  Job<C> jobs[kBlock];
  int gaussian[kBlock];
  int count;

  void list(const Block& g, const Projection& projection, int first, int last, const Raster& raster) {
    const Outline& o = projection.outline;
    count = 0;
    for (int k = 0; k < g.used; ++k) {
      Job<C>& job = jobs[count];
      job.first = std::max(o.top[k], first), job.last = std::min(o.bottom[k], last);
      if (job.first > job.last || o.x0[k] > o.x1[k]) continue;
      job.patch = patch_of(projection.spread, o, k);
      for (int c = 0; c < C; ++c) job.peak[c] = static_cast<float>(projection.weight[k]) * g.amplitude[c][k];
      job.raster = raster;
      gaussian[count++] = k;
    }
  }
};

std::unique_ptr<Block[]> load_cloud(const HoloCloud& cloud, int64_t threads) {
  const int64_t count = blocks(cloud.count);
  std::unique_ptr<Block[]> all(new Block[count]);  // a vector would be zeroed first, by one thread
  parallel_runs(count, kRunBlocks, threads, [&](int64_t first, int64_t last) {
    for (int64_t b = first; b < last; ++b) load_block(cloud, b * kBlock, all[b]);
  });
  return all;
}

template <int C>
void splat(const HoloCloud& cloud, const HoloViews& views, const HoloOptions& options, float* image) {
  if (views.count == 0) return;
  const auto all = load_cloud(cloud, options.threads);
  // As few bands as give every thread the same number of them: each band projects every Gaussian anew.
  const int64_t bands = std::min(views.height, options.threads / std::gcd(views.count, options.threads));
  const int64_t rows = (views.height + bands - 1) / bands, stride = row_stride(views.width, C);
  const int64_t plane = views.height * views.width;
  parallel(views.count * bands, options.threads, [&](int64_t task) {
    const View view = view_of(views, task / bands);
    const int64_t first = task % bands * rows, height = std::min(rows, views.height - first);
    if (height <= 0) return;
    const auto memory = buffer(height * C * stride);
    std::fill_n(memory.get(), height * C * stride, 0.0f);
    const Raster raster{memory.get() - first * C * stride, C * stride, stride};
    Projection projection;
    Jobs<C> jobs;
    for (int64_t b = 0; b < blocks(cloud.count); ++b) {
      project(all[b], view, options, projection);
      jobs.list(all[b], projection, static_cast<int>(first), static_cast<int>(first + height - 1), raster);
      draw(jobs.jobs, jobs.count);
    }
    float* to = image + task / bands * C * plane + first * views.width;
    crop_rows({memory.get(), C * stride, stride}, C, height, views.width, to, plane);
  });
}

// From a patch's moments to the gradients of mean and covariance in the image plane, and on to 3D.
// With p = Σ₂'⁻¹ d: ∂L/∂mean = Σ p, ∂L/∂Σ₂' = ½ (Σ p pᵀ - S₀ Σ₂'⁻¹), sums over pixels weighted with what they gave.
template <int C>
void pull_back(const Block& __restrict g, const View& view, const Projection& __restrict projection,
               const float (*__restrict moments)[kMoments], BlockGradient& __restrict out) {
  const Spread& s = projection.spread;
  const View v = view;
  const double *p = v.across, *q = v.down;
  const Form across(p, p), mixed(p, q), down(q, q);
  for (int k = 0; k < kBlock; ++k) {
    const float* m = moments[k];
    const double weight = projection.weight[k];
    // With one channel the moments lack the amplitude and the weight.
    const double scale = C == 1 ? weight * g.amplitude[0][k] : 1.0;
    double all = weight * (double(g.amplitude[0][k]) * m[FIRST]);
    if (C == 2) all += weight * (double(g.amplitude[1][k]) * m[SECOND]);
    const double slope = s.slope[k], lean = projection.outline.needle[k] ? 0.0 : slope;
    const double d = scale * m[DOWN], d2 = scale * m[DOWN2];
    const double t = scale * m[ACROSS] - lean * d;
    const double td = scale * m[ACROSS_DOWN] - lean * d2;
    const double t2 = scale * m[ACROSS2] - lean * (scale * m[ACROSS_DOWN] + td);
    // p_x = across t, p_y = down d - slope p_x.
    const double ix = s.across[k], iy = s.down[k];
    const double px = t * ix, py = d * iy - slope * px;
    const double pxx = t2 * ix * ix, cross = td * ix * iy;
    const double pxy = cross - slope * pxx, pyy = d2 * iy * iy - slope * (cross + pxy);
    const double gxx = 0.5 * (pxx - all * ix), gxy = 0.5 * (pxy + all * ix * slope);
    const double gyy = 0.5 * (pyy - all * (iy + ix * slope * slope));
    for (int i = 0; i < 3; ++i) out.centre[i][k] += px * p[i] + py * q[i];
    out.covariance[XX][k] += gxx * across.xx + gxy * 2 * mixed.xx + gyy * down.xx;
    out.covariance[XY][k] += 0.5 * (gxx * across.xy + gxy * 2 * mixed.xy + gyy * down.xy);
    out.covariance[XZ][k] += 0.5 * (gxx * across.xz + gxy * 2 * mixed.xz + gyy * down.xz);
    out.covariance[YY][k] += gxx * across.yy + gxy * 2 * mixed.yy + gyy * down.yy;
    out.covariance[YZ][k] += 0.5 * (gxx * across.yz + gxy * 2 * mixed.yz + gyy * down.yz);
    out.covariance[ZZ][k] += gxx * across.zz + gxy * 2 * mixed.zz + gyy * down.zz;
    out.log_root[k] += all;
    for (int c = 0; c < C; ++c) out.amplitude[c][k] += weight * m[FIRST + c];
  }
}

template <int C>
void gather_block(const Block& g, const View& view, const HoloOptions& options, const Raster& raster,
                  BlockGradient& out) {
  Projection projection;
  Jobs<C> jobs;
  project(g, view, options, projection);
  jobs.list(g, projection, 0, view.height - 1, raster);
  alignas(64) float found[kBlock][kMoments], moments[kBlock][kMoments] = {};
  gather(jobs.jobs, jobs.count, found);
  for (int k = 0; k < jobs.count; ++k) std::copy_n(found[k], kMoments, moments[jobs.gaussian[k]]);
  pull_back<C>(g, view, projection, moments, out);
}

template <int C>
void splat_backward(const HoloCloud& cloud, const HoloViews& views, const HoloOptions& options, const float* gradient,
                    const HoloGradients& out) {
  const int64_t stride = row_stride(views.width, C), plane = views.height * views.width;
  const auto memory = buffer(views.count * views.height * C * stride);
  const auto raster_of = [&](int64_t v) {
    return Raster{memory.get() + v * views.height * C * stride, C * stride, stride};
  };
  parallel(views.count, options.threads, [&](int64_t v) {
    pad_rows(gradient + v * C * plane, plane, C, views.height, views.width, raster_of(v));
  });
  parallel_runs(blocks(cloud.count), kRunBlocks, options.threads, [&](int64_t first, int64_t last) {
    const int64_t size = last - first;
    std::vector<Block> all(size);
    std::vector<BlockGradient> gradients(size, BlockGradient{});
    for (int64_t b = 0; b < size; ++b) load_block(cloud, (first + b) * kBlock, all[b]);
    for (int64_t v = 0; v < views.count; ++v) {
      const View view = view_of(views, v);
      for (int64_t b = 0; b < size; ++b) gather_block<C>(all[b], view, options, raster_of(v), gradients[b]);
    }
    for (int64_t b = 0; b < size; ++b) write_gradient(cloud, (first + b) * kBlock, gradients[b], out);
  });
}

}  // namespace
}  // namespace holo

int64_t holosplat_splat(const HoloCloud* cloud, const HoloViews* views, const HoloOptions* options, float* image) {
  const auto forward = cloud->channels == 1 ? holo::splat<1> : holo::splat<2>;
  return holo::guarded([&] { forward(*cloud, *views, *options, image); });
}

int64_t holosplat_splat_backward(const HoloCloud* cloud, const HoloViews* views, const HoloOptions* options,
                                 const float* image_gradient, const HoloGradients* out) {
  const auto backward = cloud->channels == 1 ? holo::splat_backward<1> : holo::splat_backward<2>;
  return holo::guarded([&] { backward(*cloud, *views, *options, image_gradient, *out); });
}
