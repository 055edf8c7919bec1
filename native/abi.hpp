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
  const double* curvatures; // [V] one over the distance of the source at (0, 0, -R) of the lab; null: parallel beams
};

struct HoloViewGradients {  // of a scalar with respect to the arrays of a HoloViews, in their shapes
  double* rotations;  // as if all nine numbers of a matrix were free
  double* shifts;
  double* curvatures;  // null in parallel beams
};

struct HoloGrid {
  int64_t depth, height, width;  // Z, Y, X
};

struct HoloRaster {
  int64_t count, channels, height, width;  // V, C (1 or 2), H, W
};

struct HoloDetector {  // frames of `rows` x `columns` pixels, each of factor x factor samples of V rasters
  int64_t count, height, width;
  int64_t rows, columns, margin_y, margin_x, factor;  // margins in samples
  int64_t lanes;  // real images in a complex one: 1, or 2 (view 2k as real part, 2k + 1 as imaginary part)
};

struct HoloTarget {  // measured frames, compared after the affine map that takes `low` to 0 and `low + span` to 1
  int64_t count, height, width;  // V, H, W; H and W at least 11, the width of the window of local moments
  const float* frames;           // [V, H, W]
  const float* statistics;       // [V, 2, H - 10, W - 10] local mean and variance of the mapped frames
  double low, span;
};

struct HoloAdam {  // K arrays under optimisation; each member but the count points to K entries
  int64_t count;
  const int64_t* lengths;
  float* const* parameters;
  const float* const* gradients;
  float* const* first;   // running means of the gradient
  float* const* second;  // and of its square
};

struct HoloLattice {
  int64_t depth, height, width;  // Z, Y, X
  double origin[3];              // x, y, z of voxel [0, 0, 0]
  double pitch[3];               // voxel edges along x, y, z
};

struct HoloSurface {  // triangles seen in V views
  int64_t vertices, faces;  // P, F
  const double* points;     // [V, P, 3] column, row, depth; pixel (i, j) has its centre at row i, column j
  const int64_t* corners;   // [F, 3] vertices, counter-clockwise seen from outside
};

struct HoloSlices {  // a sparse matrix that all slices share: what each voxel of a slice adds to its rays
  int64_t voxels, rays, slices;
  const int64_t* starts;  // [voxels + 1] of each voxel's entries
  const int64_t* places;  // [entries] the ray of each
  const float* weights;   // [entries]
};

