"""How much matter there is in all, and how well frames know it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..baselines.beyond import rows_beyond
from ..baselines.tomography import plateau
from ..checks import require
from ..fit.smooth_volume import ContinuousPrior, VolumeProblem
from ..fit.whitened import WhitenedFrames
from ..geometry import Grid
from ..matter import DeltaBeta
from ..optics.noise_model import NoiseModel
from ..representations import Stored
from ..scan import Scan
from ..volume import Object
from .modulation import Ranges, best

MODEL_SHARE = 0.03
"""Standard error of the total, as a share of it, beside that of the noise: of voxels, waves and shapes. Totals of runs
without noise (`benchmarks/mass.py`, seeds 1 and 2) were off by 0.02 (rms), by 0.03 at most."""
SHAPES = 1.5
"""Factor of the noise's standard error for shapes that noise has blurred, which it takes for known. Totals of 28 runs
in noise (the same seeds, material or ratio known) were off by 1.5 times their standard error (rms) without it."""
RATIO_SHARE = 0.4
"""Standard error, as a share of the total, where the ratio δ/β was estimated: such totals (18 runs, the same seeds)
were off by 0.4 (rms), some by a factor of two, for as good is the estimate of the ratio."""
DOUBTFUL = 0.1
"""Standard error of the ratio δ/β, as a share, from which on absorption says little of the total."""


@dataclass(frozen=True)
class Total:
    """`∫ δ dV` of the matter that frames show against its medium, below zero for holes in it. value, error: it and its
    standard error [m³]; held: what the volume of the reconstruction has of it [m³]."""

    value: float
    error: float
    held: float

    @property
    def share(self) -> float:
        """The standard error as a share of the value's size; infinite where it has not the sign of the volume."""
        return self.error / abs(self.value) if self.value * self.held > 0 else math.inf


def total_delta(
    found: Stored, train: Scan, noise: NoiseModel, predicted: Tensor | None = None, ratio_doubt: float = 0.0
) -> Total:
    """`∫ δ dV` of a reconstruction `found`, by the frames `train` that it was fitted to.

    Its volume may be off by its `modulations` (all matter, its sides, dense against faint, a halo). Their least squares
    in the whitened frames say by how much, and the inverse of their normal equations how surely: `M + mᵀ c` and
    `√(mᵀ (JᵀP⁻¹J + S⁻²)⁻¹ m)`, m the masses of the modulations; where frames are not explained, the error grows by the
    root of χ² over the number of coefficients (Birge 1932). This is done in ranges of frequencies, and the total is
    that of the best one (`methods.modulation`).

    The total is that of the field of view; matter that goes on above and below it is seen, and not counted. Of holes in
    a medium it is below zero: what the medium lacks.

    predicted: frames [V, H, W] of `found` by its own model; None where voxels of a pixel say the same. ratio_doubt:
    standard error of δ/β as a share, which joins that of the total; from `DOUBTFUL` on, low frequencies, which see the
    total by its absorption, are no better than the others, and all are taken at once. The error is that of the
    `noise`, of shapes (`SHAPES`) and of the model
    (`MODEL_SHARE`); it does not know of a wrong distance or energy. Errors: `InputError` for a volume without matter.
    """
    there, grid = found.at(float(train.exposures.time[0])), Grid.of_views(train.views)
    sign = found.matter.channels[0].sign
    delta, beta = _indices(there, grid, sign)
    whole = float(delta.double().clamp_min(0).sum())
    require(whole > 0, "the total δ of a volume without matter has no standard error; look at its frames first.")
    level = plateau(delta.clamp_min(0))
    unit = level * math.prod(grid.voxel_size)
    material = DeltaBeta(sign * level, sign * level * float(beta.double().sum()) / whole)
    backend = found.backend
    beyond = rows_beyond(delta.clamp_min(0), train, material.beta / material.delta)
    taller = _indices(there, Grid.of_views(train.views.taller(beyond)), sign)[0] if beyond else delta
    frames = WhitenedFrames(train, material, noise, backend=backend, beyond=(beyond, 0))
    problem = VolumeProblem(frames, ContinuousPrior(), 1.0, backend)
    ranges = Ranges(problem, predicted)
    limits = ranges.limits if ratio_doubt < DOUBTFUL else ranges.limits[-1:]
    told = best(ranges.by_range((taller.clamp_min(0) / level).to(problem.device), limits))
    doubts = MODEL_SHARE**2 + ratio_doubt**2
    error = math.sqrt(SHAPES**2 * told.variance + doubts * told.value**2)
    held = float(delta.double().sum()) * math.prod(grid.voxel_size)
    return Total(sign * told.value * unit, error * unit, sign * held)


def _indices(found: Object, grid: Grid, sign: float) -> tuple[Tensor, Tensor]:
    """δ and β [Z, Y, X] on `grid`, times the `sign` of the matter's δ."""
    volume = found.voxelise(grid)
    return sign * torch.as_tensor(volume.delta).float(), sign * torch.as_tensor(volume.beta).float()
