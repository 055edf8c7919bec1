"""Boxes of voxels, drawn and read: the kernels of `triton_voxels.py` that walk over them, in float32.

As `triton_pixels.py`, in 3D. A Gaussian's numbers and integers are what `triton_voxels._prepare` stores.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import math

import triton
import triton.language as tl
from torch import Tensor

from .triton_cloud import FAINT, Blocks, Records

FLOATS, INTEGERS, MOMENTS = (tl.constexpr(n) for n in (12, 9, 12))
"""Numbers and integers of a Gaussian, and places for its moments."""

BLOCKS = Blocks(rounds=2, large=32768)
WIDE_FROM = 2**31
"""Voxels of a volume from which places in it are counted in 64 bits."""

SIZES = ["N", "Z", "Y", "X", "LARGE"]


def draw(volume: Tensor, records: Records) -> None:
    """Add the Gaussians of the records to the volume [C, Z, Y, X], by atomic additions in any order."""
    b, (grid, sizes) = BLOCKS, _launch(volume, len(records[0]))
    _draw[grid](volume, *records[:2], *sizes, b.gaussians, b.lanes, b.rounds, num_warps=b.gaussians)
    _draw_large[(b.large_programs,)](volume, *records, *sizes, b.large_lanes, b.large_programs, num_warps=8)


def gather(gradient: Tensor, records: Records) -> Tensor:
    """Moments [N, 12] of a volume's gradient [C, Z, Y, X] under every Gaussian, as `_gather_boxes` lists them."""
    b, (grid, sizes) = BLOCKS, _launch(gradient, len(records[0]))
    moments = gradient.new_zeros(len(records[0]), MOMENTS.value)
    _gather[grid](gradient, *records[:2], moments, *sizes, b.gaussians, b.lanes, b.rounds, num_warps=b.gaussians)
    large = (b.large_lanes, b.large_programs)
    _gather_large[(b.large_programs,)](gradient, *records, moments, *sizes, *large, num_warps=8)
    return moments


def _launch(volume: Tensor, n: int) -> tuple[tuple[int], tuple[int, ...]]:
    """The grid for the small boxes of n Gaussians, and the kernels' sizes."""
    (c, *shape), b = volume.shape, BLOCKS
    return (triton.cdiv(n, b.gaussians * b.rounds),), (n, *shape, b.large, c, math.prod(shape) >= WIDE_FROM)  # type: ignore[return-value]


# --- the walk over the voxels of boxes ----------------------------------------------------------------------


@triton.jit
def _load_counts(integers, n, wanted, LARGE, SMALL: tl.constexpr, WIDE: tl.constexpr):
    # Columns, rows and slices of boxes; none if not wanted, or if SMALL and the box is large.
    i = integers + n * INTEGERS
    columns, rows = tl.load(i + 3, mask=wanted, other=0), tl.load(i + 4, mask=wanted, other=0)
    slices = tl.load(i + 5, mask=wanted, other=0)
    if SMALL:
        small = _size(columns, rows, slices, WIDE) <= LARGE
        columns, rows, slices = tl.where(small, columns, 0), tl.where(small, rows, 0), tl.where(small, slices, 0)
    return columns, rows, slices


@triton.jit
def _size(columns, rows, slices, WIDE: tl.constexpr):
    # WIDE: voxels of a raster need 64 bits to count
    if WIDE:
        size = columns.to(tl.int64) * rows * slices
    else:
        size = columns * rows * slices
    return size


@triton.jit
def _split(count, columns, rows):
    # `count` voxels along a box: so many columns, rows and slices. Whole numbers in float32, as conversions are slow
    # on GPUs; the halves keep quotients clear of rounding.
    q = tl.floor((count + 0.5) / columns)
    slices = tl.floor((q + 0.5) / rows)
    return count - q * columns, q - slices * rows, slices


@triton.jit
def _place(right, down, back, Y, X, WIDE: tl.constexpr):
    if WIDE:
        slices = back.to(tl.int64)
    else:
        slices = back.to(tl.int32)
    return (slices * Y + down.to(tl.int32)) * X + right.to(tl.int32)


@triton.jit
def _start(integers, n, wanted, wide, high, Y, X, LANES: tl.constexpr, WIDE: tl.constexpr):
    # Where lane l begins, the l-th voxel of its box: its offset from the mean's own voxel, and place in the volume.
    i = integers + n * INTEGERS
    x0, y0 = tl.load(i, mask=wanted, other=0), tl.load(i + 1, mask=wanted, other=0)
    z0, left = tl.load(i + 2, mask=wanted, other=0), tl.load(i + 6, mask=wanted, other=0)
    above, before = tl.load(i + 7, mask=wanted, other=0), tl.load(i + 8, mask=wanted, other=0)
    right, down, back = _split(tl.arange(0, LANES)[None, :].to(tl.float32), wide, high)
    place = _place(x0 + right, y0 + down, z0 + back, Y, X, WIDE)
    left, above, before = left.to(tl.float32), above.to(tl.float32), before.to(tl.float32)
    return left + right, above + down, before + back, place, left + wide, above + high, before


