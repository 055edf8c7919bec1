"""How much matter there is in all, and how well frames know it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..baselines.beyond import rows_beyond
from ..baselines.material import plateau
from ..checks import require
from ..fit.smooth_volume import ContinuousPrior, VolumeProblem, modulations
from ..fit.whitened import WhitenedFrames
from ..geometry import Grid
from ..matter import DeltaBeta
from ..optics.noise_model import NoiseModel
from ..representations import Stored
from ..scan import Scan
from ..volume import Object

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
SPREAD = 1.0
"""Standard deviation expected of each share by which a volume is modulated: a fit in noise may have lost most of it."""
WAVES = 4
"""Periods along the longer side of a frame that the narrowest range of frequencies has at least."""
UPDATES = 2
"""Gauss–Newton steps in a range of frequencies, the last of which gives the total."""


@dataclass(frozen=True)
class Total:
    """`∫ δ dV` of the matter that frames show. value, error: it and its standard error [m³]; held: what the volume of
    the reconstruction has of it [m³]."""

    value: float
    error: float
    held: float

    @property
    def share(self) -> float:
        """The standard error as a share of the value; infinite where the value is not above zero."""
        return self.error / self.value if self.value > 0 else math.inf


def total_delta(
    found: Stored, train: Scan, noise: NoiseModel, predicted: Tensor | None = None, ratio_doubt: float = 0.0
) -> Total:
    """`∫ δ dV` of a reconstruction `found`, by the frames `train` that it was fitted to.

    Its volume may be off by its `modulations` (all matter, its sides, dense against faint, a halo). Their least squares
    in the whitened frames say by how much, and the inverse of their normal equations how surely: `M + mᵀ c` and
    `√(mᵀ (JᵀP⁻¹J + S⁻²)⁻¹ m)`, m the masses of the modulations; where frames are not explained, the error grows by the
    root of χ² over the number of coefficients (Birge 1932). High frequencies are many, and biased by shapes that noise
    has blurred; low ones are few, and see the total alone. So this is done in ranges of frequencies that widen by
    octaves, each from where the one before has led, and the total is that of the range with the least variance and
    squared bias, which is how much it differs from narrower ones beyond their errors (Goldenshluger & Lepski 2011).

    The total is that of the field of view; matter that goes on above and below it is seen, and not counted.

    predicted: frames [V, H, W] of `found` by its own model; None where voxels of a pixel say the same. ratio_doubt:
    standard error of δ/β as a share, which joins that of the total; from `DOUBTFUL` on, low frequencies, which see the
    total by its absorption, are no better than the others, and all are taken at once. The error is that of the
    `noise`, of shapes (`SHAPES`) and of the model
    (`MODEL_SHARE`); it does not know of a wrong distance or energy. Errors: `InputError` for a volume without matter.
    """
    there, grid = found.at(float(train.exposures.time[0])), Grid.of_views(train.views)
    delta, beta = _indices(there, grid)
    whole = float(delta.double().clamp_min(0).sum())
    require(whole > 0, "the total δ of a volume without matter has no standard error; look at its frames first.")
    level = plateau(delta.clamp_min(0))
    unit = level * math.prod(grid.voxel_size)
    material = DeltaBeta(level, level * float(beta.double().sum()) / whole)
    backend = "reference" if found.backend == "reference" else "cpu"
    beyond = rows_beyond(delta.clamp_min(0), train, material.beta / material.delta)
    taller = _indices(there, Grid.of_views(train.views.taller(beyond)))[0] if beyond else delta
    frames = WhitenedFrames(train, material, noise, backend=backend, beyond=beyond)
    ranges = _Ranges(frames, predicted, backend)
    limits = ranges.limits if ratio_doubt < DOUBTFUL else ranges.limits[-1:]
    value, variance = _best(_by_range(ranges, limits, taller.clamp_min(0) / level))
    doubts = MODEL_SHARE**2 + ratio_doubt**2
    error = math.sqrt(SHAPES**2 * variance + doubts * value**2)
    return Total(value * unit, error * unit, float(delta.double().sum()) * math.prod(grid.voxel_size))


def _indices(found: Object, grid: Grid) -> tuple[Tensor, Tensor]:
    """δ and β [Z, Y, X] on `grid`."""
    volume = found.voxelise(grid)
    return torch.as_tensor(volume.delta).float(), torch.as_tensor(volume.beta).float()


class _Ranges:
    """Misfits of frames in ranges of spatial frequencies; predicted: [V, H, W] at the first volume."""

    def __init__(self, frames: WhitenedFrames, predicted: Tensor | None, backend: str) -> None:
        self.frames, self.problem = frames, VolumeProblem(frames, ContinuousPrior(), 1.0, backend)
        self._predicted, self._offset = predicted, torch.zeros(())
        (h, w), longest = frames.shape, max(frames.shape)
        self.radius = torch.hypot(torch.fft.fftfreq(h)[:, None], torch.fft.rfftfreq(w))
        octaves = max(0, int(math.log2(0.5 * longest / WAVES)))
        self.limits = [*(0.5 / 2**k for k in range(octaves, 0, -1)), 1.0]
        """Highest frequencies [cycles per pixel], the narrowest range first."""
        self._twice = torch.full((w // 2 + 1,), 2.0)
        self._twice[0] = 1
        if w % 2 == 0:
            self._twice[-1] = 1

    def total(self, u: Tensor, limit: float) -> tuple[float, float, Tensor]:
        """Total [voxels] and its variance by frequencies up to `limit`, and u with what they ask for."""
        changes, problem = modulations(u, plateau(u)), self.problem
        lines = problem.lines(u)
        slopes = self.frames.slopes(lines, [problem.lines(change) for change in changes])
        weight = (self.radius <= limit) * self._twice / self.frames.power
        spectra = torch.fft.rfft2(torch.stack(slopes), norm="ortho")
        left = torch.fft.rfft2(self._left(lines), norm="ortho")
        weighted = (spectra * weight).flatten(1)
        matrix = (weighted @ spectra.flatten(1).conj().T).real.double()
        right = (weighted @ left.flatten().conj()).real.double()
        covariance = torch.linalg.inv(matrix + torch.eye(len(right), dtype=right.dtype) / SPREAD**2)
        shares = covariance @ right
        count = float(((self.radius <= limit) * self._twice).sum()) * len(left)
        chi2 = (float((weight * left.abs().square()).double().sum()) - float(right @ shares)) / count
        masses = torch.stack([self._inside(change) for change in changes])
        moved = u + torch.einsum("k,kzyx->zyx", shares.float(), torch.stack(changes))
        value, variance = float(self._inside(u) + masses @ shares), float(masses @ covariance @ masses)
        return value, variance * max(1.0, chi2), moved.clamp_min(0)

    def _inside(self, u: Tensor) -> Tensor:
        """The sum of a volume in the field of view."""
        beyond = self.frames.beyond
        return u[:, beyond : u.shape[1] - beyond].double().sum()

    def _left(self, lines: Tensor) -> Tensor:
        """What is left of measured amplitudes."""
        now = self.frames.amplitudes(lines)
        if self._predicted is not None:
            self._offset, self._predicted = self._predicted.clamp_min(0).sqrt().to(now) - now, None
        return self.frames.measured - now - self._offset


def _by_range(ranges: _Ranges, limits: list[float], u: Tensor) -> list[tuple[float, float]]:
    """Totals and their variances, the narrowest range first."""
    found = list[tuple[float, float]]()
    with torch.no_grad():
        for limit in limits:
            for _ in range(UPDATES - 1):
                moved = ranges.total(u, limit)[2]
                u = moved if bool((moved > 0).any()) else u
            found.append(ranges.total(u, limit)[:2])
    return found


def _best(found: list[tuple[float, float]]) -> tuple[float, float]:
    """The total with the least variance and squared bias, and these."""

    def doubt(i: int) -> float:
        value, variance = found[i]
        return variance + max([0.0, *((value - narrow) ** 2 - own for narrow, own in found[:i])])

    best = min(range(len(found)), key=doubt)
    return found[best][0], doubt(best)
