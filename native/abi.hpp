// The C interface of the native kernels: plain pointers and 64-bit counts, no Python and no torch.
//
// All lengths are in pixels (or voxels). Arrays are C-contiguous, in the shapes that the comments give.
// Every function returns 0, or 1 when memory ran out.
#pragma once

#include <cstdint>

#if defined(_WIN32)
#define HOLO_EXPORT extern "C" __declspec(dllexport)
#else
#define HOLO_EXPORT extern "C" __attribute__((visibility("default")))
#endif

struct HoloCloud {
  int64_t count, channels;    // N Gaussians, C = 1 or 2 amplitudes each
  const float* centres;       // [N, 3] x, y, z
  const float* scales;        // [N, 3] standard deviations, > 0
  const float* quaternions;   // [N, 4] w, x, y, z, not normalised, not zero
  const float* amplitudes;    // [N, C] signed peak values
};

struct HoloGradients {  // of a scalar with respect to the arrays of a HoloCloud, in their shapes
  float* centres;
  float* scales;
  float* quaternions;
  float* amplitudes;
};

struct HoloViews {
  int64_t count, height, width;
  const double* rotations;  // [V, 3, 3] x_lab = R x_object
  const double* shifts;     // [V, 2] detector shift (sx, sy)
};

struct HoloGrid {
  int64_t depth, height, width;  // Z, Y, X
};

struct HoloLattice {
  int64_t depth, height, width;  // Z, Y, X
  double origin[3];              // x, y, z of voxel [0, 0, 0]
  double pitch;                  // voxel edge
};

struct HoloOptions {
  double cutoff;    // half-width of a Gaussian's box in standard deviations
  double variance;  // added to the covariance: what a pixel or voxel does
  int64_t threads;
};

// Changes whenever anything above or below does; the loader refuses another number.
HOLO_EXPORT int64_t holosplat_abi();
// The fastest instruction set of this machine that a library was built for: 0 baseline, 1 AVX2, 2 AVX-512.
HOLO_EXPORT int64_t holosplat_best_isa();

// image [V, C, H, W]
HOLO_EXPORT int64_t holosplat_splat(const HoloCloud*, const HoloViews*, const HoloOptions*, float* image);
HOLO_EXPORT int64_t holosplat_splat_backward(const HoloCloud*, const HoloViews*, const HoloOptions*,
                                             const float* image_gradient, const HoloGradients*);
// volume [C, Z, Y, X]
HOLO_EXPORT int64_t holosplat_voxelise(const HoloCloud*, const HoloGrid*, const HoloOptions*, float* volume);
HOLO_EXPORT int64_t holosplat_voxelise_backward(const HoloCloud*, const HoloGrid*, const HoloOptions*,
                                                const float* volume_gradient, const HoloGradients*);

// Total variation on a volume u [Z, Y, X]; q [3, Z, Y, X] is the dual variable of its forward differences.
// q <- projection of q + step * gradient(u) onto the ball of `radius`, voxel by voxel
HOLO_EXPORT int64_t holosplat_tv_ascend(const HoloGrid*, const float* u, float* q, double step, double radius,
                                        int64_t threads);
// u <- clamp(u - tau (slope + coupling * adjoint_gradient(q)), 0, upper); extrapolated <- 2 u_new - u_old
HOLO_EXPORT int64_t holosplat_tv_descend(const HoloGrid*, const float* slope, const float* tau, const float* q,
                                         double coupling, double upper, float* u, float* extrapolated, int64_t threads);
// value <- sum over voxels with three forward neighbours of sqrt(|gradient(u)|^2 + smoothing^2) - smoothing;
// gradient [Z, Y, X] <- its derivative
HOLO_EXPORT int64_t holosplat_tv_smooth(const HoloGrid*, const float* u, double smoothing, float* gradient,
                                        double* value, int64_t threads);

// Sums of voxels along the beam as bilinear hats, image [V, H, W] from volume [Z, Y, X], and the exact adjoint.
// Voxels whose four pixels do not all lie on the detector are left out.
HOLO_EXPORT int64_t holosplat_lattice_project(const HoloLattice*, const HoloViews*, const float* volume, float* image,
                                              int64_t threads);
HOLO_EXPORT int64_t holosplat_lattice_backproject(const HoloLattice*, const HoloViews*, const float* image,
                                                  float* volume, int64_t threads);
