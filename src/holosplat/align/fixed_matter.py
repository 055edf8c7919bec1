"""Poses of frames with fixed matter of any kind, by small steps from its projections, or with fitted surfaces.

Poses and distances by matter with sharp edges: closed surfaces cut out of the voxels, fitted with the geometry free.
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
from ..fit.problem import Schedule
from ..geometry import Grid
from ..matter import DeltaBeta, Matter
from ..methods.surface_fit import SurfaceFit, oversampling, surface_fit
from ..model import Instrument, Model
from ..progress import Advance
from ..representations import Stored, SurfaceMesh, isosurface
from ..scan import Exposures, Scan
from .derivatives import NUMBERS, Normal, Predicted, Step, numbers_of, step, unexplained
from .poses import DISTANCE, FLUX, MAGNIFICATION, PoseOptions, aligned

SMALL = (0.05, 0.05, 1e-3, 1e-3, 1e-3, 0.01, 1e-3)
"""Steps by which derivatives of frames are taken: shifts [pixels], turns [rad], logarithms of distance and
magnification."""
BLUR = 0.5
"""Frames are compared after a Gaussian of this standard deviation [pixels]: edges are sharp."""
STEPS = 3
"""Newton's steps, from poses that are right to some tenths of a pixel."""
SAMPLES = 4_000_000
"""Wave samples of the frames that are made together: some hundred megabytes."""


class Beside:
    """Frames of `matter`, and how they change with the numbers of `planned` exposures.

    What costs the same for one frame as for many (voxels brought to the pixels' size) is done once for as many frames
    as `SAMPLES` allows.
    """

    def __init__(self, matter: Stored, planned: Exposures, oversample: int) -> None:
        self._matter, self._planned, self._oversample = matter, planned, oversample
        h, w = planned.views.shape
        self._most = max(1, SAMPLES // (h * w * oversample**2))

    def predicted(self, numbers: Tensor, magnified: bool = False) -> Predicted:
        """Frames at `numbers` [V, 8], and their derivatives by one-sided differences.

        magnified: whether the derivative by the magnification is asked for, else it is zero.
        """
        steps = torch.tensor(SMALL if magnified else SMALL[:-1], dtype=torch.float64)
        moves = torch.cat([torch.zeros(1, len(NUMBERS)), torch.eye(len(NUMBERS))[: len(steps)]]).double()
        moves[1:] *= steps[:, None]
        count = len(moves)
        tried = (numbers[:, None] + moves).flatten(0, 1)
        frames = self._frames(np.repeat(np.arange(len(numbers)), count), tried)
        frames = frames.reshape(len(numbers), count, *frames.shape[1:])
        here = frames[:, 0]
        slopes = torch.zeros(len(numbers), len(NUMBERS), *here.shape[1:])
        slopes[:, : len(steps)] = (frames[:, 1:] - here[:, None]) / steps.float()[:, None, None]
        slopes[:, -1] = here
        return Predicted(here, slopes)

    def frames(self, numbers: Tensor) -> Tensor:
        """Frames [V, H, W] at `numbers`."""
        return self._frames(np.arange(len(numbers)), numbers)

    @torch.no_grad()
    def _frames(self, views: np.ndarray, numbers: Tensor) -> Tensor:
        """Frames [N, H, W] of the planned exposures `views` [N] at `numbers` [N, 8]."""
        parts = []
        for first in range(0, len(views), self._most):
            some = slice(first, first + self._most)
            instrument = Instrument(self._planned[views[some]], self._oversample, backend=self._matter.backend)
            parts.append(Model(self._matter, instrument, aligned(numbers[some])).frames().cpu())
        return torch.cat(parts) * numbers[:, -1].exp().float()[:, None, None]

    def placed(
        self,
        measured: Tensor,
        numbers: Tensor,
        expected: Tensor,
        steps: int = STEPS,
        tell: Advance = lambda part: None,
    ) -> Step:
        """The numbers of `measured` frames [V, H, W] after some steps from `numbers`, with their covariances.

        expected: standard deviations [8] about the plan, 0 for what stays. No steps at all: covariances where they are.
        """
        found = Step(numbers, torch.zeros(len(numbers), len(NUMBERS), len(NUMBERS), dtype=torch.float64))
        for done in range(max(1, steps)):
            normal = Normal.of(measured, self.predicted(found.numbers, bool(expected[MAGNIFICATION] > 0)), BLUR)
            moved = step(normal, found.numbers, expected)
            found = moved if steps else replace(moved, numbers=numbers)
            tell((done + 1) / max(1, steps))
        return found


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
    expected = uncertain.deviations(sharp=True)
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