@triton.jit
def _advance(i, j, k, place, end_i, end_j, wide, high, right, down, back, step, next_row, next_slice):
    i += right
    over = i >= end_i
    i = tl.where(over, i - wide, i)
    place += tl.where(over, step + next_row, step)
    j += tl.where(over, down + 1, down)
    over = j >= end_j
    j = tl.where(over, j - high, j)
    place += tl.where(over, next_slice, 0)
    return i, j, k + tl.where(over, back + 1, back), place


@triton.jit
def _load_shape(floats, n, wanted):
    # A Gaussian's numbers, in the order of `_prepare`.
    f = floats + n * FLOATS
    ix, iy = tl.load(f, mask=wanted, other=0.0), tl.load(f + 1, mask=wanted, other=0.0)
    iz, slope = tl.load(f + 2, mask=wanted, other=0.0), tl.load(f + 3, mask=wanted, other=0.0)
    lean, ly = tl.load(f + 4, mask=wanted, other=0.0), tl.load(f + 5, mask=wanted, other=0.0)
    t0, d0 = tl.load(f + 6, mask=wanted, other=0.0), tl.load(f + 7, mask=wanted, other=0.0)
    fw, p0 = tl.load(f + 8, mask=wanted, other=0.0), tl.load(f + 9, mask=wanted, other=0.0)
    return ix, iy, iz, slope, lean, ly, t0, d0, fw, p0, tl.load(f + 10, mask=wanted, other=0.0)


@triton.jit
def _exponent(i, j, k, ix, iy, iz, slope, lean, ly, t0, d0, fw):
    # t, d, dz and the exponent of 2 at the voxels (i, j, k); the factors are negated ones
    t = tl.fma(lean, k, tl.fma(slope, j, i)) - t0
    d = tl.fma(ly, k, j) - d0
    dz = k - fw
    return t, d, dz, tl.fma(iz * dz, dz, tl.fma(iy * d, d, ix * t * t))


# --- volumes from records -----------------------------------------------------------------------------------


