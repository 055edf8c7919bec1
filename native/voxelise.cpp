// A Gaussian cloud on a voxel raster, and its gradients.
//
// A slice through a 3D Gaussian at constant z is a 2D Gaussian: the conditional one, whose mean moves along a line
// with z and whose covariance does not change. So each slice is a patch, as in the splat.
//
// Forward: a task is a slab of slices and adds, in one order (order.hpp), the Gaussians that reach it. Backward: a task
// is a run of Gaussians. No two tasks write the same number, and nothing depends on the number of threads.

#include <vector>

#include "order.hpp"
#include "outline.hpp"
#include "threads.hpp"

namespace holo {
namespace {

constexpr int64_t kRunBlocks = 32;
constexpr int kSlowest = 2;  // axis of a volume in memory
constexpr int64_t kSlab = 8;  // slices at most: a slab of a common volume stays in the second-level cache

// The conditional Gaussian of one Gaussian's slices, on the raster.
struct Slices {
  Patch patch;            // at dz = 0, faint = 0
  Crest crest;
  double w;               // mean along z in voxel indices
  double lean_x, lean_y;  // how the mean of a slice moves with dz: Σxz / Σzz, Σyz / Σzz
  float upright;          // faintness of a slice is upright dz²
  float peak[2];          // amplitudes times sqrt(det Σ / det Σ')
  int top, bottom;        // rows, cut to the raster
  int front, back;        // slices, cut to the raster; empty if the box is

