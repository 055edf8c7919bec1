"""Voxels fitted to holograms through the full wave model, with total variation and bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..checks import at_least, require
from ..geometry import Grid
from ..memory import memory_kept
from ..optics.sampling import resolving_oversample
from ..representations.voxel_lines import VoxelLines
from ..representations.voxels import VoxelGrid
from ..scan import Scan
from ..volume import LineIntegrals
from .projected_gradient import spectral_projected_gradient
from .total_variation import total_variation
from .waves import FEWEST_SAMPLES, WaveMisfit

COARSE, FINE = "voxels through the waves, coarse", "voxels through the waves"
ABSORPTION_REACH = 10.0
"""How much longer than those of δ the steps of a free β are, in units of the material's. At equal lengths β would not
move, for it changes the frames a thousand times less; at lengths for equal changes it would fit the noise."""

Progress = Callable[[str, float], None]
"""Called with (stage, fraction done of it)."""


@dataclass(frozen=True)
class VoxelFit:
    """Options of `fit_voxels`.

    coarse_steps: evaluations of the wave model and its gradient with one voxel a pixel; steps: those that follow on the
    finest voxels; weight: of total variation, in voxel edges of thickness; noise_weight: what it grows by for every
    pixel of thickness that the noise of the frames amounts to; smoothing: differences between voxels below which total
    variation is a square; floor: see `WaveMisfit`; upper: bound of the occupancy of a single material (0: none);
    refine: voxels along a pixel's edge (0: as the first fringe needs); max_voxels: coarser voxels rather than more than
    this many.
    """

    coarse_steps: int = 0
    steps: int = 60
    weight: float = 0.05
    noise_weight: float = 0.03
    smoothing: float = 0.005
    floor: float = 0.1
    upper: float = 1.0
    refine: int = 0
    max_voxels: int = 20_000_000

    def __post_init__(self) -> None:
        at_least(self, 0, "coarse_steps", "weight", "noise_weight", "upper", "refine")
        at_least(self, 1, "steps", "max_voxels")
        require(self.smoothing > 0, f"smoothing must be positive, but it is {self.smoothing}.")
        require(self.floor > 0, f"floor must be positive, but it is {self.floor}.")


def fit_voxels(scan: Scan, start: VoxelGrid, options: VoxelFit, on_progress: Progress) -> VoxelGrid:
    """The non-negative voxels that explain the training frames of `scan`, from `start` on.

    They have the channels and materials of `start`, on the field of view at the resolution of `options`.
    `on_progress(stage, fraction)`.
    """
    train, found = scan.train(), start
    with memory_kept():
        for stage, refine, steps in (
            (COARSE, 1, options.coarse_steps),
            (FINE, _refinement(train, options), options.steps),
        ):
            if steps > 0:
                found = _fitted(train, found, refine, steps, options, _reporter(on_progress, stage))
    return found


def _fitted(
    train: Scan, start: VoxelGrid, refine: int, steps: int, options: VoxelFit, on_progress: Callable[[float], None]
) -> VoxelGrid:
    """Voxels, k = `refine` a pixel, that minimise `k² Σ misfit + λ Σ |∇u|`, with the misfit of `WaveMisfit`."""
    misfit = WaveMisfit(train, start.delta, start.beta, options.floor, refine)
    lines = VoxelLines(Grid.of_views(train.views, refine), misfit.instrument.views)
    weight = options.weight + options.noise_weight * misfit.noise
    scale = torch.tensor([1.0, ABSORPTION_REACH][: len(start.values)])[:, None, None, None]

    def evaluate(point: Tensor) -> tuple[float, Tensor]:
        values = (point * scale).requires_grad_()
        data = misfit(LineIntegrals(lines(values), start.materials)).sum()
        variation = total_variation(values, options.smoothing, "cpu") * values.numel()
        loss = refine**2 * data + weight * variation
        loss.backward()
        assert values.grad is not None
        return loss.item(), values.grad * scale

    upper = options.upper if options.upper and start.single_material else float("inf")
    first = start.resampled(lines.grid).values.detach().float() / scale
    found = spectral_projected_gradient(evaluate, first, upper, steps, on_progress)
    return VoxelGrid(found * scale, lines.grid, start.delta, start.beta)


def _reporter(on_progress: Progress, stage: str) -> Callable[[float], None]:
    return lambda done: on_progress(stage, done)


def _refinement(train: Scan, options: VoxelFit) -> int:
    """Voxels along a pixel's edge."""
    height, width = train.views.shape
    refine = options.refine or resolving_oversample(train.exposures, FEWEST_SAMPLES, at_least=1)
    while refine > 1 and height * width**2 * refine**3 > options.max_voxels:
        refine -= 1
    return refine
