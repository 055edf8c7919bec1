"""Linear tomography: filtered back-projection for views about one axis, at any angles, and for views of any orientation
SIRT (all rays at once) and ART (ray after ray)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ..checks import require
from ..geometry import Grid, Views
from ..memory import memory_kept
from ..progress import Advance
from ..projectors.voxels import Projector, SliceProjector, projector_for
from ..ranges import Natural, SomeShare, checked_dataclass
from ..rotations import angles_about_y
from .rays import Rays, bounded, checked_upper, in_pixels, rays_of


@checked_dataclass
class Ramp:
    """Options. window: of the ramp filter; cutoff: its end, as a fraction of the Nyquist frequency; nonnegative:
    whether values below zero are set to zero at the end, which is no longer linear.
    """

    window: Literal["ramlak", "shepp-logan", "hann"] = "hann"
    cutoff: SomeShare = 1.0
    nonnegative: bool = False


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
    angles = angles_about_y(views.rotations) % np.pi
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


SHORTEST = 1e-3
"""Paths and shadows [pixels] below which a ray or a voxel counts as unseen; it then moves nothing."""


@checked_dataclass
class Algebraic:
    """Options. sweeps: how often each ray is used (a few: errors of the lines are fitted later than the object);
    relaxation: length of a step, between 0 and 2; nonnegative: whether the occupancy is kept from going below zero.
    """

    sweeps: Natural = 60
    relaxation: float = 1.0
    nonnegative: bool = False

    def __post_init__(self) -> None:
        require(0 < self.relaxation < 2, f"relaxation must lie between 0 and 2, but it is {self.relaxation:g}.")


def sirt(
    lines: Tensor,
    views: Views,
    grid: Grid,
    upper: float | None,
    on_progress: Advance,
    *,
    options: Algebraic = Algebraic(),
    missing: Tensor | None = None,
    two_sided: bool = False,
    start: Tensor | None = None,
) -> Tensor:
    """Occupancy [Z, Y, X] on `grid` from thickness `lines` [V, H, W] in metres, by SIRT; float32.

    `x ← x + ω C Aᵀ R (b - A x)` with R and C one over the sums of A's rows and columns (Gregor & Benson 2008, eq. 2),
    then the bounds: `upper`, and zero if `options.nonnegative` and not `two_sided`. It starts from zero, or from
    `start` [Z, Y, X]; then `lines` are those beyond its own.
    """
    top, rays = checked_upper(upper), rays_of(lines, views, grid, missing=missing)
    lowest = 0.0 if options.nonnegative and not two_sided else None
    with memory_kept():
        return _simultaneous(rays, (lowest, top), on_progress, options, start)


def _simultaneous(
    rays: Rays,
    bounds: tuple[float | None, float | None],
    on_progress: Advance,
    options: Algebraic,
    start: Tensor | None,
) -> Tensor:
    projector, measured = rays.projector, rays.measured
    volume = torch.zeros(projector.array_shape)
    if start is not None:
        volume = projector.volume_in(start).clone()
        measured = measured + projector.project(volume)
    known = torch.ones_like(rays.measured) if rays.known is None else rays.known
    per_ray = _reciprocal(projector.project(torch.ones_like(volume))).mul_(known)
    per_voxel = _reciprocal(projector.backproject(known)).mul_(options.relaxation)
    for done in range(options.sweeps):
        on_progress(done / options.sweeps)
        missing = (measured - projector.project(volume)).mul_(per_ray)
        volume.addcmul_(per_voxel, projector.backproject(missing))
        bounded(volume, *bounds)
    return projector.volume_out(volume)


def art(
    lines: Tensor,
    views: Views,
    grid: Grid,
    upper: float | None,
    on_progress: Advance,
    *,
    options: Algebraic = Algebraic(sweeps=40, relaxation=0.5, nonnegative=True),
    missing: Tensor | None = None,
    two_sided: bool = False,
) -> Tensor:
    """Occupancy [Z, Y, X] on `grid` from thickness `lines` [V, H, W] in metres, by ART from zero; float32.

    Kaczmarz' method (Gordon, Bender & Herman 1970): `x ← x + ω aᵢ (bᵢ - ⟨aᵢ, x⟩) / |aᵢ|²`, ray by ray. Rays of a view
    that share no voxel are orthogonal, so each such set is taken at once, which gives the same as one after the other.
    Views follow each other by the golden section, so that successive ones differ. Bounds are imposed after each view
    (the same authors' partially constrained ART: not below zero, unless `options` say otherwise, or it is `two_sided`).
    """
    views.parallel("ART")
    top, rays = checked_upper(upper), rays_of(lines, views, grid, missing=missing)
    lowest = 0.0 if options.nonnegative and not two_sided else None
    with memory_kept():
        steps = _orthogonal_sets(rays)
        volume = torch.zeros(rays.projector.array_shape)
        for done in range(options.sweeps * len(steps)):
            on_progress(done / (options.sweeps * len(steps)))
            step = steps[done % len(steps)]
            for scale in step.scales:
                missing = (step.measured - step.projector.project(volume)).mul_(scale)
                volume.add_(step.projector.backproject(missing), alpha=options.relaxation)
            bounded(volume, lowest, top)
        return rays.projector.volume_out(volume)


@dataclass(frozen=True)
class _View:
    """One view of ART: its projector, its lines, and for each set of orthogonal rays `1/|aᵢ|²`, zero elsewhere."""

    projector: Projector
    measured: Tensor
    scales: list[Tensor]


def _orthogonal_sets(rays: Rays) -> list[_View]:
    """The views in their order, each with its sets of rays that share no voxel."""
    kind, count, found = type(rays.projector), len(rays.views), []
    golden = (math.sqrt(5) - 1) / 2
    for v in sorted(range(count), key=lambda i: (i * golden) % 1):
        projector = kind(rays.grid, rays.views[[v]])
        # in one set, A Aᵀ is diagonal: applied to the set itself it gives the |aᵢ|²
        sets = [projector.lines_in(mask) for mask in _masks(rays)]
        squares = [projector.project(projector.backproject(mask)) for mask in sets]
        known = 1.0 if rays.known is None else rays.known[v : v + 1]
        scales = [mask * _reciprocal(square) * known for mask, square in zip(sets, squares)]
        found.append(_View(projector, rays.measured[v : v + 1], scales))
    return found


def _masks(rays: Rays) -> list[Tensor]:
    """Sets of pixels [1, H, W] (1 inside, 0 elsewhere), so far apart that no voxel's shadow meets two of a set."""
    i, j = (torch.arange(n) for n in rays.views.shape)
    if isinstance(rays.projector, SliceProjector):  # rows are slices; a shadow is at most √2 voxels wide
        apart = math.ceil(math.sqrt(2) * rays.grid.voxel_size[0] / rays.views.pixel_size - 1e-9) + 1
        return [((j % apart == c) & (i[:, None] >= 0)).float()[None] for c in range(apart)]
    return [((i[:, None] % 2 == a) & (j % 2 == b)).float()[None] for a in (0, 1) for b in (0, 1)]


def _reciprocal(lengths: Tensor) -> Tensor:
    return torch.where(lengths > SHORTEST, 1 / lengths.clamp_min(SHORTEST), 0.0)