  // Adds slice z of a raster whose slices are `size` apart to a batch.
  template <int C>
  HOLO_INLINE void add_slice(int z, int64_t size, float* raster, Batch<C>& batch) const {
    Job<C>& job = batch.jobs[batch.count];
    const double dz = z - w, du = lean_x * dz, dv = lean_y * dz;
    job.patch = patch;
    job.patch.dx -= static_cast<float>(du), job.patch.dy -= static_cast<float>(dv);
    job.patch.faint = upright * static_cast<float>(dz) * static_cast<float>(dz);
    job.first = top, job.last = bottom;
    job.start = anchor_at(job.patch, anchor(patch, top));
    for (int c = 0; c < C; ++c) job.peak[c] = peak[c];
    job.raster = raster + z * size;
    Crest& moved = batch.crests[batch.count++] = crest;
    moved.u += du, moved.v += dv;
  }
};

// The conditional covariance, and the rest of what 16 Gaussians' slices need; Σ' = Σ + variance.
struct alignas(64) Cut {
  Spread spread;
  Outline outline;
  double w[kBlock], zz[kBlock], lean_x[kBlock], lean_y[kBlock], weight[kBlock], reach_z[kBlock];
};

void cut(const Block& g, const HoloGrid& grid, const HoloOptions& options, int align, Cut& out) {
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
  outline(s, static_cast<int>(grid.width), static_cast<int>(grid.height), align, out.outline);
}

template <int C>
Slices slices_of(const Block& g, const Cut& cut, const HoloGrid& grid, int k) {
  Slices s;
  const Outline& o = cut.outline;
  s.patch = patch_of(o, k), s.crest = crest_of(cut.spread, o, k);
  s.w = cut.w[k], s.lean_x = cut.lean_x[k], s.lean_y = cut.lean_y[k];
  s.upright = static_cast<float>(-kHalfLog2E / cut.zz[k]);
  for (int c = 0; c < C; ++c) s.peak[c] = static_cast<float>(cut.weight[k]) * g.amplitude[c][k];
  s.top = o.top[k], s.bottom = o.bottom[k];
  const double depth = static_cast<double>(grid.depth);
  s.front = ceil_int(within(s.w - cut.reach_z[k], 0, depth));
  s.back = floor_int(within(s.w + cut.reach_z[k], -1, depth - 1));
  if (s.top > s.bottom || o.begin[k] > o.end[k] || !all_finite<C>(s.peak)) s.front = 0, s.back = -1;
  return s;
}

// The slices of every Gaussian in drawing order, and for each slab the places in it of those that reach the slab.
struct Plan {
  std::unique_ptr<Slices[]> slices;
  int64_t thickness;  // slices of a slab
  std::vector<std::vector<int64_t>> slabs;
};

template <int C>
Plan plan(const HoloCloud& cloud, const HoloGrid& grid, const HoloOptions& options) {
  Plan plan;
  const auto order = drawing_order(cloud, kSlowest, options.threads);
  plan.slices.reset(new Slices[cloud.count]);
  parallel_runs(blocks(cloud.count), kRunBlocks, options.threads, [&](int64_t begin, int64_t end) {
    Block block;
    Cut cuts;
    for (int64_t b = begin; b < end; ++b) {
      load_block(cloud, order.get(), b * kBlock, block);
      cut(block, grid, options, kUnit, cuts);
      for (int k = 0; k < block.used; ++k) plan.slices[b * kBlock + k] = slices_of<C>(block, cuts, grid, k);
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
  const Plan todo = plan<C>(cloud, grid, options);
  const int64_t stride = row_stride(grid.width, C), plane = grid.height * grid.width;
  const int64_t slice_size = grid.height * C * stride;
  std::vector<Buffer> rasters(static_cast<size_t>(std::max<int64_t>(1, options.threads)));
  parallel(static_cast<int64_t>(todo.slabs.size()), options.threads, [&](int64_t slab, int64_t thread) {
    const int64_t first = slab * todo.thickness, depth = std::min(todo.thickness, grid.depth - first);
    Buffer& memory = rasters[thread];
    if (!memory.get()) memory = zeros(todo.thickness * slice_size);
    Batch<C> batch;
    batch.strides = {C * stride, stride};
    for (const int64_t place : todo.slabs[slab]) {
      const Slices& s = todo.slices[place];
      const int64_t to = std::min<int64_t>(s.back, first + depth - 1);
      for (int64_t z = std::max<int64_t>(s.front, first); z <= to; ++z) {
        s.add_slice(static_cast<int>(z), slice_size, memory.get() - first * slice_size, batch);
        if (batch.count == kBatch) draw(batch), batch.count = 0;
      }
    }
    draw(batch);
    for (int64_t z = 0; z < depth; ++z)
      take_rows({memory.get() + z * slice_size, batch.strides}, C, grid.height, grid.width,
                volume + (first + z) * plane, grid.depth * plane);
  });
}

// Moments of one Gaussian over all its slices. With (t, d) a voxel's offset from the mean of its slice, t = dx - slope
// dy, and z its offset along z: sums of what a voxel gave, times 1, t, d, z, and their products.
struct Moments {
  double first, second, t, d, z, tt, td, dd, tz, dz, zz;
};

template <int C>
Moments gather_slices(const Slices& s, const Raster& raster, int64_t slice_size) {
  Moments sum{};
  const double lean = s.crest.needle ? 0.0 : s.crest.slope;
  Batch<C> batch;
  batch.strides = raster.strides;
  alignas(64) float moments[kBatch][kMoments];
  for (int front = s.front; front <= s.back; front += kBatch) {
    const int count = std::min(kBatch, s.back - front + 1);
    batch.count = 0;
    for (int k = 0; k < count; ++k) s.add_slice(front + k, slice_size, raster.data, batch);
    gather(batch, moments);
    for (int k = 0; k < count; ++k) {
      const float* m = moments[k];
      const double all = C == 1 ? m[FIRST] : double(s.peak[0]) * m[FIRST] + double(s.peak[1]) * m[SECOND];
      const double end = m[END], d = end * all - m[UP], dd = end * (end * all - 2.0 * m[UP]) + m[UP2];
      const double xd = end * m[ACROSS] - m[ACROSS_UP];
      const double z = front + k - s.w, t = m[ACROSS] - lean * d, td = xd - lean * dd;
      sum.first += m[FIRST], sum.second += m[SECOND];
      sum.t += t, sum.d += d, sum.z += z * all;
      sum.tt += m[ACROSS2] - lean * (xd + td), sum.td += td, sum.dd += dd;
      sum.tz += z * t, sum.dz += z * d, sum.zz += z * z * all;
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
  const Buffer memory(grid.depth * slice_size);
  parallel(grid.depth, options.threads, [&](int64_t z) {
    pad_rows(gradient + z * plane, grid.depth * plane, C, grid.height, grid.width,
             {memory.get() + z * slice_size, {C * stride, stride}});
  });
  const Raster raster{memory.get(), {C * stride, stride}};
  const auto order = drawing_order(cloud, kSlowest, options.threads);
  parallel_runs(blocks(cloud.count), kRunBlocks, options.threads, [&](int64_t begin, int64_t end) {
    Block block;
    Cut cuts;
    for (int64_t b = begin; b < end; ++b) {
      load_block(cloud, order.get(), b * kBlock, block);
      cut(block, grid, options, 1, cuts);
      BlockGradient result{};
      for (int k = 0; k < block.used; ++k) {
        const Slices s = slices_of<C>(block, cuts, grid, k);
        pull_back<C>(block, cuts, k, gather_slices<C>(s, raster, slice_size), result);
      }
      write_gradient(cloud, order.get(), b * kBlock, result, out);
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
