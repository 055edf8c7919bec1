"""Closed bodies that frames show badly: their surfaces, and the volume that agrees with the frames, in turns."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import torch
from torch import Tensor

from ..baselines.holographic_tv import agreed
from ..baselines.two_materials import Shares, at_one_ratio
from ..checks import InputError, require
from ..geometry import Grid
from ..matter import Matter
from ..representations import SurfaceMesh
from .coarse import settled
from .gaussian_options import GaussianOptions
from .method import Task
from .surface_fit import SurfaceOptions, cut_surfaces, frames_of

LEVELS = (0.2, 0.3, 0.4, 0.5, 0.6)
"""Occupancies at which a volume may be cut."""


def in_turns(task: Task, found: SurfaceMesh, options: GaussianOptions, surfaces: SurfaceOptions) -> SurfaceMesh:
    """Surfaces that explain the frames of `task`, a bounded one, better than `found`, which is settled; else that.

    A surface moves its edges, but begins no body, and follows no fringe from a few pixels away. Rounds of agreement
    that begin with its bodies (`baselines.holographic_tv.agreed`) say what is missing, or too much, elsewhere; the
    volume is cut again, and its surfaces are settled. So it goes on, at most `CoarseToFine.turns` times, as long as the
    square of what they leave of the frames falls by `turn_gain` of it or more. Without rounds there are no turns.
    """
    how = options.coarse.of_views(len(task.scan.train()))
    least = _left(task, found, surfaces)
    for _ in range(how.turns if options.volume.corrections > 0 else 0):
        try:
            turned = settled(task, _cut_again(task, found, options, surfaces), surfaces, how)
        except InputError:  # the volume holds no surface
            break
        left = _left(task, turned, surfaces)
        if left < least:
            found = turned
        if left > (1 - how.turn_gain) * least:
            break
        least = left
    return found


def _cut_again(task: Task, found: SurfaceMesh, options: GaussianOptions, surfaces: SurfaceOptions) -> SurfaceMesh:
    """Surfaces of the volume after rounds that began with the bodies of `found`."""
    grid = Grid.of_views(task.scan.views)
    shares, first = found.shares(grid), found.matter.channels[0]
    start = sum(float(each.delta / first.delta) * share for each, share in zip(found.matter.channels, shares))
    scan, backend = task.scan, options.volume.backend
    if found.matter.others:
        scan = at_one_ratio(scan, Shares(shares.float().cpu(), grid, found.matter.channels), first.ratio, backend)
    how = options.volume.in_noise()
    volume, grid = agreed(scan, first, torch.as_tensor(start).float(), how, task.on_progress, task.unlike_null)
    return cut_as_seen(task, volume, grid, found.matter, surfaces)


def cut_as_seen(task: Task, volume: Tensor, grid: Grid, matter: Matter, surfaces: SurfaceOptions) -> SurfaceMesh:
    """The surfaces of an occupancy [Z, Y, X] on `grid` at the one of `LEVELS` at which they leave least of the frames.

    Noise and total variation make what is thin fainter, and a surface that is too large shrinks, but one that is
    missing does not grow. Errors: `InputError` if there are none at any level.
    """
    tried = list[tuple[float, SurfaceMesh]]()
    for level in LEVELS:
        how = replace(surfaces.extraction, level=level)
        with suppress(InputError):  # no surface at this level
            cut = cut_surfaces(volume, grid, task.scan.views.finest, matter, how)
            tried.append((_left(task, cut, surfaces), cut))
    require(len(tried) > 0, "the volume holds no surface.")
    return min(tried, key=lambda one: one[0])[1]


def _left(task: Task, found: SurfaceMesh, surfaces: SurfaceOptions) -> float:
    """Mean square of what `found` leaves of the frames."""
    return float(task.scan.left(frames_of(found, task.scan, surfaces.fit)).double().square().mean())
