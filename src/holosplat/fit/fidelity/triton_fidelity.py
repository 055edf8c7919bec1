"""The Triton kernels of `cuda.py`: the window is separable, so each pass filters along one side.

Forward: `_filter_down` (moments of the difference, filtered along y, and sums of |d|), `_compare` (filtered along x;
sums of 1 - SSIM and its derivatives), `_finish`. Backward, with the transposed filters: `_spread` along x, then
`_gather` along y. A program has a tile of one view; neighbours' pixels come from the cache.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

ROWS, COLUMNS, WARPS = 16, 64, 8
"""A program's tile, and its warps."""

C1, C2 = tl.constexpr(0.01**2), tl.constexpr(0.03**2)
INTEGER_ARGUMENTS = ["H", "W"]

Windows = tuple[tuple[float, ...], tuple[float, ...]]
"""Weights along y and along x."""


def compare(
    arrays: tuple[Tensor, ...], windows: Windows, low: float, span: float, wants_gradient: bool
) -> tuple[Tensor, Tensor]:
    """L1 and 1 - SSIM of each view, [2, V], and the latter's derivatives [V, 3, h, w] (empty unless wanted).

    arrays: predicted [V, H, W], frames [V, H, W] and their statistics [V, 2, h, w], float32 and contiguous.
    """
    predicted, frames, statistics = arrays
    (v, height, width), (wy, wx) = frames.shape, windows
    h, w = statistics.shape[2:]
    tiles = triton.cdiv(height, ROWS) * triton.cdiv(width, COLUMNS)
    filtered = frames.new_empty(v, 3, h, width)
    slopes = frames.new_empty((v, 3, h, w) if wants_gradient else (0,))
    sums, values = frames.new_empty(2, v, tiles), frames.new_empty(2, v)
    if v == 0:
        return values, slopes
    mapping, tile = (1 / span, -low / span - 0.5), (ROWS, COLUMNS)
    grid = (tiles * v,)
    _filter_down[grid](predicted, frames, filtered, sums[0], height, width, *mapping, wy, len(wy), *tile,
                       num_warps=WARPS)  # fmt: skip
    _compare[grid](filtered, statistics, slopes, sums[1], height, width, wx, len(wy), len(wx), wants_gradient, *tile,
                   num_warps=WARPS)  # fmt: skip
    _finish[(2 * v,)](sums, values, v, tiles, 1 / (height * width), 1 / (h * w), 1024, num_warps=4)
    return values, slopes


def differentiate(saved: tuple[Tensor, ...], upstream: Tensor, windows: Windows, low: float, span: float) -> Tensor:
    """The gradient of predicted frames [V, H, W], from those of L1 and of 1 - SSIM, upstream [2, V].

    saved: predicted, frames, and the derivatives that `compare` gave.
    """
    predicted, frames, slopes = saved
    (v, height, width), (wy, wx) = frames.shape, windows
    spread = frames.new_empty(v, 3, slopes.shape[2], width)
    out = torch.empty_like(predicted)
    if v == 0:
        return out
    grid, tile = (triton.cdiv(height, ROWS) * triton.cdiv(width, COLUMNS) * v,), (ROWS, COLUMNS)
    _spread[grid](slopes, spread, height, width, wx, len(wy), len(wx), *tile, num_warps=WARPS)
    windows_count = (height - len(wy) + 1) * (width - len(wx) + 1)
    shares = (1 / (height * width * span), 1 / (windows_count * span))
    _gather[grid](predicted, frames, spread, upstream, out, v, height, width, 1 / span, -low / span - 0.5, *shares,
                  wy, len(wy), *tile, num_warps=WARPS)  # fmt: skip
    return out


