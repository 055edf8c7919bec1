// A Gaussian cloud on a voxel raster, and its gradients.
//
// A slice through a 3D Gaussian at constant z is a 2D Gaussian: the conditional one, whose mean moves along a line
// with z and whose covariance does not change. So each slice is a patch, as in the splat.
//
// Forward: a task is a slab of slices and adds, in index order, the Gaussians that reach it. Backward: a task is a run
// of Gaussians. No two tasks write the same number, and nothing depends on the number of threads.

#include <vector>

#include "outline.hpp"
#include "threads.hpp"

namespace holo {
namespace {

constexpr int64_t kRunBlocks = 32;
constexpr int64_t kSlab = 8;  // slices at most: a slab of a common volume stays in the second-level cache

// The conditional Gaussian of one Gaussian's slices, on the raster.
struct Slices {
  Patch patch;             // at dz = 0, faint = 0
  double w;                // mean along z in voxel indices
  double lean_x, lean_y;   // how the mean of a slice moves with dz: Σxz / Σzz, Σyz / Σzz
  float upright;           // faintness of a slice is upright dz²
  float weight;            // sqrt(det Σ / det Σ')
  int top, bottom;         // rows, cut to the raster
  int front, back;         // slices, cut to the raster; empty if the box is

  // Moves a job with this patch to slice z of a raster whose slices are `size` apart.
  template <int C>
  HOLO_INLINE void move(Job<C>& job, int z, int64_t size) const {
    Patch& p = job.patch;
    job.raster.data += z * size;
    const double dz = z - w, du = lean_x * dz, dv = lean_y * dz;
    p.dx -= static_cast<float>(du), p.dy -= static_cast<float>(dv);
    p.u += du, p.v += dv;
    p.faint = upright * static_cast<float>(dz) * static_cast<float>(dz);
  }

