// Blocks of Gaussians: from their parameters to centre, covariance and mass, and gradients back.
//
// All of this is in double precision: covariances of thin Gaussians, and the integer boxes that must equal the
// reference's, do not survive single precision. Loops over a block are written for the compiler to vectorise.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "abi.hpp"

namespace holo {

constexpr int kBlock = 16;
enum { XX, XY, XZ, YY, YZ, ZZ, kCovariance };

inline int64_t blocks(int64_t count) { return (count + kBlock - 1) / kBlock; }

// What views and grids need to know of 16 Gaussians. Missing ones at the end are copies of the last.
struct alignas(64) Block {
  double centre[3][kBlock];
  double covariance[kCovariance][kBlock];  // Σ = R_q diag(s²) R_qᵀ
  double root[kBlock];                     // sqrt(det Σ) = s₁ s₂ s₃, never by way of a determinant
  float amplitude[2][kBlock];
  int used;
};

// Sums over views and pixels, for 16 Gaussians: all that the gradients of their parameters depend on.
struct alignas(64) BlockGradient {
  double centre[3][kBlock];
  double covariance[kCovariance][kBlock];  // ∂L/∂Σ as a full symmetric matrix, at constant root
  double log_root[kBlock];                 // ∂L/∂ log sqrt(det Σ), at constant Σ
  double amplitude[2][kBlock];
};

// The parameters of 16 Gaussians, transposed, with unit quaternions.
struct alignas(64) Parameters {
  double scale[3][kBlock];
  double unit[4][kBlock];
  double length[kBlock];
};

// Fetches what a later block reads (or writes), whose Gaussians may lie anywhere in the arrays.
template <bool kWrite, class Arrays>
inline void prefetch(const Arrays& arrays, int64_t channels, const int64_t* order, int used) {
  for (int k = 0; k < used; ++k) {
    __builtin_prefetch(arrays.centres + 3 * order[k], kWrite);
    __builtin_prefetch(arrays.scales + 3 * order[k], kWrite);
    __builtin_prefetch(arrays.quaternions + 4 * order[k], kWrite);
    __builtin_prefetch(arrays.amplitudes + channels * order[k], kWrite);
  }
}

inline void read(const HoloCloud& cloud, const int64_t* order, int used, Parameters& p) {
  for (int k = 0; k < kBlock; ++k) {
    const int64_t n = order[std::min(k, used - 1)];
    for (int d = 0; d < 3; ++d) p.scale[d][k] = cloud.scales[3 * n + d];
    for (int d = 0; d < 4; ++d) p.unit[d][k] = cloud.quaternions[4 * n + d];
  }
  for (int k = 0; k < kBlock; ++k) {
    const double w = p.unit[0][k], x = p.unit[1][k], y = p.unit[2][k], z = p.unit[3][k];
    p.length[k] = std::sqrt(w * w + x * x + y * y + z * z);
    const double inverse = 1 / p.length[k];
    for (int d = 0; d < 4; ++d) p.unit[d][k] *= inverse;
  }
}

// The rotation matrix of a unit quaternion, row by row.
inline void rotation_of(double w, double x, double y, double z, double r[9]) {
  r[0] = 1 - 2 * (y * y + z * z), r[1] = 2 * (x * y - w * z), r[2] = 2 * (x * z + w * y);
  r[3] = 2 * (x * y + w * z), r[4] = 1 - 2 * (x * x + z * z), r[5] = 2 * (y * z - w * x);
  r[6] = 2 * (x * z - w * y), r[7] = 2 * (y * z + w * x), r[8] = 1 - 2 * (x * x + y * y);
}

inline void load_block(const HoloCloud& cloud, const int64_t* order, int64_t first, Block& block) {
  Parameters p;
  block.used = static_cast<int>(std::min<int64_t>(kBlock, cloud.count - first));
  read(cloud, order + first, block.used, p);
  const int64_t next = std::min(first + kBlock, cloud.count);
  prefetch<false>(cloud, cloud.channels, order + next, static_cast<int>(std::min<int64_t>(kBlock, cloud.count - next)));
  for (int k = 0; k < kBlock; ++k) {
    const int64_t n = order[first + std::min(k, block.used - 1)];
    for (int d = 0; d < 3; ++d) block.centre[d][k] = cloud.centres[3 * n + d];
    for (int c = 0; c < cloud.channels; ++c) block.amplitude[c][k] = cloud.amplitudes[cloud.channels * n + c];
  }
  for (int k = 0; k < kBlock; ++k) {
    double r[9];
    rotation_of(p.unit[0][k], p.unit[1][k], p.unit[2][k], p.unit[3][k], r);
    const double s0 = p.scale[0][k], s1 = p.scale[1][k], s2 = p.scale[2][k];
    const double v0 = s0 * s0, v1 = s1 * s1, v2 = s2 * s2;
    block.covariance[XX][k] = r[0] * r[0] * v0 + r[1] * r[1] * v1 + r[2] * r[2] * v2;
    block.covariance[XY][k] = r[0] * r[3] * v0 + r[1] * r[4] * v1 + r[2] * r[5] * v2;
    block.covariance[XZ][k] = r[0] * r[6] * v0 + r[1] * r[7] * v1 + r[2] * r[8] * v2;
    block.covariance[YY][k] = r[3] * r[3] * v0 + r[4] * r[4] * v1 + r[5] * r[5] * v2;
    block.covariance[YZ][k] = r[3] * r[6] * v0 + r[4] * r[7] * v1 + r[5] * r[8] * v2;
    block.covariance[ZZ][k] = r[6] * r[6] * v0 + r[7] * r[7] * v1 + r[8] * r[8] * v2;
    block.root[k] = s0 * s1 * s2;
  }
}

// ∂L/∂(w, x, y, z) of a unit quaternion, from G = ∂L/∂R.
inline void rotation_gradient(double w, double x, double y, double z, const double g[9], double out[4]) {
  out[0] = 2 * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]));
  out[1] = 2 * (w * (g[7] - g[5]) - 2 * x * (g[4] + g[8]) + y * (g[1] + g[3]) + z * (g[2] + g[6]));
  out[2] = 2 * (w * (g[2] - g[6]) + x * (g[1] + g[3]) - 2 * y * (g[0] + g[8]) + z * (g[5] + g[7]));
  out[3] = 2 * (w * (g[3] - g[1]) + x * (g[2] + g[6]) + y * (g[5] + g[7]) - 2 * z * (g[0] + g[4]));
}

