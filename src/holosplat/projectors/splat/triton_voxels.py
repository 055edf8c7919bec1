"""A Gaussian cloud on a voxel raster on the GPU, and its gradients. As `triton_splat.py`, but in 3D, without views.

1. `_prepare`: for every Gaussian, in float64: its box and a record of float32 numbers.
2. `triton_boxes.draw`: every record adds its Gaussian to its box of voxels.
3. `triton_boxes.gather`: moments of the volume's gradient under every Gaussian, without atomics.
4. `_pull_back`: from moments to gradients, in float64.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from . import triton_boxes
from .triton_boxes import FLOATS, INTEGERS, MOMENTS
from .triton_cloud import (
    HALF_LOG2_E,
    VECTOR,
    VECTOR_WARPS,
    Records,
    _store_chain,
    anchor,
    box,
    invert,
    is_finite,
    load3,
    load_amplitudes,
    load_covariance,
    store3,
    store_amplitude,
)


def draw(cloud: tuple[Tensor, ...], shape: tuple[int, ...], cutoff: float, variance: float) -> tuple[Tensor, Records]:
    """The volume [C, Z, Y, X], and the records that `gather` wants back.

    cloud: centres, scales, quaternions, amplitudes, float32 and contiguous; lengths in voxels.
    """
    centres, (n, c) = cloud[0], cloud[3].shape
    volume = centres.new_zeros(c, *shape)
    records = (
        centres.new_empty(n, FLOATS.value),
        centres.new_empty(n, INTEGERS.value, dtype=torch.int32),
        centres.new_empty(1 + n, dtype=torch.int64),
    )
    if n:
        records[2][:1].zero_()
        grid, sizes = (triton.cdiv(n, VECTOR),), (n, *shape, triton_boxes.BLOCKS.large, c, cutoff, variance)
        _prepare[grid](*cloud, *records, *sizes, VECTOR, num_warps=VECTOR_WARPS)
        triton_boxes.draw(volume, records)
    return volume, records


def gather(cloud: tuple[Tensor, ...], records: Records, gradient: Tensor, variance: float) -> list[Tensor]:
    """Gradients of the four arrays of `cloud`, from that of the volume, [C, Z, Y, X], float32 and contiguous."""
    out, (n, c) = [torch.empty_like(a) for a in cloud], cloud[3].shape
    if n:
        moments = triton_boxes.gather(gradient, records)
        grid = (triton.cdiv(n, VECTOR),)
        _pull_back[grid](*cloud, moments, *out, n, c, variance, VECTOR, num_warps=VECTOR_WARPS)
    return out


@triton.jit
def _cut(scales, quaternions, n, there, VARIANCE: tl.constexpr):
    # Factors of Σ' = Σ + variance: the slice at dz has its mean at (lx, ly) dz and the 2D covariance of `invert`.
    # Also Σ'xx, Σ'yy, Σ'zz, and the weight sqrt(det Σ / det Σ').
    xx, xy, xz, yy, yz, zz, root = load_covariance(scales, quaternions, n, there)
    xx, yy, zz = xx + VARIANCE, yy + VARIANCE, zz + VARIANCE
    lx, ly = xz / zz, yz / zz
    ix, iy, slope, inverse = invert(xx - xz * lx, xy - xz * ly, yy - yz * ly)
    return ix, iy, 1.0 / zz, slope, lx, ly, xx, yy, zz, root * tl.sqrt(inverse / zz)


@triton.jit
def _store_box(integers, n, there, drawn, k: tl.constexpr, first, count, middle):
    # First voxel, count, and the first one's offset from the mean's own, along one dimension.
    i = integers + n * INTEGERS + k
    tl.store(i, tl.where(drawn, first, 0.0).to(tl.int32), mask=there)
    tl.store(i + 3, tl.where(drawn, count, 0.0).to(tl.int32), mask=there)
    tl.store(i + 6, tl.where(drawn, first - middle, 0.0).to(tl.int32), mask=there)


@triton.jit
def _store_floats(floats, n, k: tl.constexpr, drawn, v0, v1, v2, v3):
    f = floats + n * FLOATS + k
    tl.store(f, v0.to(tl.float32), mask=drawn)
    tl.store(f + 1, v1.to(tl.float32), mask=drawn)
    tl.store(f + 2, v2.to(tl.float32), mask=drawn)
    tl.store(f + 3, v3.to(tl.float32), mask=drawn)


@triton.jit(do_not_specialize=["N", "Z", "Y", "X", "LARGE"])
def _prepare(
    centres, scales, quaternions, amplitudes, floats, integers, large, N, Z, Y, X, LARGE,
    C: tl.constexpr, CUTOFF: tl.constexpr, VARIANCE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    # Offsets of voxels from the mean are whole numbers (i, j, k) from the mean's own voxel less (fu, fv, fw). With
    # dz = k - fw, d = dy - ly dz and t = dx - lx dz - slope d, the value is peak · 2^-(ix t² + iy d² + iz dz²). Factors
    # are stored negated.
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = n < N
    ix, iy, iz, slope, lx, ly, xx, yy, zz, weight = _cut(scales, quaternions, n, there, VARIANCE)
    a0, a1 = load_amplitudes(amplitudes, n, there, C)
    x, y, z = load3(centres, n, there)
    width, height, depth = X.to(tl.float64), Y.to(tl.float64), Z.to(tl.float64)
    u, v, w = x + (width / 2 - 0.5), y + (height / 2 - 0.5), z + (depth / 2 - 0.5)
    x0, columns = box(u, CUTOFF * tl.sqrt(xx), width)
    y0, rows = box(v, CUTOFF * tl.sqrt(yy), height)
    z0, slices = box(w, CUTOFF * tl.sqrt(zz), depth)
    drawn = there & is_finite(u, v, w) & is_finite(weight, ix, slope) & is_finite(a0, a1, lx) & is_finite(ly, iy, iz)
    drawn = drawn & (columns > 0) & (rows > 0) & (slices > 0)
    iu, iv, iw = anchor(tl.where(drawn, u, 0.0)), anchor(tl.where(drawn, v, 0.0)), anchor(tl.where(drawn, w, 0.0))
    fu, fv, fw = u - iu, v - iv, w - iw
    lean, d0 = lx - slope * ly, fv - ly * fw  # t = i - slope j - lean k - t0, d = j - ly k - d0
    _store_floats(floats, n, 0, drawn, -ix * HALF_LOG2_E, -iy * HALF_LOG2_E, -iz * HALF_LOG2_E, -slope)
    _store_floats(floats, n, 4, drawn, -lean, -ly, fu - slope * fv - lean * fw, d0)
    _store_floats(floats, n, 8, drawn, fw, weight * a0, weight * a1, weight)
    _store_box(integers, n, there, drawn, 0, x0, columns, iu)
    _store_box(integers, n, there, drawn, 1, y0, rows, iv)
    _store_box(integers, n, there, drawn, 2, z0, slices, iw)
    is_large = drawn & (columns * rows * slices > LARGE)
    slot = tl.atomic_add(large + tl.zeros_like(n), 1, mask=is_large, sem="relaxed")
    tl.store(large + 1 + slot, n, mask=is_large)


@triton.jit
def _moment(moments, n, there, k: tl.constexpr, scale):
    return scale * tl.load(moments + n * MOMENTS + k, mask=there, other=0.0)


@triton.jit(do_not_specialize=["N"])
def _pull_back(
    centres, scales, quaternions, amplitudes, moments, d_centres, d_scales, d_quaternions, d_amplitudes,
    N, C: tl.constexpr, VARIANCE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    # With p = Σ'⁻¹ d: ∂L/∂centre = Σ p and ∂L/∂Σ' = ½ (Σ p pᵀ - S₀ Σ'⁻¹), where p_x = ix t, p_y = iy d - slope p_x
    # and p_z = iz dz - lx p_x - ly p_y.
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = n < N
    ix, iy, iz, slope, lx, ly, _, _, _, weight = _cut(scales, quaternions, n, there, VARIANCE)
    a0, a1 = load_amplitudes(amplitudes, n, there, C)
    d0 = _moment(moments, n, there, 0, weight)
    total, scale = a0 * d0, tl.full((BLOCK,), 1.0, tl.float64)
    store_amplitude(d_amplitudes + C * n, there, d0)
    if C == 1:  # the moments lack the peak
        scale = weight * a0
    else:
        d1 = _moment(moments, n, there, 1, weight)
        total += a1 * d1
        store_amplitude(d_amplitudes + C * n + 1, there, d1)
    t, d, z = (
        _moment(moments, n, there, 2, scale),
        _moment(moments, n, there, 3, scale),
        _moment(moments, n, there, 4, scale),
    )
    px = t * ix
    py = d * iy - slope * px
    store3(d_centres, n, there, px, py, z * iz - lx * px - ly * py)
    xx = _moment(moments, n, there, 5, scale) * ix * ix
    cross = _moment(moments, n, there, 6, scale) * ix * iy
    xy = cross - slope * xx
    yy = _moment(moments, n, there, 7, scale) * iy * iy - slope * (cross + xy)
    zx = _moment(moments, n, there, 8, scale) * ix * iz  # dz iz with p_x, p_y
    zy = _moment(moments, n, there, 9, scale) * iy * iz - slope * zx
    xz, yz = zx - lx * xx - ly * xy, zy - lx * xy - ly * yy
    zz = _moment(moments, n, there, 10, scale) * iz * iz - lx * (zx + xz) - ly * (zy + yz)
    # Σ'⁻¹ from the same factors
    jxy, jyy = -ix * slope, iy + ix * slope * slope
    jxz, jyz = -(lx * ix + ly * jxy), -(lx * jxy + ly * jyy)
    jzz = iz - lx * jxz - ly * jyz
    xx, xy, xz = 0.5 * (xx - total * ix), 0.5 * (xy - total * jxy), 0.5 * (xz - total * jxz)
    yy, yz, zz = 0.5 * (yy - total * jyy), 0.5 * (yz - total * jyz), 0.5 * (zz - total * jzz)
    _store_chain(scales, quaternions, d_scales, d_quaternions, n, there, xx, xy, xz, yy, yz, zz, total)