struct HoloRays {  // rays through slices [depth, height, width] whose outermost rows and columns are zeros
  int64_t depth, height, width, count;
  const float* places;  // [5, count] in voxels: row in the middle of the stack, rows a slice, column, columns a slice;
                        // and the length of the ray from slice to slice, in any unit
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
// Gradients of the views are left out if the last pointer is null.
HOLO_EXPORT int64_t holosplat_splat_backward(const HoloCloud*, const HoloViews*, const HoloOptions*,
                                             const float* image_gradient, const HoloGradients*,
                                             const HoloViewGradients*);
// volume [C, Z, Y, X]
HOLO_EXPORT int64_t holosplat_voxelise(const HoloCloud*, const HoloGrid*, const HoloOptions*, float* volume);
HOLO_EXPORT int64_t holosplat_voxelise_backward(const HoloCloud*, const HoloGrid*, const HoloOptions*,
                                                const float* volume_gradient, const HoloGradients*);

// Total variation on a volume u [Z, Y, X]; q [3, Z, Y, X] is the dual variable of its forward differences.
// q <- projection of q + step * gradient(u) onto the ball of `radius`, voxel by voxel
HOLO_EXPORT int64_t holosplat_tv_ascend(const HoloGrid*, const float* u, float* q, double step, double radius,
                                        int64_t threads);
// u <- clamp(u - tau (slope + coupling * adjoint_gradient(q)), lower, upper); extrapolated <- 2 u_new - u_old
HOLO_EXPORT int64_t holosplat_tv_descend(const HoloGrid*, const float* slope, const float* tau, const float* q,
                                         double coupling, double lower, double upper, float* u, float* extrapolated,
                                         int64_t threads);
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
// Derivatives of the scalar whose derivative by the image is `image_gradient`: by the first two rows of each rotation,
// rotations [V, 2, 3], and by the shifts [V, 2]. Where a voxel lies on a pixel's centre (within 1e-6), whose hats have
// a kink there, the mean of both sides' derivatives.
HOLO_EXPORT int64_t holosplat_lattice_poses(const HoloLattice*, const HoloViews*, const float* volume,
                                            const float* image_gradient, double* rotations, double* shifts,
                                            int64_t threads);

// Line integrals along rays, image [count] from volume [depth, height, width], and the exact adjoint, which adds to the
// volume. gradients [5, count] <- derivatives by the
// rays' `places` of the scalar whose derivative by the image is `image_gradient`.
HOLO_EXPORT int64_t holosplat_rays_project(const HoloRays*, const float* volume, float* image, int64_t threads);
HOLO_EXPORT int64_t holosplat_rays_backproject(const HoloRays*, const float* image, float* volume, int64_t threads);
HOLO_EXPORT int64_t holosplat_rays_gradients(const HoloRays*, const float* volume, const float* image_gradient,
                                             float* gradients, int64_t threads);

// lines [rays, slices] from volume [voxels, slices], and the exact adjoint.
HOLO_EXPORT int64_t holosplat_slices_project(const HoloSlices*, const float* volume, float* lines, int64_t threads);
HOLO_EXPORT int64_t holosplat_slices_backproject(const HoloSlices*, const float* lines, float* volume,
                                                 int64_t threads);

// Thickness of what closed surfaces enclose, image [V, H, W]: along rows the mean over each pixel, across them the mean
// over `lines` lines of it.
HOLO_EXPORT int64_t holosplat_surface(const HoloSurface*, const HoloRaster*, int64_t lines, double* image,
                                      int64_t threads);
// What each corner of each triangle gets of `image_gradient` [V, H, W], linear between pixels: shares [F, 3] <- sum over
// views of weights[v] times the sum, over three points of equal weight, of the image times the corner's hat.
HOLO_EXPORT int64_t holosplat_surface_shares(const HoloSurface*, const HoloRaster*, const double* image_gradient,
                                             const double* weights, double* shares, int64_t threads);
// Derivatives of the scalar whose derivative by the image is `image_gradient` [V, H, W], linear between pixels: by each
// view's rotation, rotations [V, 3, 3], and by its shift, shifts [V, 2]; vertices [P, 3] in the object frame.
HOLO_EXPORT int64_t holosplat_surface_poses(const HoloSurface*, const HoloRaster*, const double* vertices,
                                            const double* image_gradient, double* rotations, double* shifts,
                                            int64_t threads);

// Depths of closed meshes, image [C, H, W] <- mean over rays x rays rays of each pixel of the sum over hits of z value,
// positive where the ray leaves, divided by 1 - bent z; points are (column, row, z) on the lattice of the rays, in one
// view; values [C, F].
HOLO_EXPORT int64_t holosplat_mesh_depths(const HoloSurface*, const HoloRaster*, const double* values, int64_t rays,
                                          double bent, double* image, int64_t threads);

// Wave optics, between the Fourier transforms that the caller does. Complex arrays are float pairs (re, im).
// wave [V, H, W] <- exp(-loss - i phase) - 1 with phase = sum over channels of refraction[v][c][0] lines[v][c], and loss
// of refraction[v][c][1]; refraction [V, C, 2], lines [V, C, H, W]
HOLO_EXPORT int64_t holosplat_exit_wave(const HoloRaster*, const double* refraction, const float* lines, float* wave,
                                        int64_t threads);
HOLO_EXPORT int64_t holosplat_exit_wave_backward(const HoloRaster*, const double* refraction, const float* lines,
                                                 const float* wave_gradient, float* lines_gradient, int64_t threads);
// spectrum [V, H, W] <- scale spectrum rows[v, y] columns[v, x], or times the conjugate; rows [V, H], columns [V, W]
HOLO_EXPORT int64_t holosplat_transfer(const HoloRaster*, const float* rows, const float* columns, double scale,
                                       int64_t conjugate, float* spectrum, int64_t threads);
// frames [V, rows, columns] <- mean of |1 + wave|^2 over each pixel's samples; backward: wave <- gradient, in place
HOLO_EXPORT int64_t holosplat_intensity(const HoloDetector*, const float* wave, float* frames, int64_t threads);
HOLO_EXPORT int64_t holosplat_intensity_backward(const HoloDetector*, const float* frame_gradient, float* wave,
                                                 int64_t threads);
// The same in two steps, for a blur in between: images [V / lanes, H, W] (complex) <- |1 + wave|^2 - 1, and
// frames <- 1 + their mean over each pixel's samples
HOLO_EXPORT int64_t holosplat_contrast(const HoloDetector*, const float* wave, float* images, int64_t threads);
HOLO_EXPORT int64_t holosplat_contrast_backward(const HoloDetector*, const float* images, float* wave,
                                                int64_t threads);
HOLO_EXPORT int64_t holosplat_bin(const HoloDetector*, const float* images, float* frames, int64_t threads);
HOLO_EXPORT int64_t holosplat_bin_backward(const HoloDetector*, const float* frame_gradient, float* images,
                                           int64_t threads);

// The local moments of frames under the Gaussian window of SSIM; target.statistics is not read.
HOLO_EXPORT int64_t holosplat_fidelity_statistics(const HoloTarget*, float* statistics, int64_t threads);
// values [V, 2] <- mean absolute difference, and 1 - mean SSIM, of predicted [V, H, W] and the target;
// gradient [V, H, W] <- derivative of the latter, unless it is null
HOLO_EXPORT int64_t holosplat_fidelity(const HoloTarget*, const float* predicted, double* values, float* gradient,
                                       int64_t threads);
// out <- upstream[v, 0] derivative of the mean absolute difference + upstream[v, 1] gradient; upstream [V, 2]
HOLO_EXPORT int64_t holosplat_fidelity_backward(const HoloTarget*, const float* predicted, const float* upstream,
                                                const float* gradient, float* out, int64_t threads);

// One step of Adam: first += 0.1 (g - first); second += 0.001 (g^2 - second);
// parameter -= factors[k] first / (sqrt(second) + factors[count])
HOLO_EXPORT int64_t holosplat_adam(const HoloAdam*, const float* factors, int64_t threads);
