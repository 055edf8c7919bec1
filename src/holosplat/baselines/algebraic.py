"""Algebraic tomography: SIRT (all rays at once) and ART (ray after ray), for views of any orientation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..checks import at_least, require
from ..geometry import Grid, Views
from ..memory import memory_kept
from ..progress import Advance
from ..projectors.voxels import Projector, SliceProjector
from ..ranges import checked_dataclass
from .rays import Rays, bounded, checked_upper, rays_of

SHORTEST = 1e-3
"""Paths and shadows [pixels] below which a ray or a voxel counts as unseen; it then moves nothing."""


@checked_dataclass
class Algebraic:
    """Options. sweeps: how often each ray is used (a few: errors of the lines are fitted later than the object);
    relaxation: length of a step, between 0 and 2; nonnegative: whether the occupancy is kept from going below zero.
    """

    sweeps: int = 60
    relaxation: float = 1.0
    nonnegative: bool = False

    def __post_init__(self) -> None:
        at_least(self, 1, "sweeps")
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
) -> Tensor:
    """Occupancy [Z, Y, X] on `grid` from thickness `lines` [V, H, W] in metres, by SIRT from zero; float32.

    `x ← x + ω C Aᵀ R (b - A x)` with R and C one over the sums of A's rows and columns (Gregor & Benson 2008, eq. 2),
    then the bounds: `upper`, and zero if `options.nonnegative` and not `two_sided`.
    """
    top, rays = checked_upper(upper), rays_of(lines, views, grid, missing=missing)
    lowest = 0.0 if options.nonnegative and not two_sided else None
    with memory_kept():
        return _simultaneous(rays, (lowest, top), on_progress, options)


def _simultaneous(
    rays: Rays, bounds: tuple[float | None, float | None], on_progress: Advance, options: Algebraic
) -> Tensor:
    projector = rays.projector
    volume = torch.zeros(projector.array_shape)
    known = torch.ones_like(rays.measured) if rays.known is None else rays.known
    per_ray = _reciprocal(projector.project(torch.ones_like(volume))).mul_(known)
    per_voxel = _reciprocal(projector.backproject(known)).mul_(options.relaxation)
    for done in range(options.sweeps):
        on_progress(done / options.sweeps)
        missing = (rays.measured - projector.project(volume)).mul_(per_ray)
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
