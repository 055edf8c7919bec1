"""The kernels of closed surfaces on the GPU, as `native/surface.cpp`: one lane for each face, all in float64.

1. `_draw`: every face adds its lines to the images, by atomic additions in any order.
2. `_shares`: every face gathers what its corners get of the images' gradients, over all views, without atomics.
3. `_poses`: the same summed over the faces of a block, for the gradients of one view's pose.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

DRAWN, DRAWN_WARPS = 32, 1
"""Faces of a program that draws: few, for it goes on until the last of them is done."""
GATHERED, GATHERED_WARPS = 128, 4
"""Faces of a program that gathers what corners get."""
POSED, POSED_WARPS = 64, 1
"""Faces of a program that sums for poses."""
SUMS = tl.constexpr(12)
"""Numbers of a pose: by the rotation, row by row, and by a common motion in the lab frame."""


def draw(points: Tensor, faces: Tensor, shape: tuple[int, int], lines: int) -> Tensor:
    """Images [V, H, W] of points [V, P, 3] `(column, row, depth)` and faces [F, 3], all contiguous."""
    image = points.new_zeros(len(points), *shape)
    if image.numel() and len(faces):
        grid, sizes = _launch(points, faces, DRAWN), (points.shape[1], len(faces), *shape, lines)
        _draw[grid](points, faces, image, *sizes, DRAWN, num_warps=DRAWN_WARPS)
    return image


def shares(points: Tensor, faces: Tensor, gradient: Tensor, weights: Tensor) -> Tensor:
    """What each corner of each face gets [F, 3] of images' gradients [V, H, W], of weights [V]; all contiguous."""
    out = points.new_zeros(len(faces), 3)
    if gradient.numel() and len(faces):
        grid, sizes = _launch(points, faces, GATHERED)[:1], (*points.shape[:2], len(faces), *gradient.shape[1:])
        _shares[grid](points, faces, gradient, weights, out, *sizes, GATHERED, num_warps=GATHERED_WARPS)
    return out


def pose_sums(points: Tensor, vertices: Tensor, faces: Tensor, gradient: Tensor) -> Tensor:
    """Sums [V, 12] over all faces, as `SUMS`; vertices [P, 3]: the points in the object frame; all contiguous."""
    blocks, views = _launch(points, faces, POSED)
    out = points.new_zeros(views, blocks, SUMS.value)
    if gradient.numel() and len(faces):
        sizes = (points.shape[1], len(faces), *gradient.shape[1:])
        _poses[(blocks, views)](points, vertices, faces, gradient, out, *sizes, POSED, num_warps=POSED_WARPS)
    return out.sum(1)


