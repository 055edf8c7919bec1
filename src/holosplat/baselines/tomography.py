"""The table of tomographies: thickness of each view in, occupancy of one material on voxels out."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ..checks import NoMatterError
from ..geometry import Grid, Views
from ..memory import memory_kept
from ..metrics.images import shortest_side
from ..optics.patterns import smooth_modes
from ..progress import Advance
from ..ranges import Metres, Share, Weight, checked_dataclass
from .algebraic import Algebraic, art, filtered_backprojection, sirt
from .primal_dual import PrimalDual
from .rays import Rays, checked_upper, rays_of

QUIETEST = 1e-4
"""The misfit's spectrum is taken to be nowhere below this fraction of its mean."""
LEVEL_STEPS = 20
"""Steps after which the level of the matter is looked at again, where there is no bound."""


class Tomography(Protocol):
    """(thickness [V, H, W] in metres, their views, grid, upper bound or None, progress) → occupancy [Z, Y, X]."""

    def __call__(
        self,
        lines: Tensor,
        views: Views,
        grid: Grid,
        upper: float | None,
        on_progress: Advance,
        /,
        *,
        missing: Tensor | None = None,
        two_sided: bool = False,
    ) -> Tensor:
        """The occupancy [Z, Y, X], dimensionless float32, never above `upper`; `on_progress(fraction)` on the way.

        missing: rays [V, H, W] bool of pixels without a value, which have no weight. two_sided: whether the occupancy
        may be below zero.
        """
        ...


sirt_nonnegative = partial(sirt, options=Algebraic(sweeps=200, relaxation=1.9, nonnegative=True))
"""`sirt` with the occupancy kept from going below zero, unless it is two-sided, which lets it run longer."""


@checked_dataclass
class TotalVariation:
    """Options. weight: of total variation, in pixels of path length; first: iterations with all frequencies of the
    lines trusted alike; iterations: those after, with each trusted by its misfit; discount: how much, as the power of
    the misfit's spectrum (0: not at all, 1: as for noise of that spectrum); still_light: half waves up to which light
    that is the same in all views is unknown, but for its mean (0: it is even); misfit: weight of total variation as a
    multiple of the misfit (rms) of the first iterations, where that is more; inside: distance from the axis within
    which matter lies, in pixels (0: anywhere); per_level: whether, without an upper bound, the weight is per level of
    the matter that is found; two_sided: whether the occupancy may be below zero.
    """

    weight: Weight = 0.5
    first: int = 60
    iterations: int = 100
    discount: Share = 0.5
    still_light: int = 0
    misfit: Weight = 0.0
    inside: Metres = 0.0
    per_level: bool = True
    two_sided: bool = False


def total_variation(
    lines: Tensor,
    views: Views,
    grid: Grid,
    upper: float | None,
    on_progress: Advance,
    *,
    options: TotalVariation = TotalVariation(),
    missing: Tensor | None = None,
    two_sided: bool = False,
) -> Tensor:
    """Occupancy [Z, Y, X] ≥ 0 on `grid` from thickness `lines` [V, H, W] in metres, by total variation; float32.

    `min ½ Σ |F[A u - b]|² / S + λ Σ|∇u|` with `0 ≤ u ≤ upper` (see `PrimalDual`), or `u ≤ upper` where it
    is `two_sided`. Errors of retrieved thickness are strongest at low frequencies, and by how much depends on noise and
    optics. So a first solution, with S = 1, tells the power spectrum of what no volume explains, and S is a power of
    that.
    """
    options = replace(options, two_sided=two_sided)
    with memory_kept():
        return tv_solver(rays_of(lines, views, grid, missing=missing), upper, options, on_progress).volume