// From ∂L/∂Σ to scales and quaternions: Σ = R D Rᵀ with D = diag(s²), so ∂L/∂R = 2 K R D and
// ∂L/∂s_j = 2 s_j r_jᵀ K r_j + (∂L/∂ log root) / s_j; the gradient of a normalised vector has no part along it.
inline void chain(const Parameters& p, const BlockGradient& g, double scale[3][kBlock], double quaternion[4][kBlock]) {
  for (int k = 0; k < kBlock; ++k) {
    const double w = p.unit[0][k], x = p.unit[1][k], y = p.unit[2][k], z = p.unit[3][k];
    double r[9], turn[9], unit[4];
    rotation_of(w, x, y, z, r);
    const double xx = g.covariance[XX][k], xy = g.covariance[XY][k], xz = g.covariance[XZ][k];
    const double yy = g.covariance[YY][k], yz = g.covariance[YZ][k], zz = g.covariance[ZZ][k];
    for (int j = 0; j < 3; ++j) {
      const double kx = xx * r[j] + xy * r[3 + j] + xz * r[6 + j];
      const double ky = xy * r[j] + yy * r[3 + j] + yz * r[6 + j];
      const double kz = xz * r[j] + yz * r[3 + j] + zz * r[6 + j];
      const double s = p.scale[j][k];
      scale[j][k] = 2 * s * (r[j] * kx + r[3 + j] * ky + r[6 + j] * kz) + g.log_root[k] / s;
      turn[j] = 2 * s * s * kx, turn[3 + j] = 2 * s * s * ky, turn[6 + j] = 2 * s * s * kz;
    }
    rotation_gradient(w, x, y, z, turn, unit);
    const double along = w * unit[0] + x * unit[1] + y * unit[2] + z * unit[3];
    const double inverse = 1 / p.length[k];
    quaternion[0][k] = (unit[0] - along * w) * inverse;
    quaternion[1][k] = (unit[1] - along * x) * inverse;
    quaternion[2][k] = (unit[2] - along * y) * inverse;
    quaternion[3][k] = (unit[3] - along * z) * inverse;
  }
}

inline void write_gradient(const HoloCloud& cloud, const int64_t* order, int64_t first, const BlockGradient& g,
                           const HoloGradients& out) {
  alignas(64) double scale[3][kBlock], quaternion[4][kBlock];
  Parameters p;
  const int used = static_cast<int>(std::min<int64_t>(kBlock, cloud.count - first));
  read(cloud, order + first, used, p);
  const int64_t next = std::min(first + kBlock, cloud.count);
  const int more = static_cast<int>(std::min<int64_t>(kBlock, cloud.count - next));
  prefetch<true>(out, cloud.channels, order + next, more);
  prefetch<false>(cloud, cloud.channels, order + next, more);
  chain(p, g, scale, quaternion);
  for (int k = 0; k < used; ++k) {
    const int64_t n = order[first + k];
    for (int d = 0; d < 3; ++d) out.centres[3 * n + d] = static_cast<float>(g.centre[d][k]);
    for (int d = 0; d < 3; ++d) out.scales[3 * n + d] = static_cast<float>(scale[d][k]);
    for (int d = 0; d < 4; ++d) out.quaternions[4 * n + d] = static_cast<float>(quaternion[d][k]);
    for (int c = 0; c < cloud.channels; ++c)
      out.amplitudes[cloud.channels * n + c] = static_cast<float>(g.amplitude[c][k]);
  }
}

}  // namespace holo