def _launch(points: Tensor, faces: Tensor, block: int) -> tuple[int, int]:
    """Blocks of faces, and views."""
    return -(-len(faces) // block), len(points)


@triton.jit
def _load3(array, row, there):
    """Rows of a float64 array [·, 3], as three vectors."""
    x, y = tl.load(array + 3 * row, mask=there, other=0.0), tl.load(array + 3 * row + 1, mask=there, other=0.0)
    return x, y, tl.load(array + 3 * row + 2, mask=there, other=0.0)


@triton.jit
def _load_corners(faces, f, there):
    """Which vertices the faces `f` have."""
    a, b = tl.load(faces + 3 * f, mask=there, other=0), tl.load(faces + 3 * f + 1, mask=there, other=0)
    return a, b, tl.load(faces + 3 * f + 2, mask=there, other=0)


# --- images -------------------------------------------------------------------------------------------------


@triton.jit
def _in_order(c0, r0, d0, c1, r1, d1, turned):
    # Two corners (column, row, depth), the one of the smaller row first; `turned` changes where they were not so.
    swap = r1 < r0
    low = tl.where(swap, c1, c0), tl.where(swap, r1, r0), tl.where(swap, d1, d0)
    return low, (tl.where(swap, c0, c1), tl.where(swap, r0, r1), tl.where(swap, d0, d1)), turned ^ swap


@triton.jit
def _first_line(row, lines, most):
    # Line s lies at row (s + 1/2) / lines - 1/2: the first one at a corner or above it, below `most` in all.
    row = tl.where(most > 0, row, 0.0)  # rows of what is not drawn may be no numbers
    return tl.minimum(tl.maximum(tl.ceil((row + 0.5) * lines - 0.5), 0.0), most).to(tl.int32)


@triton.jit
def _slopes(low, high):
    # Columns and depths per row of an edge; of a level edge, which no line meets, any number.
    height = high[1] - low[1]
    per_row = 1.0 / tl.where(height > 0, height, 1.0)
    return (high[0] - low[0]) * per_row, (high[2] - low[2]) * per_row


@triton.jit
def _add_segment(image, left, start, right, stop, weight, wanted, W):
    # Adds the integrals of the depth, which is `start` at the column `left` and `stop` at `right`, over the pixels
    # [·] of image rows that begin at `image`, times `weight`.
    width = W.to(tl.float64)
    begin, end = tl.maximum(left, -0.5), tl.minimum(right, width - 0.5)
    wanted = wanted & (right > left) & (begin < end)
    pixel = tl.where(wanted, begin + 0.5, 0.0).to(tl.int32)  # begin + 0.5 is not negative
    count = tl.where(wanted, tl.ceil(end + 0.5), 0.0).to(tl.int32) - pixel
    inverse = 1.0 / tl.where(wanted, right - left, 1.0)
    for _ in range(0, tl.max(count)):
        middle = pixel.to(tl.float64)
        a, b = tl.maximum(begin, middle - 0.5), tl.minimum(end, middle + 0.5)
        depth = start + (stop - start) * ((0.5 * (a + b) - left) * inverse)
        tl.atomic_add(image + pixel, weight * (b - a) * depth, mask=wanted & (b > a) & (pixel < W), sem="relaxed")
        pixel += 1


@triton.jit(do_not_specialize=["P", "F", "H", "W", "LINES"])
def _draw(points, faces, images, P, F, H, W, LINES, BLOCK: tl.constexpr):
    f = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there, view = f < F, tl.program_id(1).to(tl.int64)
    points += 3 * P * view
    image = images + view * H * W
    i, j, k = _load_corners(faces, f, there)
    a, b, c = _load3(points, i, there), _load3(points, j, there), _load3(points, k, there)
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    drawn = there & (tl.abs(area) > 0) & (tl.abs(area) < float("inf"))
    # `rightwards`: whether the middle corner is to the right of the edge from low to high
    low, middle, rightwards = _in_order(a[0], a[1], a[2], b[0], b[1], b[2], area > 0)
    middle, high, rightwards = _in_order(middle[0], middle[1], middle[2], c[0], c[1], c[2], rightwards)
    low, middle, rightwards = _in_order(low[0], low[1], low[2], middle[0], middle[1], middle[2], rightwards)
    lines, rows = LINES.to(tl.float64), tl.where(drawn, H, 0).to(tl.float64)
    first, last = _first_line(low[1], lines, rows * lines), _first_line(high[1], lines, rows * lines)
    turn = _first_line(middle[1], lines, rows * lines)
    weight, apart = tl.where(area > 0, 1.0, -1.0) / lines, 1.0 / lines
    columns, depths = _slopes(low, high)
    below_columns, below_depths = _slopes(low, middle)
    above_columns, above_depths = _slopes(middle, high)
    for n in range(0, tl.max(last - first)):
        line = first + n
        row = (line.to(tl.float64) + 0.5) * apart - 0.5
        up, on, below = row - low[1], row - middle[1], line < turn
        column, depth = low[0] + up * columns, low[2] + up * depths  # on the edge from low to high
        other = tl.where(below, low[0] + up * below_columns, middle[0] + on * above_columns)  # on one of the others
        other_depth = tl.where(below, low[2] + up * below_depths, middle[2] + on * above_depths)
        left, right = tl.where(rightwards, column, other), tl.where(rightwards, other, column)
        start, stop = tl.where(rightwards, depth, other_depth), tl.where(rightwards, other_depth, depth)
        begins = image + (line // LINES).to(tl.int64) * W
        _add_segment(begins, left, start, right, stop, weight, line < last, W)


# --- gradients ----------------------------------------------------------------------------------------------


@triton.jit
def _pixel(image, i, j, inside, H, W):
    # Of pixels beyond the image, zero.
    mask = inside & (i >= 0) & (i < H) & (j >= 0) & (j < W)
    return tl.load(image + i.to(tl.int64) * W + j, mask=mask, other=0.0)


@triton.jit
def _interpolated(image, column, row, there, H, W):
    # The image at (column, row), linear between pixels and zero beyond them. A single row or column stands for all.
    column, row = tl.where(W == 1, 0.0, column), tl.where(H == 1, 0.0, row)
    inside = there & (column > -1) & (column < W) & (row > -1) & (row < H)
    column, row = tl.where(inside, column, 0.0), tl.where(inside, row, 0.0)
    left, above = tl.floor(column), tl.floor(row)
    a, b, i, j = column - left, row - above, above.to(tl.int32), left.to(tl.int32)
    upper = (1 - a) * _pixel(image, i, j, inside, H, W) + a * _pixel(image, i, j + 1, inside, H, W)
    lower = (1 - a) * _pixel(image, i + 1, j, inside, H, W) + a * _pixel(image, i + 1, j + 1, inside, H, W)
    return (1 - b) * upper + b * lower


@triton.jit
def _near(image, near, one, other, there, H, W):
    # The image at the point of the quadrature that is nearest to one of three corners, over six.
    column, row = (4 * near[0] + one[0] + other[0]) / 6, (4 * near[1] + one[1] + other[1]) / 6
    return _interpolated(image, column, row, there, H, W) / 6


@triton.jit
def _corner_values(image, a, b, c, there, H, W):
    # Σ_q image(q) λ_k(q) for the corners k, q the three points of equal weight.
    u, v = _near(image, a, b, c, there, H, W), _near(image, b, c, a, there, H, W)
    w = _near(image, c, a, b, there, H, W)
    every = u + v + w
    return every + 3 * u, every + 3 * v, every + 3 * w


@triton.jit(do_not_specialize=["V", "P", "F", "H", "W"])
def _shares(points, faces, gradients, weights, out, V, P, F, H, W, BLOCK: tl.constexpr):
    f = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = f < F
    i, j, k = _load_corners(faces, f, there)
    u = tl.zeros((BLOCK,), tl.float64)
    v, w = u, u
    for view in range(0, V):
        at, image = points + tl.cast(view, tl.int64) * 3 * P, gradients + tl.cast(view, tl.int64) * H * W
        a, b, c = _load3(at, i, there), _load3(at, j, there), _load3(at, k, there)
        one, two, three = _corner_values(image, a, b, c, there, H, W)
        weight = tl.load(weights + view)
        u += weight * one
        v += weight * two
        w += weight * three
    tl.store(out + 3 * f, u, mask=there)
    tl.store(out + 3 * f + 1, v, mask=there)
    tl.store(out + 3 * f + 2, w, mask=there)


@triton.jit(do_not_specialize=["P", "F", "H", "W"])
def _poses(points, vertices, faces, gradients, out, P, F, H, W, BLOCK: tl.constexpr):
    block, view = tl.program_id(0).to(tl.int64), tl.program_id(1).to(tl.int64)
    f = block * BLOCK + tl.arange(0, BLOCK)
    there = f < F
    points += 3 * P * view
    i, j, k = _load_corners(faces, f, there)
    a, b, c = _load3(points, i, there), _load3(points, j, there), _load3(points, k, there)
    u, v, w = _corner_values(gradients + view * H * W, a, b, c, there, H, W)
    u, v, w = u / 6, v / 6, w / 6
    ax, ay, az = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    bx, by, bz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    a, b, c = _load3(vertices, i, there), _load3(vertices, j, there), _load3(vertices, k, there)
    x, y, z = u * a[0] + v * b[0] + w * c[0], u * a[1] + v * b[1] + w * c[1], u * a[2] + v * b[2] + w * c[2]
    every, sums = u + v + w, out + (view * tl.num_programs(0) + block) * SUMS
    _store_row(sums, nx, x, y, z)
    _store_row(sums + 3, ny, x, y, z)
    _store_row(sums + 6, nz, x, y, z)
    _store_row(sums + 9, every, nx, ny, nz)


@triton.jit
def _store_row(sums, factor, x, y, z):
    tl.store(sums, tl.sum(factor * x))
    tl.store(sums + 1, tl.sum(factor * y))
    tl.store(sums + 2, tl.sum(factor * z))
