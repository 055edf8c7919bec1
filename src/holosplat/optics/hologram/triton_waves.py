"""The Triton kernels of `cuda.py`: what happens to each sample between the Fourier transforms.

A program has a piece of one row. Complex numbers are pairs of float32 in memory. Sines and exponentials are
polynomials of our own: accurate to float32, the same in Triton's interpreter, and without the memory that the
libraries' exact reductions of huge angles want. They hold for phases up to 1e5 and |loss| up to 87.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false, reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK, WARPS = 256, 2
"""Samples of a program, and its warps."""

Refraction = list[list[float]] | Tensor
"""(phase, loss) per unit of line integral: for each channel, or a float32 tensor [V, C, 2] on the device."""

# --- launches -----------------------------------------------------------------------------------------------


def exit_wave(lines: Tensor, refraction: Refraction) -> Tensor:
    """`exp(-loss - i phase) - 1`, complex64 [V, H, W], of line integrals [V, C, H, W]."""
    v, c, h, w = lines.shape
    wave = torch.empty(v, h, w, dtype=torch.complex64, device=lines.device)
    if wave.numel():
        pairs, (matter, per_view) = torch.view_as_real(wave), _matter(refraction, lines)
        _exit_wave[_grid(v * h, w)](lines, pairs, *matter, h, w, c, per_view, BLOCK, num_warps=WARPS)
    return wave


def exit_wave_backward(lines: Tensor, refraction: Refraction, gradient: Tensor) -> Tensor:
    """The gradient of line integrals [V, C, H, W] from that of the wave, complex64 [V, H, W]."""
    v, c, h, w = lines.shape
    out = torch.empty_like(lines)
    if out.numel():
        pairs, (matter, per_view) = torch.view_as_real(gradient.contiguous()), _matter(refraction, lines)
        _exit_wave_backward[_grid(v * h, w)](lines, pairs, out, *matter, h, w, c, per_view, BLOCK, num_warps=WARPS)
    return out


def transfer(spectrum: Tensor, rows: Tensor, columns: Tensor, conjugate: bool) -> None:
    """spectrum [V, H, W] times rows [V, H] and columns [V, W] (or their conjugates) over H·W, complex64, in place."""
    v, h, w = spectrum.shape
    if spectrum.numel():
        pairs = [torch.view_as_real(a) for a in (spectrum, rows, columns)]
        _transfer[_grid(v * h, w)](*pairs, h, w, 1 / (h * w), conjugate, BLOCK, num_warps=WARPS)


def attenuate(spectrum: Tensor, rows: Tensor, columns: Tensor) -> None:
    """spectrum [V, H, W // 2 + 1], complex64, times rows [V, H] and columns [V, W], float32, over H·W, in place."""
    v, h, half = spectrum.shape
    width = columns.shape[1]
    if spectrum.numel():
        pairs = torch.view_as_real(spectrum)
        _attenuate[_grid(v * h, half)](pairs, rows, columns, h, half, width, 1 / (h * width), BLOCK, num_warps=WARPS)


def contrast(wave: Tensor) -> Tensor:
    """`|1 + wave|² - 1`, float32 [V, H, W]."""
    samples = torch.empty(wave.shape, dtype=torch.float32, device=wave.device)
    if samples.numel():
        pairs = torch.view_as_real(wave.contiguous())
        _contrast[_flat(samples)](pairs, samples, samples.numel(), BLOCK, num_warps=WARPS)
    return samples


def contrast_backward(samples: Tensor, wave: Tensor) -> None:
    """wave [V, H, W] becomes its gradient, from the gradient of its contrast, in place."""
    if wave.numel():
        pairs, given = torch.view_as_real(wave), samples.contiguous()
        _contrast_backward[_flat(samples)](given, pairs, given.numel(), BLOCK, num_warps=WARPS)


def bin_samples(samples: Tensor, shape: tuple[int, int], margin: tuple[int, int], factor: int) -> Tensor:
    """Frames [V, h, w]: 1 + the mean over each pixel's `factor²` samples, `margin` in from the border of [V, H, W]."""
    return _frames(samples.contiguous(), samples.shape, shape, margin, factor, waves=False)


def intensity(wave: Tensor, shape: tuple[int, int], margin: tuple[int, int], factor: int) -> Tensor:
    """`bin_samples` of the contrast of a wave."""
    return _frames(torch.view_as_real(wave.contiguous()), wave.shape, shape, margin, factor, waves=True)


def _frames(
    source: Tensor, raster: torch.Size, shape: tuple[int, int], margin: tuple[int, int], factor: int, *, waves: bool
) -> Tensor:
    frames = source.new_empty(raster[0], *shape)
    if frames.numel():
        grid = _grid(raster[0] * shape[0], shape[1])
        _bin[grid](source, frames, *raster[1:], *shape, *margin, factor, waves, BLOCK, num_warps=WARPS)
    return frames


def bin_samples_backward(gradient: Tensor, raster: tuple[int, int], margin: tuple[int, int], factor: int) -> Tensor:
    """The gradient of samples [V, H, W] from that of frames [V, h, w]: zero beyond the frame."""
    v, *shape = gradient.shape
    samples = gradient.new_empty(v, *raster)
    if samples.numel():
        grid = _grid(v * raster[0], raster[1])
        _bin_backward[grid](gradient, samples, *raster, *shape, *margin, factor, False, BLOCK, num_warps=WARPS)
    return samples


def intensity_backward(gradient: Tensor, wave: Tensor, margin: tuple[int, int], factor: int) -> None:
    """wave [V, H, W] becomes its gradient, from that of frames [V, h, w], in place."""
    (v, *raster), shape = wave.shape, gradient.shape[1:]
    if wave.numel():
        grid, pairs = _grid(v * raster[0], raster[1]), torch.view_as_real(wave)
        _bin_backward[grid](gradient, pairs, *raster, *shape, *margin, factor, True, BLOCK, num_warps=WARPS)


def _grid(rows: int, width: int) -> tuple[int, ...]:
    return (rows * triton.cdiv(width, BLOCK),)


def _flat(array: Tensor) -> tuple[int, ...]:
    return (triton.cdiv(array.numel(), BLOCK),)


def _matter(refraction: Refraction, lines: Tensor) -> tuple[tuple[Tensor | float, ...], bool]:
    """What kernels take: a table, then phase and loss of two channels; and whether the table holds (else: these)."""
    if isinstance(refraction, Tensor):
        return (refraction.contiguous(), 0.0, 0.0, 0.0, 0.0), True
    numbers = [number for pair in refraction for number in pair]
    return (lines, *numbers, *[0.0] * (4 - len(numbers))), False


# --- kernels ------------------------------------------------------------------------------------------------

SIZES = ["H", "W"]
CROP = ["H", "W", "ROWS", "COLUMNS", "TOP", "LEFT", "FACTOR"]


@triton.jit
def _corner(W, BLOCK: tl.constexpr):
    # This program's row (of all views, one below the other), and first column.
    pieces = tl.cdiv(W, BLOCK)
    return (tl.program_id(0) // pieces).to(tl.int64), tl.program_id(0) % pieces * BLOCK


@triton.jit
def _piece(W, BLOCK: tl.constexpr):
    # The same, with all columns, and which of them exist.
    row, first = _corner(W, BLOCK)
    x = first + tl.arange(0, BLOCK)
    return row, first, x, x < W


@triton.jit
def _load_pairs(pairs, at, end, BLOCK: tl.constexpr):
    # Complex numbers at .. at + BLOCK - 1 of a row that stops at `end`: loaded as neighbours, then taken apart.
    k = 2 * at + tl.arange(0, 2 * BLOCK)
    return tl.split(tl.reshape(tl.load(pairs + k, mask=k < 2 * end, other=0.0), (BLOCK, 2)))


@triton.jit
def _store_pairs(pairs, at, end, re, im, BLOCK: tl.constexpr):
    k = 2 * at + tl.arange(0, 2 * BLOCK)
    tl.store(pairs + k, tl.interleave(re, im), mask=k < 2 * end)


@triton.jit
def _sine_cosine(x):
    # Cody & Waite's reduction by quarter turns in three parts, then minimax polynomials, as in native/waves.hpp.
    n = tl.floor(x * 0.636619772 + 0.5)
    r = tl.fma(n, -7.54978995e-8, tl.fma(n, -4.83751297e-4, tl.fma(n, -1.5703125, x)))
    z = r * r
    s = ((-0.000195854334 * z + 0.00833273693) * z - 0.166666646) * z * r + r
    c = ((2.45454283e-05 * z - 0.00138882913) * z + 0.0416666646) * z * z + (1.0 - 0.5 * z)
    half = tl.floor(n * 0.5)
    odd, turned = n > 2 * half, half > 2 * tl.floor(half * 0.5)
    sine, cosine = tl.where(odd, c, s), tl.where(odd, -s, c)
    return tl.where(turned, -sine, sine), tl.where(turned, -cosine, cosine)


@triton.jit
def _expm1(x):
    # 2ⁿ (e^r - 1) + 2ⁿ - 1 with |r| ≤ ½ ln 2: a Taylor polynomial, whose remainder is 2e-8 of the value.
    x = tl.minimum(tl.maximum(x, -87.0), 87.0)
    n = tl.floor(x * 1.44269504 + 0.5)
    r = tl.fma(n, 2.12194440e-4, tl.fma(n, -0.693359375, x))
    p = ((((r * (1 / 5040) + 1 / 720) * r + 1 / 120) * r + 1 / 24) * r + 1 / 6) * r + 0.5
    power = tl.where(n == 0, 1.0, tl.exp2(n))
    return power * (p * r * r + r) + (power - 1.0)


@triton.jit
def _of_view(table, view, phase0, loss0, phase1, loss1, C: tl.constexpr, PER_VIEW: tl.constexpr):
    # Phase and loss of two channels in a view: from the table [V, C, 2], or as they are.
    if PER_VIEW:
        phase0, loss0 = tl.load(table + 2 * C * view), tl.load(table + 2 * C * view + 1)
        if C == 2:
            phase1, loss1 = tl.load(table + 2 * C * view + 2), tl.load(table + 2 * C * view + 3)
    return phase0, loss0, phase1, loss1


@triton.jit
def _scattered(lines, row, x, there, H, W, phase0, loss0, phase1, loss1, C: tl.constexpr):
    # U - 1 behind the object, as `exit_wave_of`: real part expm1(-loss) - 2 e^-loss sin²(phase / 2).
    view = row // H
    at = (view * C * H + row % H) * W + x
    line = tl.load(lines + at, mask=there, other=0.0)
    phase, loss = phase0 * line, loss0 * line
    if C == 2:
        line = tl.load(lines + at + H.to(tl.int64) * W, mask=there, other=0.0)
        phase += phase1 * line
        loss += loss1 * line
    s, c = _sine_cosine(0.5 * phase)
    shrink = _expm1(-loss)
    twice = 2.0 * (shrink + 1.0) * s
    return shrink - twice * s, -twice * c, at


@triton.jit(do_not_specialize=SIZES)
def _exit_wave(
    lines, wave, table, phase0, loss0, phase1, loss1, H, W, C: tl.constexpr, PER_VIEW: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    row, first, x, there = _piece(W, BLOCK)
    phase0, loss0, phase1, loss1 = _of_view(table, row // H, phase0, loss0, phase1, loss1, C, PER_VIEW)
    re, im, _ = _scattered(lines, row, x, there, H, W, phase0, loss0, phase1, loss1, C)
    _store_pairs(wave, row * W + first, row * W + W, re, im, BLOCK)


@triton.jit(do_not_specialize=SIZES)
def _exit_wave_backward(
    lines, gradient, out, table, phase0, loss0, phase1, loss1, H, W, C: tl.constexpr, PER_VIEW: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    # Re(conj(dU/dT) g) with dU/dT = -(loss + i phase) U, for a gradient g of real and imaginary part
    row, first, x, there = _piece(W, BLOCK)
    phase0, loss0, phase1, loss1 = _of_view(table, row // H, phase0, loss0, phase1, loss1, C, PER_VIEW)
    re, im, at = _scattered(lines, row, x, there, H, W, phase0, loss0, phase1, loss1, C)
    re += 1.0
    u, v = _load_pairs(gradient, row * W + first, row * W + W, BLOCK)
    along, across = re * u + im * v, re * v - im * u
    tl.store(out + at, -(loss0 * along + phase0 * across), mask=there)
    if C == 2:
        tl.store(out + at + H.to(tl.int64) * W, -(loss1 * along + phase1 * across), mask=there)


@triton.jit(do_not_specialize=SIZES)
def _transfer(spectrum, rows, columns, H, W, scale, CONJUGATE: tl.constexpr, BLOCK: tl.constexpr):
    row, first = _corner(W, BLOCK)
    p, q = scale * tl.load(rows + 2 * row), scale * tl.load(rows + 2 * row + 1)
    line = row // H * W
    c, d = _load_pairs(columns, line + first, line + W, BLOCK)
    a, b = p * c - q * d, p * d + q * c
    if CONJUGATE:
        b = -b
    u, v = _load_pairs(spectrum, row * W + first, row * W + W, BLOCK)
    _store_pairs(spectrum, row * W + first, row * W + W, u * a - v * b, u * b + v * a, BLOCK)


@triton.jit(do_not_specialize=["H", "HALF", "W"])
def _attenuate(spectrum, rows, columns, H, HALF, W, scale, BLOCK: tl.constexpr):
    row, first, x, there = _piece(HALF, BLOCK)
    factor = scale * tl.load(rows + row) * tl.load(columns + row // H * W + x, mask=there, other=0.0)
    at, end = row * HALF + first, row * HALF + HALF
    u, v = _load_pairs(spectrum, at, end, BLOCK)
    _store_pairs(spectrum, at, end, u * factor, v * factor, BLOCK)


@triton.jit(do_not_specialize=["COUNT"])
def _contrast(wave, samples, COUNT, BLOCK: tl.constexpr):
    first = tl.program_id(0).to(tl.int64) * BLOCK
    re, im = _load_pairs(wave, first, COUNT, BLOCK)
    at = first + tl.arange(0, BLOCK)
    tl.store(samples + at, 2.0 * re + (re * re + im * im), mask=at < COUNT)


@triton.jit(do_not_specialize=["COUNT"])
def _contrast_backward(samples, wave, COUNT, BLOCK: tl.constexpr):
    first = tl.program_id(0).to(tl.int64) * BLOCK
    re, im = _load_pairs(wave, first, COUNT, BLOCK)
    at = first + tl.arange(0, BLOCK)
    twice = 2.0 * tl.load(samples + at, mask=at < COUNT, other=0.0)
    _store_pairs(wave, first, COUNT, twice * (1.0 + re), twice * im, BLOCK)


@triton.jit(do_not_specialize=CROP)
def _bin(
    source, frames, H, W, ROWS, COLUMNS, TOP, LEFT, FACTOR, WAVES: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    # 1 + the mean over a pixel's samples: of `source` itself, or, for WAVES, of the contrast of a wave
    row, _, x, there = _piece(COLUMNS, BLOCK)
    first = (row // ROWS * H + TOP + row % ROWS * FACTOR) * W + LEFT + x * FACTOR
    total = tl.zeros((BLOCK,), tl.float32)
    for i in range(FACTOR):
        for j in range(FACTOR):
            at = first + i * W + j
            if WAVES:
                re = tl.load(source + 2 * at, mask=there, other=0.0)
                im = tl.load(source + 2 * at + 1, mask=there, other=0.0)
                total += 2.0 * re + (re * re + im * im)
            else:
                total += tl.load(source + at, mask=there, other=0.0)
    tl.store(frames + row * COLUMNS + x, 1.0 + total / (FACTOR * FACTOR), mask=there)


@triton.jit(do_not_specialize=CROP)
def _bin_backward(
    gradient, out, H, W, ROWS, COLUMNS, TOP, LEFT, FACTOR, WAVES: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    # `out` becomes the gradient of samples; or, for WAVES, the wave in it becomes its own gradient, 2 g (1 + wave)
    row, first, x, there = _piece(W, BLOCK)
    y = (row % H).to(tl.int32) - TOP
    inside = there & (y >= 0) & (y < ROWS * FACTOR) & (x >= LEFT) & (x < LEFT + COLUMNS * FACTOR)
    at = (row // H * ROWS + y // FACTOR) * COLUMNS + (x - LEFT) // FACTOR
    g = tl.load(gradient + at, mask=inside, other=0.0) / (FACTOR * FACTOR)
    if WAVES:
        re, im = _load_pairs(out, row * W + first, row * W + W, BLOCK)
        _store_pairs(out, row * W + first, row * W + W, 2.0 * g * (1.0 + re), 2.0 * g * im, BLOCK)
    else:
        tl.store(out + row * W + x, g, mask=there)
