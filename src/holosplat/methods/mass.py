"""How much matter there is in all, and how well frames know it."""

from __future__ import annotations

import math

import torch

from ..baselines.material import plateau
from ..checks import require
from ..fit.smooth_volume import ContinuousPrior, VolumeProblem, modulations, shares_of
from ..fit.whitened import WhitenedFrames
from ..geometry import Grid
from ..matter import DeltaBeta
from ..model import LightField, Model
from ..optics.noise_model import NoiseModel
from ..scan import Scan

MODEL_SHARE = 0.03
"""Standard error of the total, as a share of it, beside that of the noise: of voxels, prior and convergence. Totals of
nine fits of cells and tissue (64², 12 views, noise of 0.4 to 0.8 of the contrast) were off by 0.034 (rms)."""


def total_delta(model: Model, train: Scan, noise: NoiseModel) -> tuple[float, float]:
    """`∫ δ dV` [m³] of a reconstruction and its standard error, by the frames that it was fitted to.

    The volume of `model.object` may be off by its `modulations` (all matter, its sides, dense against faint, a halo).
    Their least squares in the whitened frames of `train` say by how much, and the inverse of their normal equations how
    surely: `M + mᵀ c` and `√(mᵀ (JᵀP⁻¹J + S⁻²)⁻¹ m)`, with the masses m of the modulations. The error is that of the
    `noise` and of voxels (`MODEL_SHARE`); it does not know of a wrong distance, energy or ratio δ/β. Errors:
    `InputError` for a volume without matter.
    """
    grid = Grid.of_views(train.views)
    volume = model.object.at(float(train.exposures.time[0])).voxelise(grid)
    delta, beta = (torch.as_tensor(values).float() for values in (volume.delta, volume.beta))
    whole = float(delta.double().clamp_min(0).sum())
    require(whole > 0, "the total δ of a volume without matter has no standard error; look at its frames first.")
    level = plateau(delta.clamp_min(0))
    material = DeltaBeta(level, level * float(beta.double().sum()) / whole)
    u = delta.clamp_min(0) / level
    light = model.light if isinstance(model.light, LightField) else None  # solved light is divided out of the frames
    problem = VolumeProblem(WhitenedFrames(train, material, noise, light), ContinuousPrior(), 1.0)
    changes = modulations(u, 1.0)
    shares, covariance = shares_of(problem, u, changes)
    masses = torch.stack([change.double().sum() for change in changes])
    total = float(u.double().sum() + masses @ shares)
    unit = level * math.prod(grid.voxel_size)
    variance = float(masses @ covariance @ masses) + (MODEL_SHARE * total) ** 2
    return total * unit, math.sqrt(variance) * unit
