"""The part that the Triton kernels of the splat and the voxeliser share: from a Gaussian's parameters to its
covariance, and gradients back. As `native/gaussians.hpp`, all in float64: covariances of thin Gaussians, and the
integer boxes that must equal the reference's, do not survive float32.

Everything here works on a vector of Gaussians, one for each lane. `n` are their indices, and `there` says which exist.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
from __future__ import annotations

from dataclasses import dataclass

import triton
import triton.language as tl
from torch import Tensor

Records = tuple[Tensor, Tensor, Tensor]
"""The result of a preparing kernel for R Gaussians: numbers [R, ·] float32, integers [R, ·] int32, and an int64 list
[1 + R] of the Gaussians with large boxes, in any order; its first entry counts them."""

HALF_LOG2_E = tl.constexpr(0.72134752044448170)  # exp(-½ q) = 2^(-q · this)
FAINT = tl.constexpr(-30.0)  # what is fainter than 2^-30 of the peak is left out: only needles' boxes have it
VECTOR, VECTOR_WARPS = 128, 4
"""Gaussians of a program of the kernels in float64, one for each of its threads."""


@dataclass(frozen=True)
class Blocks:
    """Sizes of the launches that work on boxes: no result depends on them but by rounding, only a GPU's speed.

    A program has one warp for every `gaussians`, does that many at once, `lanes` pixels of each at a time, and
    `rounds` such groups one after the other. Boxes of more than `large` pixels are left to `large_programs` programs
    of 8 warps, with `large_lanes` pixels at a time.
    """

    lanes: int = 64
    gaussians: int = 1
    rounds: int = 8
    large: int = 8192
    large_lanes: int = 1024
    large_programs: int = 528


@triton.jit
def load3(array, n, there):
    """Rows `n` of a float32 array [N, 3], as three float64 vectors."""
    x = tl.load(array + 3 * n, mask=there, other=1.0).to(tl.float64)
    y = tl.load(array + 3 * n + 1, mask=there, other=1.0).to(tl.float64)
    z = tl.load(array + 3 * n + 2, mask=there, other=1.0).to(tl.float64)
    return x, y, z


@triton.jit
def load_unit(quaternions, n, there):
    """Unit quaternions `(w, x, y, z)` of rows `n` of [N, 4], and the lengths they had."""
    w = tl.load(quaternions + 4 * n, mask=there, other=1.0).to(tl.float64)
    x = tl.load(quaternions + 4 * n + 1, mask=there, other=1.0).to(tl.float64)
    y = tl.load(quaternions + 4 * n + 2, mask=there, other=1.0).to(tl.float64)
    z = tl.load(quaternions + 4 * n + 3, mask=there, other=1.0).to(tl.float64)
    length = tl.sqrt(w * w + x * x + y * y + z * z)
    inverse = 1.0 / length
    return w * inverse, x * inverse, y * inverse, z * inverse, length


@triton.jit
def rotation_of(w, x, y, z):
    """The rotation matrices of unit quaternions, row by row."""
    r0, r1, r2 = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    r3, r4, r5 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    r6, r7, r8 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return r0, r1, r2, r3, r4, r5, r6, r7, r8


@triton.jit
def load_covariance(scales, quaternions, n, there):
    """Σ = R diag(s²) Rᵀ as xx, xy, xz, yy, yz, zz, and sqrt(det Σ) = s₁s₂s₃, never by way of a determinant."""
    s0, s1, s2 = load3(scales, n, there)
    w, x, y, z, _ = load_unit(quaternions, n, there)
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_of(w, x, y, z)
    v0, v1, v2 = s0 * s0, s1 * s1, s2 * s2
    xx = r0 * r0 * v0 + r1 * r1 * v1 + r2 * r2 * v2
    xy = r0 * r3 * v0 + r1 * r4 * v1 + r2 * r5 * v2
    xz = r0 * r6 * v0 + r1 * r7 * v1 + r2 * r8 * v2
    yy = r3 * r3 * v0 + r4 * r4 * v1 + r5 * r5 * v2
    yz = r3 * r6 * v0 + r4 * r7 * v1 + r5 * r8 * v2
    zz = r6 * r6 * v0 + r7 * r7 * v1 + r8 * r8 * v2
    return xx, xy, xz, yy, yz, zz, s0 * s1 * s2


@triton.jit
def invert(xx, xy, yy):
    """A 2D covariance's factors: across = yy / det, down = 1 / yy, slope = xy / yy, and 1 / det.

    With t = x - slope y, the square (x, y) Σ⁻¹ (x, y)ᵀ is across t² + down y²: a sum in which nothing cancels.
    """
    det = tl.maximum(xx * yy - xy * xy, 1e-30 * (xx * yy) + 1e-200)
    down = 1.0 / yy
    return yy / det, down, xy * down, 1.0 / det


@triton.jit
def box(middle, reach, count):
    """First pixel, and how many, of the boxes `middle ± reach` cut to `count` pixels: as `reference.boxes`."""
    first = tl.minimum(tl.maximum(tl.ceil(middle - reach), 0.0), count)
    last = tl.minimum(tl.maximum(tl.floor(middle + reach), -1.0), count - 1)
    return first, tl.maximum(last - first + 1, 0.0)


@triton.jit
def anchor(middle):
    """The pixel nearest the mean: offsets from it are whole numbers, exact in float32."""
    return tl.floor(tl.minimum(tl.maximum(middle, -8388608.0), 8388608.0) + 0.5)


@triton.jit
def is_finite(a, b, c):
    """Whether three numbers are finite, and of a size that means anything (not so for NaN)."""
    return (tl.abs(a) < 1e100) & (tl.abs(b) < 1e100) & (tl.abs(c) < 1e100)


@triton.jit
def store3(array, n, there, x, y, z):
    """Three vectors to rows `n` of a float32 array [N, 3]; zero where they are not finite."""
    well = is_finite(x, y, z)
    tl.store(array + 3 * n, tl.where(well, x, 0.0).to(tl.float32), mask=there)
    tl.store(array + 3 * n + 1, tl.where(well, y, 0.0).to(tl.float32), mask=there)
    tl.store(array + 3 * n + 2, tl.where(well, z, 0.0).to(tl.float32), mask=there)


@triton.jit
def load_amplitudes(amplitudes, n, there, C: tl.constexpr):
    """First and last channel of rows `n` of [N, C], in float64."""
    a0 = tl.load(amplitudes + C * n, mask=there, other=0.0).to(tl.float64)
    return a0, tl.load(amplitudes + C * n + C - 1, mask=there, other=0.0).to(tl.float64)


@triton.jit
def store_amplitude(at, there, gradient):
    """One channel's gradients to the places `at`; zero where they are not finite."""
    tl.store(at, tl.where(is_finite(gradient, gradient, gradient), gradient, 0.0).to(tl.float32), mask=there)


