"""Poses and distances by matter with sharp edges: closed surfaces cut out of the voxels, fitted with the geometry free.

Voxels have soft edges, and a distance that is too long sharpens fringes just as sharper edges would. Surfaces have none
of that freedom: where they explain the frames, they tell the distance, and poses several times better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..checks import InputError
from ..fit.pose_refinement import PoseRefinement, mean_distance_error
from ..fit.schedule import Schedule
from ..geometry import Grid
from ..matter import DeltaBeta, Matter
from ..methods.surface_fit import SurfaceFit, oversampling, surface_fit
from ..progress import Advance
from ..representations import SurfaceMesh, isosurface
from ..scan import Exposures, Scan
from .changes import numbers_of
from .fixed_matter import Beside, aligned
from .newton import Step, unexplained
from .poses import DISTANCE, FLUX, PoseOptions

DECAY = 0.3
"""Share of the rates that is left at the last step: distances settle slowly in noise."""
FITTED = 0.7
"""Share of the time that the fit takes; placing frames takes the rest."""
EDGES, VOXELS, SURFACES = "edges of the matter", "voxels", "surfaces"


@dataclass(frozen=True)
class Sharpened:
    """step: numbers [V, 8] of all frames beside the plan, and their covariances beside the surfaces; left: [V, H, W]
    what surfaces leave of the frames, over their contrast; surfaces: in the poses that were found."""

    step: Step
    left: Tensor
    surfaces: SurfaceMesh


def surfaces_of(volume: Tensor, scan: Scan, material: DeltaBeta) -> SurfaceMesh | None:
    """Closed surfaces where occupancies `volume` on the field of view of `scan` cross a half; None where none do."""
    try:
        mesh = isosurface(volume.numpy(), Grid.of_views(scan.views))
    except InputError:
        return None
    unit = scan.views.finest
    return SurfaceMesh(
        torch.from_numpy(mesh.vertices / unit), torch.from_numpy(mesh.faces), unit, Matter.one(*material)
    )


def sharpened(scan: Scan, numbers: Tensor, start: SurfaceMesh, search: PoseOptions, on_progress: Advance) -> Sharpened:
    """All frames of `scan` beside surfaces that are fitted to those for training, from `start` and `numbers` [V, 8] on.

    numbers: of `NUMBERS` beside the exposures of `scan`, shifts in its pixels, as those of `search`. Held-out frames
    are placed beside the finished surfaces.
    """
    train, test = np.flatnonzero(~scan.is_test), np.flatnonzero(scan.is_test)
    options = SurfaceFit(schedule=Schedule(steps=search.edges, decay=DECAY), backend="cpu")
    frames, lit = scan.measured, numbers[:, FLUX].exp().float()[:, None, None]
    begin = replace(
        scan, frames=(torch.from_numpy(scan.frames) / lit).numpy(), exposures=aligned(numbers).exposures(scan.exposures)
    )[train]
    uncertain = search.uncertain
    freedom = replace(uncertain.freedom(numbers[train, :FLUX].numpy()), edges=True)
    fit = surface_fit(begin, start, options, freedom=freedom)
    fit.run(lambda record: on_progress(FITTED * fit.share))
    model = fit.result()
    assert isinstance(model.object, SurfaceMesh)
    assert model.alignment is not None
    found = numbers.clone()
    found[train, :FLUX] = numbers_of(model.alignment.exposures(begin.exposures), scan.exposures[train])
    beside = Beside(model.object, scan.exposures, oversampling(begin, options))
    expected = uncertain.deviations()
    expected[DISTANCE] = uncertain.distance
    moved = beside.placed(frames, found, expected, tell=lambda part: on_progress(FITTED + (1 - FITTED) * part))
    after = moved.numbers.clone()
    if not freedom.tells_mean(begin.exposures):  # these are moved by what the mean of the others was kept from
        away = (after[train, DISTANCE] - found[train, DISTANCE]).mean()
        after[test, DISTANCE] = 0.0 if len(train) < search.few_views else after[test, DISTANCE] - away
    after[train, :FLUX] = found[train, :FLUX]
    covariances = moved.covariances.clone()
    if uncertain.distance > 0:
        covariances[:, DISTANCE, DISTANCE] += mean_error(freedom, begin.exposures) ** 2
    return Sharpened(Step(after, covariances), unexplained(frames, beside.frames(after)), model.object)


def mean_error(freedom: PoseRefinement, exposures: Exposures) -> float:
    """Standard error of the mean distance, as a share: what sampling does, or what the plan leaves open."""
    return min(mean_distance_error(exposures), freedom.distance / math.sqrt(len(freedom)))