@triton.jit
def _draw_boxes(
    volume, floats, integers, n, wanted, Z, Y, X, LARGE,
    SMALL: tl.constexpr, C: tl.constexpr, WIDE: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    # Adds the Gaussians n [G, 1] to their boxes, LANES voxels of each at a time.
    columns, rows, slices = _load_counts(integers, n, wanted, LARGE, SMALL, WIDE)
    most = tl.max(_size(columns, rows, slices, WIDE))
    if most > 0:
        there = columns > 0
        ix, iy, iz, slope, lean, ly, t0, d0, fw, p0, p1 = _load_shape(floats, n, there)
        channel = _size(X, Y, Z, True)
        next_row, next_slice = X - columns, _size(X, Y - rows, 1, WIDE)
        wide, high = tl.maximum(columns, 1).to(tl.float32), tl.maximum(rows, 1).to(tl.float32)
        i, j, k, place, end_i, end_j, before = _start(integers, n, there, wide, high, Y, X, LANES, WIDE)
        end_k = before + slices.to(tl.float32)
        right, down, back = _split(LANES, wide, high)
        step = _place(right, down, back, Y, X, WIDE)
        for _ in range(0, most, LANES):
            e = _exponent(i, j, k, ix, iy, iz, slope, lean, ly, t0, d0, fw)[3]
            value, seen = tl.exp2(e), (k < end_k) & (e > FAINT)
            tl.atomic_add(volume + place, p0 * value, mask=seen, sem="relaxed")
            if C == 2:
                tl.atomic_add(volume + channel + place, p1 * value, mask=seen, sem="relaxed")
            i, j, k, place = _advance(
                i, j, k, place, end_i, end_j, wide, high, right, down, back, step, next_row, next_slice
            )


@triton.jit(do_not_specialize=SIZES)
def _draw(
    volume, floats, integers, N, Z, Y, X, LARGE, C: tl.constexpr, WIDE: tl.constexpr,
    GAUSSIANS: tl.constexpr, LANES: tl.constexpr, ROUNDS: tl.constexpr,
):  # fmt: skip
    first = tl.program_id(0).to(tl.int64) * (GAUSSIANS * ROUNDS)
    for k in range(ROUNDS):
        n = first + k * GAUSSIANS + tl.arange(0, GAUSSIANS)[:, None]
        _draw_boxes(volume, floats, integers, n, n < N, Z, Y, X, LARGE, True, C, WIDE, LANES)


@triton.jit(do_not_specialize=SIZES)
def _draw_large(
    volume, floats, integers, large, N, Z, Y, X, LARGE, C: tl.constexpr, WIDE: tl.constexpr,
    LANES: tl.constexpr, PROGRAMS: tl.constexpr,
):  # fmt: skip
    for k in range(tl.program_id(0), tl.load(large).to(tl.int32), PROGRAMS):
        n = tl.load(large + 1 + k + tl.zeros((1, 1), tl.int64))
        _draw_boxes(volume, floats, integers, n, n < N, Z, Y, X, LARGE, False, C, WIDE, LANES)


# --- gradients ----------------------------------------------------------------------------------------------


@triton.jit
def _store_sum(moments, n, k: tl.constexpr, values, wanted):
    tl.store(moments + n * MOMENTS + k, tl.sum(values, axis=1)[:, None], mask=wanted)


@triton.jit
def _gather_boxes(
    gradient, floats, integers, moments, n, wanted, Z, Y, X, LARGE,
    SMALL: tl.constexpr, C: tl.constexpr, WIDE: tl.constexpr, GAUSSIANS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    # The moments of Gaussians n [G, 1]: sums over the box of value · gradient for each channel, and of all channels
    # (weighted with the peaks if there are two) times t, d, dz, and their products. They are zero before.
    columns, rows, slices = _load_counts(integers, n, wanted, LARGE, SMALL, WIDE)
    most = tl.max(_size(columns, rows, slices, WIDE))
    if most > 0:
        there = columns > 0
        ix, iy, iz, slope, lean, ly, t0, d0, fw, p0, p1 = _load_shape(floats, n, there)
        channel = _size(X, Y, Z, True)
        next_row, next_slice = X - columns, _size(X, Y - rows, 1, WIDE)
        wide, high = tl.maximum(columns, 1).to(tl.float32), tl.maximum(rows, 1).to(tl.float32)
        i, j, k, place, end_i, end_j, before = _start(integers, n, there, wide, high, Y, X, LANES, WIDE)
        end_k = before + slices.to(tl.float32)
        right, down, back = _split(LANES, wide, high)
        step = _place(right, down, back, Y, X, WIDE)
        s0 = tl.zeros((GAUSSIANS, LANES), tl.float32)
        s1, st, sd, sz, stt, std, sdd, stz, sdz, szz = s0, s0, s0, s0, s0, s0, s0, s0, s0, s0
        for _ in range(0, most, LANES):
            t, d, dz, e = _exponent(i, j, k, ix, iy, iz, slope, lean, ly, t0, d0, fw)
            seen = (k < end_k) & (e > FAINT)
            value = tl.exp2(e)
            given = value * tl.load(gradient + place, mask=seen, other=0.0)
            s0 += given
            if C == 2:
                other = value * tl.load(gradient + channel + place, mask=seen, other=0.0)
                s1 += other
                given = p0 * given + p1 * other
            gt, gd, gz = given * t, given * d, given * dz
            st += gt
            sd += gd
            sz += gz
            stt += gt * t
            std += gt * d
            sdd += gd * d
            stz += gz * t
            sdz += gz * d
            szz += gz * dz
            i, j, k, place = _advance(
                i, j, k, place, end_i, end_j, wide, high, right, down, back, step, next_row, next_slice
            )
        _store_sum(moments, n, 0, s0, there)
        if C == 2:
            _store_sum(moments, n, 1, s1, there)
        _store_sum(moments, n, 2, st, there)
        _store_sum(moments, n, 3, sd, there)
        _store_sum(moments, n, 4, sz, there)
        _store_sum(moments, n, 5, stt, there)
        _store_sum(moments, n, 6, std, there)
        _store_sum(moments, n, 7, sdd, there)
        _store_sum(moments, n, 8, stz, there)
        _store_sum(moments, n, 9, sdz, there)
        _store_sum(moments, n, 10, szz, there)


@triton.jit(do_not_specialize=SIZES)
def _gather(
    gradient, floats, integers, moments, N, Z, Y, X, LARGE, C: tl.constexpr, WIDE: tl.constexpr,
    GAUSSIANS: tl.constexpr, LANES: tl.constexpr, ROUNDS: tl.constexpr,
):  # fmt: skip
    first = tl.program_id(0).to(tl.int64) * (GAUSSIANS * ROUNDS)
    for k in range(ROUNDS):
        n = first + k * GAUSSIANS + tl.arange(0, GAUSSIANS)[:, None]
        _gather_boxes(
            gradient, floats, integers, moments, n, n < N, Z, Y, X, LARGE, True, C, WIDE, GAUSSIANS, LANES
        )  # fmt: skip


@triton.jit(do_not_specialize=SIZES)
def _gather_large(
    gradient, floats, integers, large, moments, N, Z, Y, X, LARGE,
    C: tl.constexpr, WIDE: tl.constexpr, LANES: tl.constexpr, PROGRAMS: tl.constexpr,
):  # fmt: skip
    for k in range(tl.program_id(0), tl.load(large).to(tl.int32), PROGRAMS):
        n = tl.load(large + 1 + k + tl.zeros((1, 1), tl.int64))
        _gather_boxes(gradient, floats, integers, moments, n, n < N, Z, Y, X, LARGE, False, C, WIDE, 1, LANES)