def tv_solver(
    rays: Rays,
    upper: float | None,
    options: TotalVariation,
    on_progress: Advance,
    backend: str = "cpu",
    weights: Tensor | None = None,
) -> PrimalDual:
    """The solver of `total_variation` after its last iteration, for those who go on from there.

    Where there is no upper bound, the unit of the occupancy says nothing of the matter: the weight of total variation
    and the misfit's spectrum are then per level of the volume (its `plateau`), found anew after every `LEVEL_STEPS`; in
    the first of them there is no total variation.

    weights: trust in each ray [V, H, W], above 0; with them, or with still light, frequencies are trusted alike to the
    end. Rays of missing pixels take the line integral of the volume, and so have no weight.
    """
    like = rays.measured
    start, coupling = like.new_zeros(rays.grid.shape), 1 / rays.refine**2
    lower = float("-inf") if options.two_sided else 0.0
    solver = PrimalDual(rays.projector, start, options.weight, checked_upper(upper), coupling, backend, lower)
    if weights is not None:
        solver.weigh(weights.to(like))
    if options.inside > 0:
        solver.keep_inside(near_axis(rays.grid, options.inside).to(like.device))
    if options.still_light > 0:
        solver.with_still_light(smooth_modes(rays.views.shape, options.still_light, like.device)[1:])
    alike = weights is not None or options.still_light > 0
    images, total = rays.projector.lines_out(rays.measured), options.first + options.iterations
    found = upper is None and options.per_level
    gaps, measured, rms, level = rays.gaps(), images, 0.0, 0.0 if found else 1.0
    for done in range(total):
        on_progress(done / total)
        images = solver.completed(measured, gaps)
        if found and done % LEVEL_STEPS == 0 and bool((solver.volume != 0).any()):
            level = plateau(solver.volume.abs())
        if done == options.first and options.discount > 0 and not alike:
            spectrum = misfit_spectrum(rays, solver.lines() - images) / (level or 1.0) ** 2
            solver.discount(spectrum**options.discount)
        if done == options.first and options.misfit > 0:
            missing = images - solver.lines()
            rms = float((missing - solver.still_light(images)).square().mean().sqrt())
        solver.set_weight(max(options.weight * level, options.misfit * rms))
        solver.run(images, 1)
    return solver


def near_axis(grid: Grid, distance: float) -> Tensor:
    """Voxels [Z, Y, X] bool whose centres are nearer to the y axis than `distance`, in the grid's unit of length."""
    x, y, z = (torch.from_numpy(axis) for axis in grid.axes())
    near = torch.hypot(z[:, None, None], x[None, None, :]) < distance
    return near.expand(len(z), len(y), len(x))


def misfit_spectrum(rays: Rays, misfit: Tensor) -> Tensor:
    """Power spectrum [pixels²] of `misfit` [V, H, W], the mean over views and directions.

    Of frequencies as `rfft2` has them, for lines in the projector's order; white noise of variance σ² gives σ².
    """
    ordered = rays.projector.lines_in(misfit).double()
    power = torch.fft.rfft2(ordered, norm="ortho").abs().square().mean(0)
    h, w = ordered.shape[1:]
    frequency = np.hypot(np.fft.fftfreq(h)[:, None], np.fft.rfftfreq(w))
    steps = int(shortest_side((h, w), (1.0, 1.0)))
    near = np.minimum(np.rint(frequency * steps), steps // 2).astype(np.int64).ravel()
    ring = torch.from_numpy(near).to(power.device)
    sums = power.new_zeros(steps // 2 + 1).index_add(0, ring, power.ravel())
    means = sums / torch.bincount(ring, minlength=len(sums)).clamp_min(1)
    means[0] = means[1]  # of the mean itself there is one sample only, and the bounds push it
    floor = QUIETEST * float(means.mean())
    return means.clamp_min(max(floor, 1e-12))[ring].reshape(power.shape).float()


def plateau(occupancy: Tensor) -> float:
    """The level [units of `occupancy`] that most of the matter has: the mass-weighted median of [Z, Y, X] ≥ 0."""
    values = occupancy.cpu().clamp_min(0).double().flatten()
    whole = float(values.sum())
    if not whole > 0:
        raise NoMatterError
    for least in (0.5 * float(values @ values) / whole, 0.0):  # sorting all takes the longest, and dense ones often do
        above = np.sort(values.numpy()[values.numpy() > least])
        mass = above.cumsum()
        if mass[-1] >= 0.5 * whole:
            break
    return float(above[mass.searchsorted(mass[-1] - 0.5 * whole)])


TOMOGRAPHIES: dict[str, Tomography] = {
    "fbp": filtered_backprojection,
    "art": art,
    "sirt": sirt,
    "sirt-nonneg": sirt_nonnegative,
    "tv": total_variation,
}
"""Name → tomography. Only fbp needs a common axis; art, sirt-nonneg and tv keep the occupancy from going below zero."""
