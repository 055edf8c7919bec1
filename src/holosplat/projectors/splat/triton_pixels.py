"""Boxes of pixels, drawn and read: the kernels of `triton_splat.py` that walk over them, in float32.

The lanes of a warp walk along the pixels of a box, row after row as one long list, so that few lanes idle however
small the box. Boxes too large for one warp stand on a list, which programs of many warps share. A record's numbers and
integers are what `triton_splat._project` stores.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from .triton_cloud import FAINT, Blocks, Records

FLOATS, INTEGERS, MOMENTS = (tl.constexpr(n) for n in (8, 7, 8))
"""Numbers and integers of a record, and places for its moments."""

BLOCKS = Blocks(lanes=32)
WIDE_FROM = 2**31
"""Pixels of an image from which places in it are counted in 64 bits."""

SIZES = ["R", "H", "W", "LARGE"]


def draw(image: Tensor, records: Records, n: int) -> None:
    """Add the records of every view's n Gaussians to the image [V, C, H, W], by atomic additions in any order."""
    b, (v, c, h, w) = BLOCKS, image.shape
    grid, sizes = (triton.cdiv(v * n, b.gaussians * b.rounds),), (v * n, h, w, b.large, c, h * w >= WIDE_FROM)
    _draw[grid](image, *records[:2], *sizes, b.gaussians, b.lanes, b.rounds, num_warps=b.gaussians)
    _draw_large[(b.large_programs,)](image, *records, *sizes, b.large_lanes, b.large_programs, num_warps=8)


def gather(gradient: Tensor, records: Records, n: int) -> Tensor:
    """Moments [V·N, 8] of an image's gradient [V, C, H, W] under every record, as `_gather_boxes` lists them."""
    b, (v, c, h, w) = BLOCKS, gradient.shape
    moments = gradient.new_zeros(v * n, MOMENTS.value)
    if v * n == 0:
        return moments
    grid, sizes = (triton.cdiv(v * n, b.gaussians * b.rounds),), (v * n, h, w, b.large, c, h * w >= WIDE_FROM)
    _gather[grid](gradient, *records[:2], moments, *sizes, b.gaussians, b.lanes, b.rounds, num_warps=b.gaussians)
    large = (b.large_lanes, b.large_programs)
    _gather_large[(b.large_programs,)](gradient, *records, moments, *sizes, *large, num_warps=8)
    return moments


# --- the walk over the pixels of boxes ----------------------------------------------------------------------


@triton.jit
def _load_box(integers, r, wanted, LARGE, SMALL: tl.constexpr, WIDE: tl.constexpr):
    # Of records [G, 1], their view; first pixel; columns and rows (none if not wanted, or if SMALL and the box is
    # large); the first pixel's offset (i, j) from the mean's own; and which records that leaves.
    i = integers + r * INTEGERS
    view = tl.load(i, mask=wanted, other=0)
    x0, y0 = tl.load(i + 1, mask=wanted, other=0), tl.load(i + 2, mask=wanted, other=0)
    columns, rows = tl.load(i + 3, mask=wanted, other=0), tl.load(i + 4, mask=wanted, other=0)
    if SMALL:
        wanted = wanted & (_area(columns, rows, WIDE) <= LARGE)
        columns, rows = tl.where(wanted, columns, 0), tl.where(wanted, rows, 0)
    left, above = tl.load(i + 5, mask=wanted, other=0), tl.load(i + 6, mask=wanted, other=0)
    return view, x0, y0, columns, rows, left, above


@triton.jit
def _area(columns, rows, WIDE: tl.constexpr):
    # WIDE: pixels of a raster need 64 bits to count
    if WIDE:
        area = columns.to(tl.int64) * rows
    else:
        area = columns * rows
    return area


