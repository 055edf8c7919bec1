"""Line integrals of a Gaussian cloud on the GPU, and their gradients; formulas as in native/splat.cpp.

1. `_project`: for every view and Gaussian, once, in float64: the integer box and a record of float32 numbers.
2. `triton_pixels.draw`: every record adds its Gaussian to its box of pixels.
3. `triton_pixels.gather`: sums (moments) of the image's gradient under every record, without atomics.
4. `_pull_back`: for every Gaussian, in float64, the views' moments in order become the gradients of its parameters;
   and, where poses require gradients, each program's sums for every view, which torch then adds up.

Launches depend on shapes alone: nothing waits for the device. Gradients are bitwise the same in every run, for equal
gradients of the image; images are so up to the order of additions.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from . import triton_pixels
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
from .triton_pixels import FLOATS, INTEGERS, MOMENTS

SQRT_TWO_PI = tl.constexpr(2.5066282746310002)
VIEW_SUMS = tl.constexpr(12)
"""Sums over Gaussians for a view: gradients of its rotation, of the mean (x, y) and of the curvature."""
Bent = tuple[Tensor, Tensor, Tensor | None]
SIZES = ["N", "V", "H", "W", "LARGE"]


def draw(
    cloud: tuple[Tensor, ...], poses: Bent, shape: tuple[int, ...], cutoff: float, variance: float
) -> tuple[Tensor, Records]:
    """The image [V, C, H, W], and the records (of view v and Gaussian n at v N + n) that `gather` wants back.

    cloud: centres, scales, quaternions, amplitudes, float32 and contiguous; poses: rotations [V, 3, 3],
    shifts [V, 2] and curvatures [V] or None, float64, contiguous, on the same device; lengths in pixels.
    """
    centres, (n, c), v = cloud[0], cloud[3].shape, len(poses[0])
    image = centres.new_zeros(v, c, *shape)
    records = (
        centres.new_empty(v * n, FLOATS.value),
        centres.new_empty(v * n, INTEGERS.value, dtype=torch.int32),
        centres.new_empty(1 + v * n, dtype=torch.int64),
    )
    if v * n:
        records[2][:1].zero_()
        grid, sizes = (triton.cdiv(n, VECTOR) * v,), (n, *shape, triton_pixels.BLOCKS.large, c, cutoff, variance)
        _project[grid](*cloud, *_bent(poses), *records, *sizes, poses[2] is not None, VECTOR, num_warps=VECTOR_WARPS)
        triton_pixels.draw(image, records, n)
    return image, records


def gather(
    cloud: tuple[Tensor, ...],
    poses: Bent,
    records: Records,
    gradient: Tensor,
    variance: float,
    of_poses: bool = False,
) -> tuple[list[Tensor], list[Tensor | None]]:
    """Gradients of the four arrays of `cloud`, from that of the image, [V, C, H, W], float32 and contiguous.

    Then those of the poses' three arrays in float64, None unless `of_poses`.
    """
    out, (n, c), v = [torch.empty_like(a) for a in cloud], cloud[3].shape, len(gradient)
    programs, cone = triton.cdiv(n, VECTOR), poses[2] is not None
    sums = poses[0].new_empty(programs, v, VIEW_SUMS.value) if of_poses else None
    if n:
        moments = triton_pixels.gather(gradient, records, n)
        outputs = (*out, moments if sums is None else sums)  # moments only stand in: nothing is stored there
        sizes = (n, v, c, variance, of_poses, cone)
        _pull_back[(programs,)](*cloud, *_bent(poses), moments, *outputs, *sizes, VECTOR, num_warps=VECTOR_WARPS)
    return out, [None, None, None] if sums is None else _of_poses(sums.sum(0), cone)


def _bent(poses: Bent) -> tuple[Tensor, Tensor, Tensor]:
    """The poses as kernels take them: shifts stand in for curvatures, which are not read in parallel beams."""
    return poses[0], poses[1], poses[1] if poses[2] is None else poses[2]


def _of_poses(sums: Tensor, cone: bool) -> list[Tensor | None]:
    """Gradients of rotations [V, 3, 3], shifts [V, 2] and curvatures [V] or None: a shift moves the mean back."""
    return [sums[:, :9].reshape(-1, 3, 3), -sums[:, 9:11], sums[:, 11].contiguous() if cone else None]


@triton.jit
def _form(p0, p1, p2, q0, q1, q2, xx, xy, xz, yy, yz, zz):
    # pᵀ Σ q
    return (
        p0 * q0 * xx
        + (p0 * q1 + p1 * q0) * xy
        + (p0 * q2 + p2 * q0) * xz
        + p1 * q1 * yy
        + (p1 * q2 + p2 * q1) * yz
        + p2 * q2 * zz
    )


@triton.jit
def _load_rows(rotations, v):
    # The first two rows of a view's rotation, as six numbers.
    p0, p1, p2 = tl.load(rotations + 9 * v), tl.load(rotations + 9 * v + 1), tl.load(rotations + 9 * v + 2)
    q0, q1, q2 = tl.load(rotations + 9 * v + 3), tl.load(rotations + 9 * v + 4), tl.load(rotations + 9 * v + 5)
    return p0, p1, p2, q0, q1, q2


@triton.jit
def _seen(rotations, curvatures, v, p0, p1, p2, q0, q1, q2, x, y, z):
    # Of a centre in a cone: its place (u, w), its magnification m and 1 / m, both 0 behind the source, the third row
    # of the view's rotation, and the rows of the affine map about the centre.
    r0, r1, r2 = tl.load(rotations + 9 * v + 6), tl.load(rotations + 9 * v + 7), tl.load(rotations + 9 * v + 8)
    bend = tl.load(curvatures + v)
    depth = 1.0 + bend * (r0 * x + r1 * y + r2 * z)
    depth = tl.where(depth > 0, depth, 0.0)
    m = tl.where(depth > 0, 1.0 / tl.where(depth > 0, depth, 1.0), 0.0)
    u, w = m * (p0 * x + p1 * y + p2 * z), m * (q0 * x + q1 * y + q2 * z)
    a0, a1, a2 = m * (p0 - bend * u * r0), m * (p1 - bend * u * r1), m * (p2 - bend * u * r2)
    b0, b1, b2 = m * (q0 - bend * w * r0), m * (q1 - bend * w * r1), m * (q2 - bend * w * r2)
    return u, w, m, depth, bend, r0, r1, r2, a0, a1, a2, b0, b1, b2


@triton.jit
def _store_floats(floats, r, wanted, v0, v1, v2, v3, v4, v5, v6, v7):
    f = floats + r * FLOATS
    tl.store(f, v0.to(tl.float32), mask=wanted)
    tl.store(f + 1, v1.to(tl.float32), mask=wanted)
    tl.store(f + 2, v2.to(tl.float32), mask=wanted)
    tl.store(f + 3, v3.to(tl.float32), mask=wanted)
    tl.store(f + 4, v4.to(tl.float32), mask=wanted)
    tl.store(f + 5, v5.to(tl.float32), mask=wanted)
    tl.store(f + 6, v6.to(tl.float32), mask=wanted)
    tl.store(f + 7, v7.to(tl.float32), mask=wanted)


@triton.jit(do_not_specialize=SIZES)
def _project(
    centres, scales, quaternions, amplitudes, rotations, shifts, curvatures, floats, integers, large,
    N, H, W, LARGE,
    C: tl.constexpr, CUTOFF: tl.constexpr, VARIANCE: tl.constexpr, CONE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    # A program has one view and BLOCK Gaussians. Record r = v N + n; offsets (dx, dy) of its box's pixels from the
    # mean are whole numbers (i, j) from the mean's own pixel less (fu, fv). With t = dx - slope dy = i - slope j - ft,
    # the value is peak · 2^-(across t² + down dy²). The slope comes in two parts: t is a small difference of numbers
    # as large as the box. Factors are stored negated, which saves the pixels' loop doing so.
    groups = tl.cdiv(N, BLOCK)
    v = (tl.program_id(0) // groups).to(tl.int64)
    n = (tl.program_id(0) % groups).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = n < N
    xx, xy, xz, yy, yz, zz, root = load_covariance(scales, quaternions, n, there)
    p0, p1, p2, q0, q1, q2 = _load_rows(rotations, v)
    x, y, z = load3(centres, n, there)
    if CONE:
        u, w, m, _, _, _, _, _, p0, p1, p2, q0, q1, q2 = _seen(
            rotations, curvatures, v, p0, p1, p2, q0, q1, q2, x, y, z
        )
        root *= m * m
    else:
        u, w = p0 * x + p1 * y + p2 * z, q0 * x + q1 * y + q2 * z
    sxx = _form(p0, p1, p2, p0, p1, p2, xx, xy, xz, yy, yz, zz) + VARIANCE
    sxy = _form(p0, p1, p2, q0, q1, q2, xx, xy, xz, yy, yz, zz)
    syy = _form(q0, q1, q2, q0, q1, q2, xx, xy, xz, yy, yz, zz) + VARIANCE
    across, down, slope, inverse = invert(sxx, sxy, syy)
    weight = root * SQRT_TWO_PI * tl.sqrt(inverse)
    a0, a1 = load_amplitudes(amplitudes, n, there, C)
    width, height = W.to(tl.float64), H.to(tl.float64)
    u = u + (width / 2 - 0.5) - tl.load(shifts + 2 * v)
    w = w + (height / 2 - 0.5) - tl.load(shifts + 2 * v + 1)
    x0, columns = box(u, CUTOFF * tl.sqrt(sxx), width)
    y0, rows = box(w, CUTOFF * tl.sqrt(syy), height)
    drawn = there & is_finite(u, w, weight) & is_finite(across, slope, a0) & is_finite(a1, down, sxx)
    drawn = drawn & (columns > 0) & (rows > 0)
    iu, iw = anchor(tl.where(drawn, u, 0.0)), anchor(tl.where(drawn, w, 0.0))
    fw, steep = w - iw, slope.to(tl.float32).to(tl.float64)
    r = v * N + n
    _store_floats(
        floats, r, drawn, -across * HALF_LOG2_E, -down * HALF_LOG2_E, -steep, steep - slope,
        (u - iu) - slope * fw, fw, weight * a0, weight * a1,
    )  # fmt: skip
    i = integers + r * INTEGERS
    columns, rows = tl.where(drawn, columns, 0.0), tl.where(drawn, rows, 0.0)
    tl.store(i + tl.zeros_like(n), v.to(tl.int32), mask=there)
    tl.store(i + 1, tl.where(drawn, x0, 0.0).to(tl.int32), mask=there)
    tl.store(i + 2, tl.where(drawn, y0, 0.0).to(tl.int32), mask=there)
    tl.store(i + 3, columns.to(tl.int32), mask=there)
    tl.store(i + 4, rows.to(tl.int32), mask=there)
    tl.store(i + 5, tl.where(drawn, x0 - iu, 0.0).to(tl.int32), mask=there)
    tl.store(i + 6, tl.where(drawn, y0 - iw, 0.0).to(tl.int32), mask=there)
    is_large = columns * rows > LARGE
    slot = tl.atomic_add(large + tl.zeros_like(n), 1, mask=is_large, sem="relaxed")
    tl.store(large + 1 + slot, r, mask=is_large)


@triton.jit
def _rows_gradient(hxx, hxy, hyy, p0, p1, p2, q0, q1, q2, xx, xy, xz, yy, yz, zz):
    # With A the rows p and q, Σ₂' = A Σ Aᵀ + variance: ∂L/∂A = 2 H A Σ, from H = ∂L/∂Σ₂'.
    sp0, sp1, sp2 = xx * p0 + xy * p1 + xz * p2, xy * p0 + yy * p1 + yz * p2, xz * p0 + yz * p1 + zz * p2
    sq0, sq1, sq2 = xx * q0 + xy * q1 + xz * q2, xy * q0 + yy * q1 + yz * q2, xz * q0 + yz * q1 + zz * q2
    hxx, hxy, hyy = 2 * hxx, 2 * hxy, 2 * hyy
    return (
        hxx * sp0 + hxy * sq0, hxx * sp1 + hxy * sq1, hxx * sp2 + hxy * sq2,
        hxy * sp0 + hyy * sq0, hxy * sp1 + hyy * sq1, hxy * sp2 + hyy * sq2,
    )  # fmt: skip


@triton.jit
def _store_view(
    to, centres, n, drawn, gx, gy, hxx, hxy, hyy,
    p0, p1, p2, q0, q1, q2, xx, xy, xz, yy, yz, zz,
):  # fmt: skip
    # In parallel beams, mean = A c - shift, with A the first two rows of R: ∂L/∂A = g cᵀ + 2 H A Σ, from g = ∂L/∂mean.
    # Stores its sums over the program's Gaussians, and those of g.
    x, y, z = load3(centres, n, drawn)
    drawn = drawn & is_finite(x, y, z)
    e0, e1, e2, f0, f1, f2 = _rows_gradient(hxx, hxy, hyy, p0, p1, p2, q0, q1, q2, xx, xy, xz, yy, yz, zz)
    _store_row(to, drawn, gx * x + e0, gx * y + e1, gx * z + e2)
    _store_row(to + 3, drawn, gy * x + f0, gy * y + f1, gy * z + f2)
    zero = tl.zeros_like(x)
    _store_row(to + 6, drawn, zero, zero, zero)
    _store_row(to + 9, drawn, gx, gy, zero)


@triton.jit
def _store_row(to, drawn, v0, v1, v2):
    _store_lanes(to, drawn, v0)
    _store_lanes(to + 1, drawn, v1)
    _store_lanes(to + 2, drawn, v2)


@triton.jit
def _store_lanes(at, wanted, values):
    tl.store(at, tl.sum(tl.where(wanted, values, 0.0), axis=0))


@triton.jit(do_not_specialize=SIZES)
def _pull_back(
    centres, scales, quaternions, amplitudes, rotations, shifts, curvatures, moments,
    d_centres, d_scales, d_quaternions, d_amplitudes, view_sums, N, V,
    C: tl.constexpr, VARIANCE: tl.constexpr, OF_VIEWS: tl.constexpr, CONE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    # From the views' moments to the gradients of mean and covariance in the image plane, and on to 3D. With
    # p = Σ₂'⁻¹ d: ∂L/∂mean = Σ p, ∂L/∂Σ₂' = ½ (Σ p pᵀ - S₀ Σ₂'⁻¹), sums over pixels weighted with what they gave.
    # view_sums [programs, V, 12]: a program's sums for every view, if OF_VIEWS.
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = n < N
    xx, xy, xz, yy, yz, zz, root = load_covariance(scales, quaternions, n, there)
    a0, a1 = load_amplitudes(amplitudes, n, there, C)
    zero = tl.zeros((BLOCK,), tl.float64)
    gx, gy, gz, gxx, gxy, gxz, gyy, gyz, gzz = zero, zero, zero, zero, zero, zero, zero, zero, zero
    log_root, d0, d1 = zero, zero, zero
    m = moments + n * MOMENTS
    if CONE:
        x, y, z = load3(centres, n, there)
    for v in range(V):
        p0, p1, p2, q0, q1, q2 = _load_rows(rotations, v)
        area = root
        if CONE:
            a_0, a_1, a_2, b_0, b_1, b_2 = p0, p1, p2, q0, q1, q2
            u, w, magnified, depth, bend, r0, r1, r2, p0, p1, p2, q0, q1, q2 = _seen(
                rotations, curvatures, v, p0, p1, p2, q0, q1, q2, x, y, z
            )
            area = root * magnified * magnified
        sxx = _form(p0, p1, p2, p0, p1, p2, xx, xy, xz, yy, yz, zz) + VARIANCE
        sxy = _form(p0, p1, p2, q0, q1, q2, xx, xy, xz, yy, yz, zz)
        syy = _form(q0, q1, q2, q0, q1, q2, xx, xy, xz, yy, yz, zz) + VARIANCE
        ix, iy, slope, inverse = invert(sxx, sxy, syy)
        weight = area * SQRT_TWO_PI * tl.sqrt(inverse)
        m0 = weight * tl.load(m, mask=there, other=0.0)
        d0 += m0
        total, scale = a0 * m0, tl.full((BLOCK,), 1.0, tl.float64)
        if C == 1:  # the moments lack the peak
            scale = weight * a0
        else:
            m1 = weight * tl.load(m + 1, mask=there, other=0.0)
            d1 += m1
            total += a1 * m1
        log_root += total
        t, d = scale * tl.load(m + 2, mask=there, other=0.0), scale * tl.load(m + 3, mask=there, other=0.0)
        tt, td = scale * tl.load(m + 4, mask=there, other=0.0), scale * tl.load(m + 5, mask=there, other=0.0)
        dd = scale * tl.load(m + 6, mask=there, other=0.0)
        m += N.to(tl.int64) * MOMENTS
        # p_x = across t, p_y = down d - slope p_x
        px = t * ix
        py = d * iy - slope * px
        pxx, cross = tt * ix * ix, td * ix * iy
        pxy = cross - slope * pxx
        hxx, hxy = 0.5 * (pxx - total * ix), 0.5 * (pxy + total * ix * slope)
        hyy = 0.5 * (dd * iy * iy - slope * (cross + pxy) - total * (iy + ix * slope * slope))
        gxx += hxx * (p0 * p0) + hxy * (2 * p0 * q0) + hyy * (q0 * q0)
        gxy += hxx * (p0 * p1) + hxy * (p0 * q1 + p1 * q0) + hyy * (q0 * q1)
        gxz += hxx * (p0 * p2) + hxy * (p0 * q2 + p2 * q0) + hyy * (q0 * q2)
        gyy += hxx * (p1 * p1) + hxy * (2 * p1 * q1) + hyy * (q1 * q1)
        gyz += hxx * (p1 * p2) + hxy * (p1 * q2 + p2 * q1) + hyy * (q1 * q2)
        gzz += hxx * (p2 * p2) + hxy * (2 * p2 * q2) + hyy * (q2 * q2)
        if CONE:
            e0, e1, e2, f0, f1, f2 = _rows_gradient(hxx, hxy, hyy, p0, p1, p2, q0, q1, q2, xx, xy, xz, yy, yz, zz)
            along_e, along_f = e0 * r0 + e1 * r1 + e2 * r2, f0 * r0 + f1 * r1 + f2 * r2
            gu, gw = px - bend * magnified * along_e, py - bend * magnified * along_f
            of_rows = e0 * p0 + e1 * p1 + e2 * p2 + f0 * q0 + f1 * q1 + f2 * q2
            of_scale = depth * (2 * total + of_rows + gu * u + gw * w)
            of_depth = -bend * magnified * magnified * of_scale
            mu, mw = magnified * gu, magnified * gw
            gx, gy = gx + mu * a_0 + mw * b_0 + of_depth * r0, gy + mu * a_1 + mw * b_1 + of_depth * r1
            gz += mu * a_2 + mw * b_2 + of_depth * r2
        else:
            gx, gy, gz = gx + px * p0 + py * q0, gy + px * p1 + py * q1, gz + px * p2 + py * q2
        if OF_VIEWS:
            drawn = there & is_finite(weight, slope, a0) & is_finite(ix, iy, a1) & is_finite(sxx, sxy, syy)
            to = view_sums + (tl.program_id(0).to(tl.int64) * V + v) * VIEW_SUMS
            if CONE:
                drawn = drawn & is_finite(x, y, z)
                _store_row(to, drawn, magnified * e0 + mu * x, magnified * e1 + mu * y, magnified * e2 + mu * z)
                _store_row(to + 3, drawn, magnified * f0 + mw * x, magnified * f1 + mw * y, magnified * f2 + mw * z)
                bu, bw = bend * magnified * u, bend * magnified * w
                t0, t1, t2 = bu * e0 + bw * f0, bu * e1 + bw * f1, bu * e2 + bw * f2
                _store_row(to + 6, drawn, of_depth * x - t0, of_depth * y - t1, of_depth * z - t2)
                far = r0 * x + r1 * y + r2 * z
                of_bend = -magnified * (along_e * u + along_f * w + far * magnified * of_scale)
                _store_row(to + 9, drawn, px, py, of_bend)
            else:
                _store_view(
                    to, centres, n, drawn, px, py, hxx, hxy, hyy,
                    p0, p1, p2, q0, q1, q2, xx, xy, xz, yy, yz, zz,
                )  # fmt: skip
    store3(d_centres, n, there, gx, gy, gz)
    store_amplitude(d_amplitudes + C * n, there, d0)
    if C == 2:
        store_amplitude(d_amplitudes + C * n + 1, there, d1)
    _store_chain(
        scales, quaternions, d_scales, d_quaternions, n, there, gxx, gxy, gxz, gyy, gyz, gzz, log_root
    )  # fmt: skip