  template <int C>
  HOLO_INLINE Job<C> job(const float* amplitude, const Raster& raster) const {
    Job<C> job;
    job.patch = patch, job.first = top, job.last = bottom, job.raster = raster;
    for (int c = 0; c < C; ++c) job.peak[c] = weight * amplitude[c];
    return job;
  }
};

// The conditional covariance, and the rest of what 16 Gaussians' slices need; Σ' = Σ + variance.
struct alignas(64) Cut {
  Spread spread;
  Outline outline;
  double w[kBlock], zz[kBlock], lean_x[kBlock], lean_y[kBlock], weight[kBlock], reach_z[kBlock];
};

void cut(const Block& g, const HoloGrid& grid, const HoloOptions& options, Cut& out) {
  Spread& s = out.spread;
  for (int k = 0; k < kBlock; ++k) {
    const double xx = g.covariance[XX][k] + options.variance, yy = g.covariance[YY][k] + options.variance;
    const double zz = g.covariance[ZZ][k] + options.variance, xz = g.covariance[XZ][k], yz = g.covariance[YZ][k];
    s.u[k] = g.centre[0][k] + 0.5 * grid.width - 0.5;
    s.v[k] = g.centre[1][k] + 0.5 * grid.height - 0.5;
    out.w[k] = g.centre[2][k] + 0.5 * grid.depth - 0.5;
    out.zz[k] = zz, out.lean_x[k] = xz / zz, out.lean_y[k] = yz / zz;
    const double lx = out.lean_x[k], ly = out.lean_y[k];
    const double inverse = invert(xx - xz * lx, g.covariance[XY][k] - xz * ly, yy - yz * ly, k, s);
    out.weight[k] = g.root[k] * std::sqrt(inverse / zz);
    s.reach_x[k] = options.cutoff * std::sqrt(xx);
    s.reach_y[k] = options.cutoff * std::sqrt(yy);
    out.reach_z[k] = options.cutoff * std::sqrt(zz);
    // A corner lies at most this far from the mean of its slice.
    const double far_x = s.reach_x[k] + std::fabs(out.lean_x[k]) * out.reach_z[k];
    const double far_y = s.reach_y[k] + std::fabs(out.lean_y[k]) * out.reach_z[k];
    s.corner[k] = corner_exponent(s, k, far_x, far_y) + 0.5 * options.cutoff * options.cutoff;
  }
  outline(s, static_cast<int>(grid.width), static_cast<int>(grid.height), out.outline);
}

Slices slices_of(const Cut& cut, const HoloGrid& grid, int k) {
  Slices s;
  const Outline& o = cut.outline;
  s.patch = patch_of(cut.spread, o, k);
  s.w = cut.w[k], s.lean_x = cut.lean_x[k], s.lean_y = cut.lean_y[k];
  s.upright = static_cast<float>(kHalfLog2E / cut.zz[k]);
  s.weight = static_cast<float>(cut.weight[k]);
  s.top = o.top[k], s.bottom = o.bottom[k];
  const double depth = static_cast<double>(grid.depth);
  s.front = ceil_int(within(s.w - cut.reach_z[k], 0, depth));
  s.back = floor_int(within(s.w + cut.reach_z[k], -1, depth - 1));
  if (s.top > s.bottom || o.x0[k] > o.x1[k]) s.front = 0, s.back = -1;
  return s;
}

// Every Gaussian's slices, and for each slab the Gaussians that reach it, in index order.
struct Plan {
  std::unique_ptr<Slices[]> slices;
  int64_t thickness;  // slices of a slab
  std::vector<std::vector<int64_t>> slabs;
};

Plan plan(const HoloCloud& cloud, const HoloGrid& grid, const HoloOptions& options) {
  Plan plan;
  plan.slices.reset(new Slices[cloud.count]);
  parallel_runs(blocks(cloud.count), kRunBlocks, options.threads, [&](int64_t begin, int64_t end) {
    Block block;
    Cut cuts;
    for (int64_t b = begin; b < end; ++b) {
      load_block(cloud, b * kBlock, block);
      cut(block, grid, options, cuts);
      for (int k = 0; k < block.used; ++k) plan.slices[b * kBlock + k] = slices_of(cuts, grid, k);
    }
  });
  plan.thickness = std::clamp<int64_t>(grid.depth / (4 * options.threads), 1, kSlab);
  plan.slabs.resize((grid.depth + plan.thickness - 1) / plan.thickness);
  for (int64_t n = 0; n < cloud.count; ++n) {
    const Slices& s = plan.slices[n];
    if (s.front > s.back) continue;
    const int64_t last = s.back / plan.thickness;
    for (int64_t slab = s.front / plan.thickness; slab <= last; ++slab) plan.slabs[slab].push_back(n);
  }
  return plan;
}

template <int C>
void voxelise(const HoloCloud& cloud, const HoloGrid& grid, const HoloOptions& options, float* volume) {
  const Plan todo = plan(cloud, grid, options);
  const int64_t stride = row_stride(grid.width, C), plane = grid.height * grid.width;
  const int64_t slice_size = grid.height * C * stride;
  parallel(static_cast<int64_t>(todo.slabs.size()), options.threads, [&](int64_t slab) {
    const int64_t first = slab * todo.thickness, depth = std::min(todo.thickness, grid.depth - first);
    const auto memory = buffer(depth * slice_size);
    std::fill_n(memory.get(), depth * slice_size, 0.0f);
    const Raster raster{memory.get() - first * slice_size, C * stride, stride};
    Job<C> jobs[kBatch];
    int count = 0;
    for (const int64_t n : todo.slabs[slab]) {
      const Slices& s = todo.slices[n];
      const Job<C> job = s.template job<C>(cloud.amplitudes + C * n, raster);
      const int64_t to = std::min<int64_t>(s.back, first + depth - 1);
      for (int64_t z = std::max<int64_t>(s.front, first); z <= to; ++z) {
        jobs[count] = job;
        s.move(jobs[count], static_cast<int>(z), slice_size);
        if (++count == kBatch) draw(jobs, kBatch), count = 0;
      }
    }
    draw(jobs, count);
    for (int64_t z = 0; z < depth; ++z)
      crop_rows({memory.get() + z * slice_size, C * stride, stride}, C, grid.height, grid.width,
                volume + (first + z) * plane, grid.depth * plane);
  });
}

// Moments of one Gaussian over all its slices. With (t, d) a voxel's offset from the mean of its slice, t = dx - slope
// dy, and z its offset along z: sums of what a voxel gave, times 1, t, d, z, and their products.
struct Moments {
  double first, second, t, d, z, tt, td, dd, tz, dz, zz;
};

template <int C>
Moments gather_slices(const Slices& s, const Job<C>& job, int64_t slice_size) {
  Moments sum{};
  const double lean = s.patch.needle ? 0.0 : s.patch.slope;
  Job<C> jobs[kBatch];
  float moments[kBatch][kMoments];
  for (int front = s.front; front <= s.back; front += kBatch) {
    const int count = std::min(kBatch, s.back - front + 1);
    for (int k = 0; k < count; ++k) jobs[k] = job, s.move(jobs[k], front + k, slice_size);
    gather(jobs, count, moments);
    for (int k = 0; k < count; ++k) {
      const float* m = moments[k];
      const double all = C == 1 ? m[FIRST] : double(job.peak[0]) * m[FIRST] + double(job.peak[C - 1]) * m[SECOND];
      const double z = front + k - s.w, t = m[ACROSS] - lean * m[DOWN], td = m[ACROSS_DOWN] - lean * m[DOWN2];
      sum.first += m[FIRST], sum.second += m[SECOND];
      sum.t += t, sum.d += m[DOWN], sum.z += z * all;
      sum.tt += m[ACROSS2] - lean * (m[ACROSS_DOWN] + td), sum.td += td, sum.dd += m[DOWN2];
      sum.tz += z * t, sum.dz += z * m[DOWN], sum.zz += z * z * all;
    }
  }
  return sum;
}

// From moments to gradients of centre and covariance. With p = Σ'⁻¹ d: ∂L/∂centre = Σ p and
// ∂L/∂Σ' = ½ (Σ p pᵀ - S₀ Σ'⁻¹). p_x = t / σ², p_y = d / σ_y² - slope p_x, p_z = z / Σzz - lean · (p_x, p_y).
template <int C>
void pull_back(const Block& g, const Cut& cut, int k, const Moments& m, BlockGradient& out) {
  const Spread& s = cut.spread;
  const double weight = cut.weight[k], a0 = g.amplitude[0][k], a1 = C == 2 ? g.amplitude[1][k] : 0.0;
  const double scale = C == 1 ? weight * a0 : 1.0, all = weight * (a0 * m.first + a1 * m.second);
  const double slope = s.slope[k], lx = cut.lean_x[k], ly = cut.lean_y[k];
  const double ix = s.across[k], iy = s.down[k], iz = 1 / cut.zz[k];
  const double px = scale * m.t * ix, py = scale * m.d * iy - slope * px;
  const double pz = scale * m.z * iz - lx * px - ly * py;
  const double cross = scale * m.td * ix * iy, xx = scale * m.tt * ix * ix, xy = cross - slope * xx;
  const double yy = scale * m.dd * iy * iy - slope * (cross + xy);
  const double zx = scale * m.tz * ix * iz, zy = scale * m.dz * iy * iz - slope * zx;  // z/Σzz with p_x, p_y
  const double xz = zx - lx * xx - ly * xy, yz = zy - lx * xy - ly * yy;
  const double zz = scale * m.zz * iz * iz - lx * (zx + xz) - ly * (zy + yz);
  // Σ'⁻¹ from the same factors.
  const double ixy = -ix * slope, iyy = iy + ix * slope * slope;
  const double ixz = -(lx * ix + ly * ixy), iyz = -(lx * ixy + ly * iyy), izz = iz - lx * ixz - ly * iyz;
  out.centre[0][k] = px, out.centre[1][k] = py, out.centre[2][k] = pz;
  out.covariance[XX][k] = 0.5 * (xx - all * ix), out.covariance[XY][k] = 0.5 * (xy - all * ixy);
  out.covariance[XZ][k] = 0.5 * (xz - all * ixz), out.covariance[YY][k] = 0.5 * (yy - all * iyy);
  out.covariance[YZ][k] = 0.5 * (yz - all * iyz), out.covariance[ZZ][k] = 0.5 * (zz - all * izz);
  out.log_root[k] = all;
  out.amplitude[0][k] = weight * m.first, out.amplitude[1][k] = weight * m.second;
}

template <int C>
void voxelise_backward(const HoloCloud& cloud, const HoloGrid& grid, const HoloOptions& options, const float* gradient,
                       const HoloGradients& out) {
  const int64_t stride = row_stride(grid.width, C), plane = grid.height * grid.width;
  const int64_t slice_size = grid.height * C * stride;
  const auto memory = buffer(grid.depth * slice_size);
  parallel(grid.depth, options.threads, [&](int64_t z) {
    pad_rows(gradient + z * plane, grid.depth * plane, C, grid.height, grid.width,
             {memory.get() + z * slice_size, C * stride, stride});
  });
  const Raster raster{memory.get(), C * stride, stride};
  parallel_runs(blocks(cloud.count), kRunBlocks, options.threads, [&](int64_t begin, int64_t end) {
    Block block;
    Cut cuts;
    for (int64_t b = begin; b < end; ++b) {
      load_block(cloud, b * kBlock, block);
      cut(block, grid, options, cuts);
      BlockGradient result{};
      for (int k = 0; k < block.used; ++k) {
        const Slices s = slices_of(cuts, grid, k);
        const Job<C> job = s.template job<C>(cloud.amplitudes + C * (b * kBlock + k), raster);
        pull_back<C>(block, cuts, k, gather_slices<C>(s, job, slice_size), result);
      }
      write_gradient(cloud, b * kBlock, result, out);
    }
  });
}

}  // namespace
}  // namespace holo

int64_t holosplat_voxelise(const HoloCloud* cloud, const HoloGrid* grid, const HoloOptions* options, float* volume) {
  const auto forward = cloud->channels == 1 ? holo::voxelise<1> : holo::voxelise<2>;
  return holo::guarded([&] { forward(*cloud, *grid, *options, volume); });
}

int64_t holosplat_voxelise_backward(const HoloCloud* cloud, const HoloGrid* grid, const HoloOptions* options,
                                    const float* volume_gradient, const HoloGradients* out) {
  const auto backward = cloud->channels == 1 ? holo::voxelise_backward<1> : holo::voxelise_backward<2>;
  return holo::guarded([&] { backward(*cloud, *grid, *options, volume_gradient, *out); });
}
