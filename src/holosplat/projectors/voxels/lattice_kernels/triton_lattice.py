"""The kernels of the lattice on the GPU, as `native/lattice.cpp`: a lane for each voxel.

1. `_project`: every voxel of a block adds its hat to one view's image, by atomic additions in any order.
2. `_backproject`: every voxel of a block gathers what its hats see in all views, without atomics.
3. `_poses`: what a view's image gradient says of its pose, summed over the voxels of a program.

Columns and rows are computed in float64, all else in float32; sums over many voxels in float64.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..triton_places import BLOCK, WARPS, places
from . import KINK as NEAR
from . import SLACK as BEYOND

TILE = tl.constexpr(16)
"""Voxels along x and z of the tiles of `_project`; a block has as many as a tile."""
POSE_PROGRAMS, POSE_WARPS = 512, 4
"""Programs of a view that sum over all voxels, at most, and their warps."""
SLACK, KINK = tl.constexpr(BEYOND), tl.constexpr(NEAR)
INTEGER_ARGUMENTS = ["Z", "Y", "X", "H", "W"]


def project(axes: Tensor, volume: Tensor, raster: tuple[int, int]) -> Tensor:
    """Images [V, H, W] of a volume [Z, Y, X], float32 and contiguous.

    axes: [V, 2, 4] float64, of columns and of rows: start, and steps along z, y and x.
    """
    images = volume.new_zeros(len(axes), *raster)
    if min(raster) > 1:  # else no voxel has all of its hat's pixels
        z, y, x = volume.shape
        tiles = triton.cdiv(z, TILE.value) * y * triton.cdiv(x, TILE.value)  # at least as many as blocks
        _project[(tiles, len(axes))](axes, volume, images, z, y, x, *raster, num_warps=WARPS)
    return images


def backproject(axes: Tensor, images: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """The adjoint: a volume [Z, Y, X] of images [V, H, W]."""
    volume, raster = images.new_zeros(shape), images.shape[1:]
    if min(raster) > 1:
        grid = (triton.cdiv(volume.numel(), BLOCK),)
        _backproject[grid](axes, images, volume, len(axes), *shape, *raster, BLOCK, num_warps=WARPS)
    return volume


def pose_sums(axes: Tensor, volume: Tensor, upstream: Tensor) -> Tensor:
    """Sums [V, 2, 4] float64 of derivatives by a voxel's column and row: as they are, and times its x, y and z index.

    upstream: the gradient [V, H, W] of the images of `volume`.
    """
    blocks, raster = triton.cdiv(volume.numel(), BLOCK), upstream.shape[1:]
    programs = min(blocks, POSE_PROGRAMS)
    sums = torch.zeros(len(axes), programs, 2, 4, dtype=torch.float64, device=volume.device)
    if min(raster) > 1:
        sizes, rounds = (*volume.shape, *raster), math.ceil(blocks / programs)
        _poses[(programs, len(axes))](axes, volume, upstream, sums, *sizes, rounds, BLOCK, num_warps=POSE_WARPS)
    return sums.sum(1)


@triton.jit
def _along(axis, z, y, x):
    # Column or row [px], float64.
    start = tl.load(axis) + z.to(tl.float64) * tl.load(axis + 1) + y.to(tl.float64) * tl.load(axis + 2)
    return start + x.to(tl.float64) * tl.load(axis + 3)


@triton.jit
def _on_raster(column, row, H, W):
    # Whether all four pixels of a hat lie on the raster, give or take a millionth of a pixel.
    right, bottom = W.to(tl.float64) - 1 + SLACK, H.to(tl.float64) - 1 + SLACK
    return (column >= -SLACK) & (column <= right) & (row >= -SLACK) & (row <= bottom)


@triton.jit
def _cell(column, row, kept, H, W):
    # The first pixel of each hat, and in float32 how far (0 to 1) the voxel lies to the right of it and below it.
    column, row = tl.where(kept, column, 0.0), tl.where(kept, row, 0.0)
    j, i = tl.minimum(column.to(tl.int32), W - 2), tl.minimum(row.to(tl.int32), H - 2)
    a, b = (column - j.to(tl.float64)).to(tl.float32), (row - i.to(tl.float64)).to(tl.float32)
    return i.to(tl.int64) * W + j, a, b


@triton.jit
def _load_four(image, at, W, kept):
    # Upper left, upper right, lower left and lower right pixels of cells.
    left, right = tl.load(image + at, mask=kept, other=0.0), tl.load(image + at + 1, mask=kept, other=0.0)
    at += W
    return left, right, tl.load(image + at, mask=kept, other=0.0), tl.load(image + at + 1, mask=kept, other=0.0)


@triton.jit(do_not_specialize=INTEGER_ARGUMENTS)
def _project(axes, volume, images, Z, Y, X, H, W):
    # Where neighbours along x, one a lane, would all add to one column, lanes are neighbours along z instead.
    v = tl.program_id(1).to(tl.int64)
    if 8 * tl.abs(tl.load(axes + 8 * v + 3)) < tl.abs(tl.load(axes + 8 * v + 1)):
        across, lane = tl.cdiv(X, TILE), tl.arange(0, TILE * TILE)
        tile = tl.program_id(0) // across
        x = tl.program_id(0) % across * TILE + lane // TILE
        y, z = (tile + tl.zeros_like(lane)) % Y, (tile // Y * TILE + lane % TILE).to(tl.int64)
        at = (z * Y + y) * X + x
    else:
        at, z, y, x = places(tl.program_id(0), Y, X, TILE * TILE)
    value = tl.load(volume + at, mask=(z < Z) & (x < X), other=0.0)
    column, row = _along(axes + 8 * v, z, y, x), _along(axes + 8 * v + 4, z, y, x)
    kept = (value != 0.0) & _on_raster(column, row, H, W)
    cell, a, b = _cell(column, row, kept, H, W)
    to = images + v * H * W + cell
    lower = value * b
    upper = value - lower
    tl.atomic_add(to, upper * (1 - a), mask=kept, sem="relaxed")
    tl.atomic_add(to + 1, upper * a, mask=kept, sem="relaxed")
    tl.atomic_add(to + W, lower * (1 - a), mask=kept, sem="relaxed")
    tl.atomic_add(to + W + 1, lower * a, mask=kept, sem="relaxed")


@triton.jit(do_not_specialize=["V", *INTEGER_ARGUMENTS])
def _backproject(axes, images, volume, V, Z, Y, X, H, W, BLOCK: tl.constexpr):
    at, z, y, x = places(tl.program_id(0), Y, X, BLOCK)
    there = z < Z
    sum = tl.zeros((BLOCK,), tl.float32)
    pixels = H.to(tl.int64) * W
    for _ in range(V):
        column, row = _along(axes, z, y, x), _along(axes + 4, z, y, x)
        kept = there & _on_raster(column, row, H, W)
        cell, a, b = _cell(column, row, kept, H, W)
        upper_left, upper_right, lower_left, lower_right = _load_four(images, cell, W, kept)
        upper, lower = (1 - a) * upper_left + a * upper_right, (1 - a) * lower_left + a * lower_right
        sum += (1 - b) * upper + b * lower
        axes += 8
        images += pixels
    tl.store(volume + at, sum, mask=there)


@triton.jit
def _slope(image, column, row, kept, H, W, side):
    # Derivatives by column and row, float64, of the bilinear function on the cell of pixels that `side` (pixels) leads
    # to, where `kept`; else zero.
    j = tl.minimum(tl.maximum(tl.floor(column + side), 0.0), W.to(tl.float64) - 2)
    i = tl.minimum(tl.maximum(tl.floor(row + side), 0.0), H.to(tl.float64) - 2)
    a, b = column - j, row - i
    upper_left, upper_right, lower_left, lower_right = _load_four(image, i.to(tl.int64) * W + j.to(tl.int64), W, kept)
    upper, lower = upper_right.to(tl.float64) - upper_left, lower_right.to(tl.float64) - lower_left
    left, right = lower_left.to(tl.float64) - upper_left, lower_right.to(tl.float64) - upper_right
    return (1 - b) * upper + b * lower, (1 - a) * left + a * right


@triton.jit
def _store_sums(sums, of_all, by_x, by_y, by_z):
    tl.store(sums, tl.sum(of_all))
    tl.store(sums + 1, tl.sum(by_x))
    tl.store(sums + 2, tl.sum(by_y))
    tl.store(sums + 3, tl.sum(by_z))


@triton.jit(do_not_specialize=[*INTEGER_ARGUMENTS, "ROUNDS"])
def _poses(axes, volume, upstream, sums, Z, Y, X, H, W, ROUNDS, BLOCK: tl.constexpr):
    # A program takes every `num_programs`-th block of voxels.
    v = tl.program_id(1).to(tl.int64)
    axes += 8 * v
    image = upstream + v * H * W
    c = tl.zeros((BLOCK,), tl.float64)
    cx, cy, cz = c, c, c
    r, rx, ry, rz = c, c, c, c
    for k in range(ROUNDS):
        at, z, y, x = places(tl.program_id(0) + k * tl.num_programs(0), Y, X, BLOCK)
        value = tl.load(volume + at, mask=z < Z, other=0.0)
        column, row = _along(axes, z, y, x), _along(axes + 4, z, y, x)
        kept = (value != 0.0) & _on_raster(column, row, H, W)
        column, row = tl.where(kept, column, 0.0), tl.where(kept, row, 0.0)
        by_column, by_row = _slope(image, column, row, kept, H, W, KINK)
        more_by_column, more_by_row = _slope(image, column, row, kept, H, W, -KINK)
        half = 0.5 * value.to(tl.float64)
        by_column, by_row = half * (by_column + more_by_column), half * (by_row + more_by_row)
        x, y, z = x.to(tl.float64), y.to(tl.float64), z.to(tl.float64)
        c, cx, cy, cz = c + by_column, cx + by_column * x, cy + by_column * y, cz + by_column * z
        r, rx, ry, rz = r + by_row, rx + by_row * x, ry + by_row * y, rz + by_row * z
    sums += 8 * (v * tl.num_programs(0) + tl.program_id(0))
    _store_sums(sums, c, cx, cy, cz)
    _store_sums(sums + 4, r, rx, ry, rz)


def project_rays(rays: Tensor, volume: Tensor) -> Tensor:
    """Images [N] of slices [K, A, B] along rays [5, N] (`reference.Stack`), float32 and contiguous."""
    images = rays.new_empty(rays.shape[1])
    grid = (triton.cdiv(len(images), BLOCK),)
    _project_rays[grid](rays, volume, images, len(images), *volume.shape, BLOCK, num_warps=WARPS)
    return images


def backproject_rays(rays: Tensor, images: Tensor, volume: Tensor) -> None:
    """The adjoint, which is added to `volume` by atomic additions in any order."""
    grid = (triton.cdiv(len(images), BLOCK), len(volume))
    _backproject_rays[grid](rays, images, volume, len(images), *volume.shape, BLOCK, num_warps=WARPS)


def ray_gradients(rays: Tensor, volume: Tensor, upstream: Tensor) -> Tensor:
    """Gradients [5, N] of the rays; upstream [N]: of the images."""
    found = torch.empty_like(rays)
    grid = (triton.cdiv(len(upstream), BLOCK),)
    _ray_gradients[grid](rays, volume, upstream, found, len(upstream), *volume.shape, BLOCK, num_warps=WARPS)
    return found


@triton.jit
def _ray(rays, n, N):
    there = n < N
    row, row_step = tl.load(rays + n, mask=there, other=0.0), tl.load(rays + N + n, mask=there, other=0.0)
    column, step = tl.load(rays + 2 * N + n, mask=there, other=0.0), tl.load(rays + 3 * N + n, mask=there, other=0.0)
    return row, row_step, column, step, tl.load(rays + 4 * N + n, mask=there, other=0.0)


@triton.jit
def _meet(row, row_step, column, step, depth, A, B):
    # The first of the four voxels around a ray's place in a slice, and how far (0 to 1) the place is from it.
    y = tl.minimum(tl.maximum(row + depth * row_step, 0.0), A.to(tl.float32) - 1)
    x = tl.minimum(tl.maximum(column + depth * step, 0.0), B.to(tl.float32) - 1)
    i, j = tl.minimum(y.to(tl.int32), A - 2), tl.minimum(x.to(tl.int32), B - 2)
    return i * B + j, y - i.to(tl.float32), x - j.to(tl.float32)


@triton.jit(do_not_specialize=["N", "K", "A", "B"])
def _project_rays(rays, volume, images, N, K, A, B, BLOCK: tl.constexpr):
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    row, row_step, column, step, length = _ray(rays, n, N)
    sum = tl.zeros((BLOCK,), tl.float32)
    depth = -0.5 * (K.to(tl.float32) - 1)
    for _ in range(K):
        at, b, a = _meet(row, row_step, column, step, depth, A, B)
        upper_left, upper_right, lower_left, lower_right = _load_four(volume, at, B, n < N)
        upper, lower = upper_left + a * (upper_right - upper_left), lower_left + a * (lower_right - lower_left)
        sum += upper + b * (lower - upper)
        volume += A.to(tl.int64) * B
        depth += 1.0
    tl.store(images + n, sum * length, mask=n < N)


@triton.jit(do_not_specialize=["N", "K", "A", "B"])
def _backproject_rays(rays, images, volume, N, K, A, B, BLOCK: tl.constexpr):
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    row, row_step, column, step, length = _ray(rays, n, N)
    k = tl.program_id(1)
    at, b, a = _meet(row, row_step, column, step, k.to(tl.float32) - 0.5 * (K.to(tl.float32) - 1), A, B)
    value = length * tl.load(images + n, mask=n < N, other=0.0)
    lower = value * b
    upper = value - lower
    to = volume + k.to(tl.int64) * A * B + at
    kept = (n < N) & (value != 0.0)
    tl.atomic_add(to, upper * (1 - a), mask=kept, sem="relaxed")
    tl.atomic_add(to + 1, upper * a, mask=kept, sem="relaxed")
    tl.atomic_add(to + B, lower * (1 - a), mask=kept, sem="relaxed")
    tl.atomic_add(to + B + 1, lower * a, mask=kept, sem="relaxed")


@triton.jit(do_not_specialize=["N", "K", "A", "B"])
def _ray_gradients(rays, volume, upstream, found, N, K, A, B, BLOCK: tl.constexpr):
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    row, row_step, column, step, length = _ray(rays, n, N)
    sum = tl.zeros((BLOCK,), tl.float32)
    down, down_deep, right, right_deep = sum, sum, sum, sum
    depth = -0.5 * (K.to(tl.float32) - 1)
    bottom, end = A.to(tl.float32) - 1, B.to(tl.float32) - 1
    for _ in range(K):
        at, b, a = _meet(row, row_step, column, step, depth, A, B)
        upper_left, upper_right, lower_left, lower_right = _load_four(volume, at, B, n < N)
        upper, lower = upper_left + a * (upper_right - upper_left), lower_left + a * (lower_right - lower_left)
        sum += upper + b * (lower - upper)
        y, x = row + depth * row_step, column + depth * step
        free = (y > 0) & (y < bottom) & (x > 0) & (x < end)
        by_row = tl.where(free, lower - upper, 0.0)
        by_column = tl.where(free, (1 - b) * (upper_right - upper_left) + b * (lower_right - lower_left), 0.0)
        down, down_deep = down + by_row, down_deep + depth * by_row
        right, right_deep = right + by_column, right_deep + depth * by_column
        volume += A.to(tl.int64) * B
        depth += 1.0
    given = tl.load(upstream + n, mask=n < N, other=0.0)
    weighted = given * length
    tl.store(found + n, weighted * down, mask=n < N)
    tl.store(found + N + n, weighted * down_deep, mask=n < N)
    tl.store(found + 2 * N + n, weighted * right, mask=n < N)
    tl.store(found + 3 * N + n, weighted * right_deep, mask=n < N)
    tl.store(found + 4 * N + n, given * sum, mask=n < N)