@triton.jit
def _tile(H, W, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    # The view, rows [ROWS, 1] and columns [1, COLUMNS] of this program's tile of H × W pixels.
    across = tl.cdiv(W, COLUMNS)
    tiles = across * tl.cdiv(H, ROWS)
    tile = tl.program_id(0) % tiles
    y = tile // across * ROWS + tl.arange(0, ROWS)[:, None]
    x = tile % across * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    return (tl.program_id(0) // tiles).to(tl.int64), y, x


@triton.jit
def _store_three(first, plane, at, inside, mean, square, cross):
    # To three maps, one `plane` of numbers after the other.
    tl.store(first + at, mean, mask=inside)
    tl.store(first + plane + at, square, mask=inside)
    tl.store(first + 2 * plane + at, cross, mask=inside)


@triton.jit(do_not_specialize=INTEGER_ARGUMENTS)
def _filter_down(
    predicted, frames, filtered, sums, H, W, inverse, offset,
    WEIGHTS: tl.constexpr, TAPS: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    # filtered [V, 3, h, W] <- E_y of d, d², d (b - ½); sums [V, tiles] <- Σ |d|
    v, y, x = _tile(H, W, ROWS, COLUMNS)
    h = H - TAPS + 1
    predicted += v * H * W
    frames += v * H * W
    at = y * W + x  # 32 bits are enough within a view, and save registers
    mean = tl.zeros((ROWS, COLUMNS), tl.float32)
    square, cross = mean, mean
    for k in tl.static_range(TAPS):
        there = (y + k < H) & (x < W)
        b = tl.load(frames + at + k * W, mask=there, other=0.0)
        d = (tl.load(predicted + at + k * W, mask=there, other=0.0) - b) * inverse
        if k == 0:
            tl.store(sums + tl.program_id(0), tl.sum(tl.sum(tl.abs(d), axis=1), axis=0))
        weighted = WEIGHTS[k] * d
        mean += weighted
        square += weighted * d
        cross += weighted * (b * inverse + offset)
    _store_three(filtered + v * 3 * h * W, h.to(tl.int64) * W, at, (y < h) & (x < W), mean, square, cross)


@triton.jit
def _dissimilarity(mean, variance, m, square, cross):
    # 1 - SSIM, and its derivatives with respect to m = E d, square = E d² and cross = E d (b - ½), where the
    # measured frame has the local mean and variance given.
    centred, mean_a = mean - 0.5, mean + m
    s = tl.maximum(square - m * m, 0.0)
    means = 1.0 / (mean_a * mean_a + mean * mean + C1)
    variances = 1.0 / (tl.maximum(2 * (variance + cross - m * centred) + s, 0.0) + C2)
    p, q = m * m * means, s * variances
    by_mean = 2 * (1 - q) * means * (m - p * mean_a) + 2 * (1 - p) * variances * (q * (centred + m) - m)
    return p + q - p * q, by_mean, (1 - p) * (1 - q) * variances, -2 * (1 - p) * q * variances


@triton.jit(do_not_specialize=INTEGER_ARGUMENTS)
def _compare(
    filtered, statistics, slopes, sums, H, W, WEIGHTS: tl.constexpr, DOWN: tl.constexpr, TAPS: tl.constexpr,
    GRADIENT: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    # sums [V, tiles] <- Σ (1 - SSIM); slopes [V, 3, h, w] <- its derivatives with respect to the moments
    v, y, x = _tile(H, W, ROWS, COLUMNS)
    h, w = H - DOWN + 1, W - TAPS + 1
    mean = tl.zeros((ROWS, COLUMNS), tl.float32)
    square, cross = mean, mean
    source, plane, at = filtered + v * 3 * h * W, h.to(tl.int64) * W, y * W + x
    for k in tl.static_range(TAPS):
        there = (y < h) & (x + k < W)
        mean += WEIGHTS[k] * tl.load(source + (at + k), mask=there, other=0.0)
        square += WEIGHTS[k] * tl.load(source + plane + (at + k), mask=there, other=0.0)
        cross += WEIGHTS[k] * tl.load(source + 2 * plane + (at + k), mask=there, other=0.0)
    inside, at = (y < h) & (x < w), y * w + x
    local = statistics + v * 2 * h * w
    mean_b = tl.load(local + at, mask=inside, other=0.0)
    variance = tl.load(local + h.to(tl.int64) * w + at, mask=inside, other=0.0)
    value, by_mean, by_square, by_cross = _dissimilarity(mean_b, variance, mean, square, cross)
    tl.store(sums + tl.program_id(0), tl.sum(tl.sum(tl.where(inside, value, 0.0), axis=1), axis=0))
    if GRADIENT:
        _store_three(slopes + v * 3 * h * w, h.to(tl.int64) * w, at, inside, by_mean, by_square, by_cross)


@triton.jit(do_not_specialize=["V", "TILES"])
def _finish(sums, values, V, TILES, pixel_share, window_share, BLOCK: tl.constexpr):
    # values [2, V] <- means, from sums [2, V, tiles]
    row = tl.program_id(0)
    total = tl.zeros((BLOCK,), tl.float64)
    for start in range(0, TILES, BLOCK):
        at = start + tl.arange(0, BLOCK)
        total += tl.load(sums + row.to(tl.int64) * TILES + at, mask=at < TILES, other=0.0)
    share = tl.where(row < V, pixel_share, window_share)
    tl.store(values + row, (tl.sum(total, axis=0) * share).to(tl.float32))


@triton.jit(do_not_specialize=INTEGER_ARGUMENTS)
def _spread(
    slopes, spread, H, W, WEIGHTS: tl.constexpr, DOWN: tl.constexpr, TAPS: tl.constexpr,
    ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    # spread [V, 3, h, W] <- slopes [V, 3, h, w], each given to the pixels along x that it came from
    v, y, x = _tile(H, W, ROWS, COLUMNS)
    h, w = H - DOWN + 1, W - TAPS + 1
    mean = tl.zeros((ROWS, COLUMNS), tl.float32)
    square, cross = mean, mean
    source, plane, at = slopes + v * 3 * h * w, h.to(tl.int64) * w, y * w + x
    for k in tl.static_range(TAPS):
        there = (y < h) & (x >= k) & (x < w + k)
        mean += WEIGHTS[k] * tl.load(source + (at - k), mask=there, other=0.0)
        square += WEIGHTS[k] * tl.load(source + plane + (at - k), mask=there, other=0.0)
        cross += WEIGHTS[k] * tl.load(source + 2 * plane + (at - k), mask=there, other=0.0)
    _store_three(spread + v * 3 * h * W, h.to(tl.int64) * W, y * W + x, (y < h) & (x < W), mean, square, cross)


@triton.jit(do_not_specialize=["V", *INTEGER_ARGUMENTS])
def _gather(
    predicted, frames, spread, upstream, out, V, H, W, inverse, offset, pixel_share, window_share,
    WEIGHTS: tl.constexpr, TAPS: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    # out [V, H, W] <- upstream [0, v] sign(d) · share of a pixel + upstream [1, v] · derivative of 1 - SSIM
    v, y, x = _tile(H, W, ROWS, COLUMNS)
    h = H - TAPS + 1
    mean = tl.zeros((ROWS, COLUMNS), tl.float32)
    square, cross = mean, mean
    source, plane, at = spread + v * 3 * h * W, h.to(tl.int64) * W, y * W + x
    for k in tl.static_range(TAPS):
        there = (y >= k) & (y < h + k) & (x < W)
        mean += WEIGHTS[k] * tl.load(source + (at - k * W), mask=there, other=0.0)
        square += WEIGHTS[k] * tl.load(source + plane + (at - k * W), mask=there, other=0.0)
        cross += WEIGHTS[k] * tl.load(source + 2 * plane + (at - k * W), mask=there, other=0.0)
    inside, first = (y < H) & (x < W), v * H * W
    b = tl.load(frames + first + at, mask=inside, other=0.0)
    d = (tl.load(predicted + first + at, mask=inside, other=0.0) - b) * inverse
    step, slope = tl.load(upstream + v) * pixel_share, tl.load(upstream + V + v) * window_share
    sign = tl.where(d > 0, step, tl.where(d < 0, -step, 0.0))
    tl.store(out + first + at, sign + slope * (mean + 2 * d * square + (b * inverse + offset) * cross), mask=inside)