@triton.jit
def _start(x0, y0, columns, left, above, W, LANES: tl.constexpr, WIDE: tl.constexpr):
    # Where lane l begins, the l-th pixel of its box: offset (i, j) from the mean's pixel, and place in the plane.
    # Then what LANES pixels more are: so many columns and rows, and what that adds to the place; and what it adds
    # to wrap once from a row's end. Whole numbers in float32, as conversions are slow on GPUs; the half keeps
    # quotients clear of the rounding of `inverse`.
    across = tl.maximum(columns, 1).to(tl.float32)
    inverse = 1.0 / across
    lane = tl.arange(0, LANES)[None, :].to(tl.float32)
    row = tl.floor((lane + 0.5) * inverse)
    column = lane - row * across
    down = tl.floor((LANES + 0.5) * inverse)
    right = LANES - down * across
    if WIDE:
        place = (y0 + row.to(tl.int32)).to(tl.int64) * W + (x0 + column.to(tl.int32))
        step, wrap = down.to(tl.int64) * W + right.to(tl.int32), W.to(tl.int64) - columns
    else:
        place = (y0 + row.to(tl.int32)) * W + (x0 + column.to(tl.int32))
        step, wrap = down.to(tl.int32) * W + right.to(tl.int32), W - columns
    return left.to(tl.float32) + column, above.to(tl.float32) + row, place, right, down, step, wrap


@triton.jit
def _advance(i, j, place, end, across, right, down, step, wrap):
    i += right
    over = i >= end
    return tl.where(over, i - across, i), j + tl.where(over, down + 1, down), place + tl.where(over, step + wrap, step)


@triton.jit
def _load_shape(floats, r, wanted):
    # A record's numbers, in the order of `_project`.
    f = floats + r * FLOATS
    across, down = tl.load(f, mask=wanted, other=0.0), tl.load(f + 1, mask=wanted, other=0.0)
    slope, more = tl.load(f + 2, mask=wanted, other=0.0), tl.load(f + 3, mask=wanted, other=0.0)
    ft, fv = tl.load(f + 4, mask=wanted, other=0.0), tl.load(f + 5, mask=wanted, other=0.0)
    p0, p1 = tl.load(f + 6, mask=wanted, other=0.0), tl.load(f + 7, mask=wanted, other=0.0)
    return across, down, slope, more, ft, fv, p0, p1


@triton.jit
def _exponent(i, j, across, down, slope, more, ft, fv):
    # t, dy and the exponent of 2 at the pixels (i, j); the factors are negated ones
    t = tl.fma(more, j, tl.fma(slope, j, i)) - ft
    d = j - fv
    return t, d, tl.fma(down * d, d, across * t * t)


# --- images from records ------------------------------------------------------------------------------------


