"""Filtered back-projection for views about one axis, at any angles."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ..checks import require
from ..geometry import Grid, Views
from ..progress import Advance
from ..projectors.voxels import projector_for
from ..ranges import checked_dataclass
from .algebraic import Algebraic, sirt
from .rays import bounded, checked_upper, in_pixels


@checked_dataclass
class Ramp:
    """Options. window: of the ramp filter; cutoff: its end, as a fraction of the Nyquist frequency; nonnegative:
    whether values below zero are set to zero at the end, which is no longer linear.
    """

    window: Literal["ramlak", "shepp-logan", "hann"] = "hann"
    cutoff: float = 1.0
    nonnegative: bool = False

    def __post_init__(self) -> None:
        require(0 < self.cutoff <= 1, f"cutoff must lie between 0 and 1, but it is {self.cutoff:g}.")


def filtered_backprojection(
    lines: Tensor,
    views: Views,
    grid: Grid,
    upper: float | None,
    on_progress: Advance,
    *,
    options: Ramp = Ramp(),
    missing: Tensor | None = None,
    two_sided: bool = False,
) -> Tensor:
    """Occupancy [Z, Y, X] on `grid` from thickness `lines` [V, H, W] in metres; float32.

    Each view is filtered by the band-limited ramp, weighted by half the gaps to its neighbours' angles (so that uneven
    ones are right), and smeared back by linear interpolation (Kak & Slaney 1988, eqs. 3.23 to 3.30). Values above
    `upper` are cut. Views without a common axis are refused. A filter needs all rays: those of missing pixels take what
    the volume of the others by `sirt` says.
    """
    views.parallel("filtered back-projection")
    require(
        views.shares_axis,
        "filtered back-projection needs views that turn about the y axis only, at one height, on pixels of one size; "
        "take sirt, art or tv.",
    )
    pitch, top = views.pixel_size, checked_upper(upper)
    if missing is not None:
        lines = torch.where(missing, _explained(lines, views, grid, missing), lines)
    views, grid = in_pixels(lines, views, grid)
    filtered = _filtered(lines.float() / pitch, options) * angular_weights(views)[:, None, None]
    volume = _smeared(filtered, views, grid, on_progress)
    return bounded(volume, 0.0 if options.nonnegative and not two_sided else None, top)


def _explained(lines: Tensor, views: Views, grid: Grid, missing: Tensor) -> Tensor:
    """Lines [V, H, W] in metres of the volume that SIRT makes of those that are not missing."""
    options = Algebraic(nonnegative=True)
    volume = sirt(lines, views, grid, None, lambda fraction: None, options=options, missing=missing)
    pixels, voxels = in_pixels(lines, views, grid)
    projector = projector_for(voxels, pixels)
    return projector.lines_out(projector.project(projector.volume_in(volume))).to(lines) * views.pixel_size


def angular_weights(views: Views) -> Tensor:
    """[V] in radians: half the gaps to the neighbours' angles on both sides, modulo 180°; their sum is π."""
    angles = np.arctan2(views.rotations[:, 0, 2], views.rotations[:, 0, 0]) % np.pi
    order = np.argsort(angles, kind="stable")
    gaps = np.diff(angles[order], append=angles[order[0]] + np.pi)
    weights = np.empty(len(angles))
    weights[order] = 0.5 * (gaps + np.roll(gaps, 1))
    return torch.from_numpy(weights).float()


def ramp(length: int, options: Ramp = Ramp()) -> Tensor:
    """Response [length // 2 + 1] of the ramp filter at the frequencies of `rfft`, pixels of size one.

    It is built in real space, where the ramp is band-limited: 1/4 at 0, 0 at even and -1/(πn)² at odd n (Kak & Slaney
    1988, eq. 3.29). The ramp |f| itself, sampled in frequency, has the mean of each view wrong.
    """
    n = np.fft.fftfreq(length, 1 / length)
    kernel = np.zeros(length)
    odd = np.abs(n) % 2 == 1
    kernel[odd] = -1 / (np.pi * n[odd]) ** 2
    kernel[0] = 0.25
    frequency = np.fft.rfftfreq(length) / (0.5 * options.cutoff)  # 1 where the window ends
    shapes = {
        "ramlak": np.ones_like(frequency),
        "shepp-logan": np.sinc(0.5 * frequency),
        "hann": 0.5 + 0.5 * np.cos(np.pi * frequency),
    }
    return torch.from_numpy(np.fft.rfft(kernel).real * np.where(frequency <= 1, shapes[options.window], 0.0))


def _filtered(images: Tensor, options: Ramp) -> Tensor:
    """Images [V, H, W] after the ramp along their rows, zero-padded so that nothing wraps."""
    width = images.shape[-1]
    length = 2 ** int(np.ceil(np.log2(2 * width)))
    spectrum = torch.fft.rfft(images.double(), n=length) * ramp(length, options)
    return torch.fft.irfft(spectrum, n=length)[..., :width].float()


def _smeared(images: Tensor, views: Views, grid: Grid, on_progress: Advance) -> Tensor:
    """The sum [Z, Y, X] over views of `images` [V, H, W] at the voxels' shadows; zero outside the detector."""
    x, y, z = grid.axes()
    h, w = views.shape
    rows = _interpolation(y - views.shifts[0, 1] + 0.5 * h - 0.5, h)
    volume = torch.zeros(len(z) * len(x), len(y))
    for v, (rotation, shift) in enumerate(zip(views.rotations, views.shifts)):
        on_progress(v / len(views))
        column = rotation[0, 0] * x[None, :] + rotation[0, 2] * z[:, None] - shift[0] + 0.5 * w + 0.5
        column = torch.from_numpy(column.ravel()).clamp(0, w + 1)
        framed = torch.zeros(w + 2, len(y))  # a column of zeros on either side
        framed[1:-1] = images[v].T @ rows.T
        left = column.floor().long().clamp_max(w)
        volume += torch.lerp(framed[left], framed[left + 1], (column - left).float()[:, None])
    return volume.reshape(len(z), len(x), len(y)).transpose(1, 2).contiguous()


def _interpolation(places: np.ndarray, length: int) -> Tensor:
    """Matrix [N, length] that interpolates samples at 0, 1, … linearly at `places` [N]; zero beyond their pixels."""
    inside = (places >= -0.5 - 1e-9) & (places <= length - 0.5 + 1e-9)
    held = np.clip(places, 0, length - 1)
    weights = np.clip(1 - np.abs(held[:, None] - np.arange(length)), 0, None)
    return torch.from_numpy(weights * inside[:, None]).float()