@triton.jit
def _axis(rx, ry, rz, s, xx, xy, xz, yy, yz, zz, log_root):
    # ∂L/∂s and a column of ∂L/∂R = 2 K R D, of one of the Gaussian's own axes r, from K = ∂L/∂Σ.
    kx = xx * rx + xy * ry + xz * rz
    ky = xy * rx + yy * ry + yz * rz
    kz = xz * rx + yz * ry + zz * rz
    scale = 2 * s * (rx * kx + ry * ky + rz * kz) + log_root / s
    return scale, 2 * s * s * kx, 2 * s * s * ky, 2 * s * s * kz


@triton.jit
def _rotation_gradient(w, x, y, z, g0, g1, g2, g3, g4, g5, g6, g7, g8):
    # ∂L/∂(w, x, y, z) of a unit quaternion, from G = ∂L/∂R.
    dw = 2 * (x * (g7 - g5) + y * (g2 - g6) + z * (g3 - g1))
    dx = 2 * (w * (g7 - g5) - 2 * x * (g4 + g8) + y * (g1 + g3) + z * (g2 + g6))
    dy = 2 * (w * (g2 - g6) + x * (g1 + g3) - 2 * y * (g0 + g8) + z * (g5 + g7))
    dz = 2 * (w * (g3 - g1) + x * (g2 + g6) + y * (g5 + g7) - 2 * z * (g0 + g4))
    return dw, dx, dy, dz


@triton.jit
def _store_chain(
    scales, quaternions, d_scales, d_quaternions, n, there, xx, xy, xz, yy, yz, zz, log_root
):  # fmt: skip
    # From ∂L/∂Σ (a full symmetric matrix) and ∂L/∂ log s₁s₂s₃ to the gradients of scales and quaternions, stored.
    # The gradient of a normalised quaternion has no part along it.
    s0, s1, s2 = load3(scales, n, there)
    w, x, y, z, length = load_unit(quaternions, n, there)
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_of(w, x, y, z)
    d0, g0, g3, g6 = _axis(r0, r3, r6, s0, xx, xy, xz, yy, yz, zz, log_root)
    d1, g1, g4, g7 = _axis(r1, r4, r7, s1, xx, xy, xz, yy, yz, zz, log_root)
    d2, g2, g5, g8 = _axis(r2, r5, r8, s2, xx, xy, xz, yy, yz, zz, log_root)
    store3(d_scales, n, there, d0, d1, d2)
    dw, dx, dy, dz = _rotation_gradient(w, x, y, z, g0, g1, g2, g3, g4, g5, g6, g7, g8)
    along = w * dw + x * dx + y * dy + z * dz
    dw, dx, dy, dz = (dw - along * w), (dx - along * x), (dy - along * y), (dz - along * z)
    well = is_finite(dw, dx, dy) & is_finite(dz, length, length)
    inverse = 1.0 / length
    tl.store(d_quaternions + 4 * n, tl.where(well, dw * inverse, 0.0).to(tl.float32), mask=there)
    tl.store(d_quaternions + 4 * n + 1, tl.where(well, dx * inverse, 0.0).to(tl.float32), mask=there)
    tl.store(d_quaternions + 4 * n + 2, tl.where(well, dy * inverse, 0.0).to(tl.float32), mask=there)
    tl.store(d_quaternions + 4 * n + 3, tl.where(well, dz * inverse, 0.0).to(tl.float32), mask=there)