@triton.jit
def _draw_boxes(
    image, floats, integers, r, wanted, H, W, LARGE,
    SMALL: tl.constexpr, C: tl.constexpr, WIDE: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    # Adds the records r [G, 1] to their boxes, LANES pixels of each at a time.
    view, x0, y0, columns, rows, left, above = _load_box(integers, r, wanted, LARGE, SMALL, WIDE)
    most = tl.max(_area(columns, rows, WIDE))
    if most > 0:
        across, down, slope, more, ft, fv, p0, p1 = _load_shape(floats, r, columns > 0)
        plane = H.to(tl.int64) * W
        first = image + view.to(tl.int64) * C * plane
        i, j, place, right, lower, step, wrap = _start(x0, y0, columns, left, above, W, LANES, WIDE)
        end, bottom, length = (left + columns).to(tl.float32), (above + rows).to(tl.float32), columns.to(tl.float32)
        for _ in range(0, most, LANES):
            e = _exponent(i, j, across, down, slope, more, ft, fv)[2]
            value, seen = tl.exp2(e), (j < bottom) & (e > FAINT)
            tl.atomic_add(first + place, p0 * value, mask=seen, sem="relaxed")
            if C == 2:
                tl.atomic_add(first + plane + place, p1 * value, mask=seen, sem="relaxed")
            i, j, place = _advance(i, j, place, end, length, right, lower, step, wrap)


@triton.jit(do_not_specialize=SIZES)
def _draw(
    image, floats, integers, R, H, W, LARGE, C: tl.constexpr, WIDE: tl.constexpr,
    GAUSSIANS: tl.constexpr, LANES: tl.constexpr, ROUNDS: tl.constexpr,
):  # fmt: skip
    first = tl.program_id(0).to(tl.int64) * (GAUSSIANS * ROUNDS)
    for k in range(ROUNDS):
        r = first + k * GAUSSIANS + tl.arange(0, GAUSSIANS)[:, None]
        _draw_boxes(image, floats, integers, r, r < R, H, W, LARGE, True, C, WIDE, LANES)


@triton.jit(do_not_specialize=SIZES)
def _draw_large(
    image, floats, integers, large, R, H, W, LARGE, C: tl.constexpr, WIDE: tl.constexpr,
    LANES: tl.constexpr, PROGRAMS: tl.constexpr,
):  # fmt: skip
    for k in range(tl.program_id(0), tl.load(large).to(tl.int32), PROGRAMS):
        r = tl.load(large + 1 + k + tl.zeros((1, 1), tl.int64))
        _draw_boxes(image, floats, integers, r, r < R, H, W, LARGE, False, C, WIDE, LANES)


# --- gradients ----------------------------------------------------------------------------------------------


@triton.jit
def _store_sum(moments, r, k: tl.constexpr, values, wanted):
    tl.store(moments + r * MOMENTS + k, tl.sum(values, axis=1)[:, None], mask=wanted)


@triton.jit
def _gather_boxes(
    gradient, floats, integers, moments, r, wanted, H, W, LARGE,
    SMALL: tl.constexpr, C: tl.constexpr, WIDE: tl.constexpr, GAUSSIANS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    # The moments of records r [G, 1]: sums over the box of value · gradient for each channel, and of all channels
    # (weighted with the peaks if there are two) times t, dy, t², t dy, dy². They are zero before.
    view, x0, y0, columns, rows, left, above = _load_box(integers, r, wanted, LARGE, SMALL, WIDE)
    most = tl.max(_area(columns, rows, WIDE))
    if most > 0:
        there = columns > 0
        across, down, slope, more, ft, fv, p0, p1 = _load_shape(floats, r, there)
        plane = H.to(tl.int64) * W
        first = gradient + view.to(tl.int64) * C * plane
        i, j, place, right, lower, step, wrap = _start(x0, y0, columns, left, above, W, LANES, WIDE)
        end, bottom, length = (left + columns).to(tl.float32), (above + rows).to(tl.float32), columns.to(tl.float32)
        s0 = tl.zeros((GAUSSIANS, LANES), tl.float32)
        s1, st, sd, stt, std, sdd = s0, s0, s0, s0, s0, s0
        for _ in range(0, most, LANES):
            t, d, e = _exponent(i, j, across, down, slope, more, ft, fv)
            seen = (j < bottom) & (e > FAINT)
            value = tl.exp2(e)
            given = value * tl.load(first + place, mask=seen, other=0.0)
            s0 += given
            if C == 2:
                other = value * tl.load(first + plane + place, mask=seen, other=0.0)
                s1 += other
                given = p0 * given + p1 * other
            st += given * t
            stt += given * t * t
            std += given * t * d
            sd += given * d
            sdd += given * d * d
            i, j, place = _advance(i, j, place, end, length, right, lower, step, wrap)
        _store_sum(moments, r, 0, s0, there)
        if C == 2:
            _store_sum(moments, r, 1, s1, there)
        _store_sum(moments, r, 2, st, there)
        _store_sum(moments, r, 3, sd, there)
        _store_sum(moments, r, 4, stt, there)
        _store_sum(moments, r, 5, std, there)
        _store_sum(moments, r, 6, sdd, there)


@triton.jit(do_not_specialize=SIZES)
def _gather(
    gradient, floats, integers, moments, R, H, W, LARGE, C: tl.constexpr, WIDE: tl.constexpr,
    GAUSSIANS: tl.constexpr, LANES: tl.constexpr, ROUNDS: tl.constexpr,
):  # fmt: skip
    first = tl.program_id(0).to(tl.int64) * (GAUSSIANS * ROUNDS)
    for k in range(ROUNDS):
        r = first + k * GAUSSIANS + tl.arange(0, GAUSSIANS)[:, None]
        _gather_boxes(
            gradient, floats, integers, moments, r, r < R, H, W, LARGE, True, C, WIDE, GAUSSIANS, LANES
        )  # fmt: skip


@triton.jit(do_not_specialize=SIZES)
def _gather_large(
    gradient, floats, integers, large, moments, R, H, W, LARGE, C: tl.constexpr, WIDE: tl.constexpr,
    LANES: tl.constexpr, PROGRAMS: tl.constexpr,
):  # fmt: skip
    for k in range(tl.program_id(0), tl.load(large).to(tl.int32), PROGRAMS):
        r = tl.load(large + 1 + k + tl.zeros((1, 1), tl.int64))
        _gather_boxes(gradient, floats, integers, moments, r, r < R, H, W, LARGE, False, C, WIDE, 1, LANES)
