"""What a prior takes from a volume, given back: a few changes of all of it, by least squares of its frames. By the same
changes, how much matter there is in all, and how well frames know it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d, avg_pool3d, interpolate

from ..baselines.beyond import rows_beyond
from ..baselines.tomography import plateau
from ..checks import require
from ..fit.smooth_volume import ContinuousPrior, VolumeProblem
from ..fit.whitened import WhitenedFrames
from ..frames import rfft_weights
from ..geometry import Grid
from ..matter import DeltaBeta
from ..optics.noise import NoiseModel
from ..representations import Stored
from ..scan import Scan
from ..volume import Volume

SPREAD = 0.5
"""Standard deviation expected of each of the shares by which a volume is modulated between two descents."""
LOST = 1.0
"""The same where a total is told by ranges of frequencies: a fit in noise may have lost most of its matter."""
HALVINGS = 4
"""How often a modulation is halved at most until it lowers the misfit."""
WAVES = 4
"""Periods along the longer side of a frame that the narrowest range of frequencies has at least."""
RISE = 1.2
"""How much of its range's misfit a volume may gain by what its total asks for: matter cannot be negative, and thick
matter bends waves, so that it rose by up to 16 % in noisy trials in which the volume came nearer to the truth."""
RUIN = 1.4
"""The same of the misfit of all frequencies. It rose by up to 13 % where the volume came nearer to the truth, and 300
times in two rows of a tooth, of which the narrow ranges say next to nothing."""
UPDATES = 2
"""Gauss–Newton steps in a range of frequencies, the last of which gives the total."""


def modulations(u: Tensor, level: float) -> list[Tensor]:
    """Changes [Z, Y, X] that noise hides and a prior distorts: of all matter, of a side of it, of dense against faint
    matter, and of a halo about it."""
    sides = [u]
    for axis in range(3):
        n = u.shape[axis]
        wave = torch.cos(math.pi * (torch.arange(n, device=u.device) + 0.5) / n)
        sides.append(u * wave.reshape([-1 if a == axis else 1 for a in range(3)]))
    return [*sides, u * (u.abs() / level - 1), _halo(u, 8), _halo(u, 4)]


def _halo(u: Tensor, parts: int) -> Tensor:
    """u as a volume of about `parts` cells along its longest edge shows it."""
    edge = max(1, max(u.shape) // parts)
    z, y, x = (max(1, round(n / edge)) for n in u.shape)
    coarse = adaptive_avg_pool3d(u[None, None], (z, y, x))
    coarse = avg_pool3d(coarse, 3, stride=1, padding=1, count_include_pad=False) if min(z, y, x) > 2 else coarse
    fine = coarse[0, 0]
    for n, few in zip(u.shape, fine.shape):  # some five times as fast as torch's trilinear interpolation
        between = interpolate(torch.eye(few, device=u.device)[None], size=n, mode="linear", align_corners=False)[0]
        fine = torch.tensordot(fine, between, dims=([0], [0]))  # type: ignore[arg-type]
    return fine


def shares_of(problem: VolumeProblem, u: Tensor, changes: list[Tensor]) -> tuple[Tensor, Tensor]:
    """The shares [K] of K changes that the frames of a volume u ask for, and their covariance [K, K], float64."""
    matrix, right = problem.frames.normal_equations(problem.lines(u), [problem.lines(change) for change in changes])
    covariance = torch.linalg.inv(matrix + torch.eye(len(right)).to(right) / SPREAD**2)
    return covariance @ right, covariance


def modulated(problem: VolumeProblem, u: Tensor) -> Tensor:
    """u with the `modulations` that its frames ask for: least squares of their misfit, without the prior.

    A prior takes a share of all matter, and from what is faint most; of these few numbers the frames know enough. Each
    is expected to be within `SPREAD`. The change is halved until the misfit falls, or left out.
    """
    changes = modulations(u, problem.level)
    lines = problem.lines(u)
    shares, _ = shares_of(problem, u, changes)
    change = torch.stack([float(s) * c for s, c in zip(shares, changes)]).sum(dim=0)
    before = problem.frames(lines).value
    for _ in range(HALVINGS):
        moved = (u + change).clamp_min(problem.lower)
        if problem.frames(problem.lines(moved)).value < before:
            return moved
        change = change / 2
    return u


class Told(NamedTuple):
    """What a range of frequencies says. value, variance: of the total [voxels] in the field of view; moved: the volume
    with what they ask for; limit: the highest frequency [cycles per pixel]."""

    value: float
    variance: float
    moved: Tensor
    limit: float


class Linear(NamedTuple):
    """Frames about a volume. u, changes: it and its K modulations [Z, Y, X]; spectra, left: of what these change of the
    amplitudes [K, V, H, W//2 + 1], and of what u leaves of the measured ones; masses: of u and the changes [1 + K]."""

    u: Tensor
    changes: list[Tensor]
    spectra: Tensor
    left: Tensor
    masses: Tensor


class Ranges:
    """Misfits of frames in ranges of spatial frequencies that widen by octaves.

    High frequencies are many, and biased by shapes that noise or a prior has blurred; low ones are few, and see the
    total alone.

    predicted: frames [V, H, W] of the first volume by its own model; None where its voxels say the same.
    limits: highest frequencies [cycles per pixel], the narrowest range first.
    """

    def __init__(self, problem: VolumeProblem, predicted: Tensor | None = None) -> None:
        self.problem, self.frames = problem, problem.frames
        on = problem.device
        self._predicted, self._offset = predicted, torch.zeros((), device=on)
        (h, w), longest = self.frames.shape, max(self.frames.shape)
        self.radius = torch.hypot(torch.fft.fftfreq(h)[:, None], torch.fft.rfftfreq(w)).to(on)
        octaves = max(0, int(math.log2(0.5 * longest / WAVES)))
        self.limits = [*(0.5 / 2**k for k in range(octaves, 0, -1)), 1.0]
        self._twice = torch.from_numpy(rfft_weights(w)).float().to(on)

    def by_range(self, u: Tensor, limits: list[float]) -> list[Told]:
        """What each range says of a volume u, each from where the narrower one before it has led."""
        found = list[Told]()
        with torch.no_grad():
            about = self.about(u)
            for limit in limits:
                for _ in range(UPDATES - 1):
                    moved = self.told(about, limit).moved
                    about = self.about(moved) if bool((moved > 0).any()) else about
                found.append(self.told(about, limit))
        return found

    def about(self, u: Tensor) -> Linear:
        """The frames about a volume u, for all ranges."""
        changes, problem = modulations(u, self.problem.level), self.problem
        lines = problem.lines(u)
        now = self.frames.amplitudes(lines)
        slopes = self.frames.slopes(lines, [problem.lines(change) for change in changes], now)
        spectra, left = (torch.fft.rfft2(x, norm="ortho") for x in (torch.stack(slopes), self._left(now)))
        return Linear(u, changes, spectra, left, torch.stack([self._inside(each) for each in (u, *changes)]))

    def told(self, about: Linear, limit: float) -> Told:
        """Least squares by frequencies up to `limit`."""
        u, changes, spectra, left, (whole, *parts) = about
        weight, masses = self._weight(limit), torch.stack(parts)
        weighted = (spectra * weight).flatten(1)
        matrix = (weighted @ spectra.flatten(1).conj().T).real.double()
        right = (weighted @ left.flatten().conj()).real.double()
        covariance = torch.linalg.inv(matrix + torch.eye(len(right)).to(right) / LOST**2)
        shares = covariance @ right
        count = float(((self.radius <= limit) * self._twice).sum()) * len(left)
        chi2 = (float((weight * left.abs().square()).double().sum()) - float(right @ shares)) / count
        moved = u.clone()
        for share, change in zip(shares.tolist(), changes):
            moved.add_(change, alpha=share)
        value, variance = float(whole + masses @ shares), float(masses @ covariance @ masses)
        return Told(value, variance * max(1.0, chi2), moved.clamp_min_(self.problem.lower), limit)

    def misfit(self, u: Tensor, limit: float) -> float:
        """χ² of u by frequencies up to `limit`."""
        with torch.no_grad():
            left = torch.fft.rfft2(self._left(self.frames.amplitudes(self.problem.lines(u))), norm="ortho")
        return float((self._weight(limit) * left.abs().square()).double().sum())

    def _weight(self, limit: float) -> Tensor:
        return (self.radius <= limit) * self._twice / self.frames.power

    def _inside(self, u: Tensor) -> Tensor:
        """The sum of a volume in the field of view."""
        rows, columns = (slice(n, -n or None) for n in self.frames.beyond)
        return u[columns, rows, columns].double().sum()

    def _left(self, now: Tensor) -> Tensor:
        """What amplitudes `now` leave of the measured ones."""
        if self._predicted is not None:
            self._offset, self._predicted = self._predicted.clamp_min(0).sqrt().to(now) - now, None
        return self.frames.known(self.frames.measured - now - self._offset)


def best(found: list[Told]) -> Told:
    """The range with the least variance and squared bias of its total, which is how much it differs from narrower ones
    beyond their errors (Goldenshluger & Lepski 2011); its variance has the squared bias in it."""

    def doubt(i: int) -> float:
        value, variance = found[i].value, found[i].variance
        return variance + max([0.0, *((value - each.value) ** 2 - each.variance for each in found[:i])])

    chosen = min(range(len(found)), key=doubt)
    return found[chosen]._replace(variance=doubt(chosen))


def unshrunk(problem: VolumeProblem, u: Tensor, uneven: bool = False) -> Tensor:
    """u with the `modulations` that the frequencies ask for which know its total best (`best`).

    A prior makes matter in noise too faint and its edges wrong. Least squares of all frequencies (`modulated`) then
    answer to the edges, and miss the total. uneven: whether the light is; the narrowest range, where light and matter
    look alike, is left out then. Where the misfit of its range is more than `RISE` times what it was, or that of all
    more than `RUIN` times, all frequencies are taken.
    """
    ranges = Ranges(problem)
    told = best(ranges.by_range(u, ranges.limits[1:] if uneven and len(ranges.limits) > 1 else ranges.limits))
    allowed = {ranges.limits[-1]: RUIN} | {told.limit: RISE}
    fits = all(ranges.misfit(told.moved, limit) <= rise * ranges.misfit(u, limit) for limit, rise in allowed.items())
    return told.moved if fits and bool((told.moved > 0).any()) else modulated(problem, u)


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
    found: Stored,
    train: Scan,
    noise: NoiseModel,
    predicted: Tensor | None = None,
    ratio_doubt: float = 0.0,
    volume: Volume | None = None,
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
    total by its absorption, are no better than the others, and all are taken at once. volume: `found` on voxels of a
    pixel; None to make it. The error is that of the `noise`, of shapes (`SHAPES`) and of the model (`MODEL_SHARE`); it
    does not know of a wrong distance or energy. Errors: `InputError` for a volume without matter.
    """
    there, grid = found.at(float(train.exposures.time[0])), Grid.of_views(train.views)
    sign = found.matter.channels[0].sign
    delta, beta = _indices(there.voxelise(grid) if volume is None else volume, sign)
    whole = float(delta.double().clamp_min(0).sum())
    require(whole > 0, "the total δ of a volume without matter has no standard error; look at its frames first.")
    level = plateau(delta.clamp_min(0))
    unit = level * math.prod(grid.voxel_size)
    material = DeltaBeta(sign * level, sign * level * float(beta.double().sum()) / whole)
    backend = found.backend
    beyond = rows_beyond(delta.clamp_min(0), train, material.beta / material.delta)
    taller = _indices(there.voxelise(Grid.of_views(train.views.taller(beyond))), sign)[0] if beyond else delta
    frames = WhitenedFrames(train, material, noise, backend=backend, beyond=(beyond, 0))
    problem = VolumeProblem(frames, ContinuousPrior(), 1.0, backend)
    ranges = Ranges(problem, predicted)
    limits = ranges.limits if ratio_doubt < DOUBTFUL else ranges.limits[-1:]
    told = best(ranges.by_range((taller.clamp_min(0) / level).to(problem.device), limits))
    doubts = MODEL_SHARE**2 + ratio_doubt**2
    error = math.sqrt(SHAPES**2 * told.variance + doubts * told.value**2)
    held = float(delta.double().sum()) * math.prod(grid.voxel_size)
    return Total(sign * told.value * unit, error * unit, sign * held)


def _indices(volume: Volume, sign: float) -> tuple[Tensor, Tensor]:
    """δ and β [Z, Y, X], times the `sign` of the matter's δ."""
    return sign * torch.as_tensor(volume.delta).float(), sign * torch.as_tensor(volume.beta).float()
