"""Several materials in one scan: whether there are two, where each is, and what it absorbs.

Phase retrieval of single views needs one ratio δ/β for all matter. Where there are two, it leaves halos and levels
that are wrong by tens of per cent. But its volume tells the two apart by their δ, and frames blurred beyond their
fringes then tell their β, for two numbers are all that is asked of all frames. With both, the frames are turned into
those that the same matter would give at one ratio (`at_one_ratio`), which single-view retrieval inverts without that
error.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter, gaussian_gradient_magnitude
from torch import Tensor
from torch.nn.functional import avg_pool3d

from ..backends import Backend
from ..geometry import Grid
from ..matter import LEAST_CONTRAST, DeltaBeta
from ..model import Instrument
from ..optics.sampling import fringe_sampling
from ..projectors.voxels import voxel_line_integrals
from ..ranges import Natural, Pixels, Share, Weight, checked_dataclass
from ..representations.voxels import VoxelLines
from ..scan import Scan
from ..units import wavelength
from ..volume import LineIntegrals
from .tomography import plateau

STEP, ITERATIONS = 1e-10, 5
"""Of the linearisation in β."""


@checked_dataclass
class TwoMaterials:
    """How two materials are told apart."""

    rounds: Natural = 2
    """Rounds in which the frames are turned into those of one ratio; with more, the materials drift."""
    faint: Share = 0.3
    """Below this share of the level that most matter has, there are halos rather than matter."""
    largest_spread: Weight = 0.4
    """Share of the spread that two levels leave, at most, where there are two (`benchmarks/two_levels.py`)."""
    least_share: Share = 0.1
    """Share of all matter that the lighter material must have where it is more than a layer of partly filled voxels."""
    largest_deviation: Weight = 0.3
    """Mean deviation of δ from its level where the lighter material is: below 0.2 for one, more on blurred rims."""
    sliver: Share = 0.05
    """Occupancies below this are noise."""
    blur: Pixels = 1.5
    """Standard deviation of the blur of frames in which absorption is looked for, in widths √(λz) of a fringe."""


DEFAULT = TwoMaterials()


@dataclass(frozen=True)
class Shares:
    """Occupancies of materials on a grid: values [C, Z, Y, X] float32, materials: (δ, β) of each, densest first."""

    values: Tensor
    grid: Grid
    materials: tuple[DeltaBeta, ...]


@dataclass(frozen=True)
class Levels:
    """The two values of δ that split a volume best, and how well they do.

    spread: mean distance from the nearer of the two, over that from the median; share: of all matter that the lighter
    one has where it is more than a rim of the denser; deviation: mean of |δ/low - 1| there.
    """

    high: float
    low: float
    spread: float
    share: float
    deviation: float

    def are_two(self, options: TwoMaterials = DEFAULT) -> bool:
        """Whether these are two materials: far apart, near to all values, the lower one more than rims and level."""
        apart = self.high >= LEAST_CONTRAST * self.low and self.spread <= options.largest_spread
        return apart and self.share > options.least_share and self.deviation < options.largest_deviation


def two_levels(delta: Tensor, pixel: int, options: TwoMaterials = DEFAULT) -> tuple[float, float] | None:
    """The two values (higher, lower) that δ takes in a volume [Z, Y, X], or None if it takes but one (`Levels`).

    pixel: voxels along a pixel's edge.
    """
    found = best_levels(delta, pixel, options)
    return (found.high, found.low) if found.are_two(options) else None


def best_levels(delta: Tensor, pixel: int, options: TwoMaterials = DEFAULT) -> Levels:
    """The split of voxels where δ changes little that leaves each nearest to its group's median (k-medians).

    Arguments as for `two_levels`.
    """
    coarse = avg_pool3d(delta[None, None], pixel)[0, 0]
    values = coarse.numpy()
    matter = values > options.faint * plateau(coarse)
    slope = gaussian_gradient_magnitude(values, 1.0)
    flat = values[matter & (slope <= np.median(slope[matter]))]
    high, low = _two_medians(flat)
    nearer = np.minimum(np.abs(flat - high), np.abs(flat - low)).mean()
    spread = np.abs(flat - np.median(flat)).mean()
    denser, lighter = told_apart(coarse, (high, low), 1, options)
    share = float(lighter.sum() / (denser.sum() + lighter.sum()))
    deviation = float(np.abs(values[lighter.numpy() > 0] / low - 1).mean()) if share else np.inf
    return Levels(high, low, float(nearer / max(spread, np.finfo(np.float32).tiny)), share, deviation)


def _two_medians(values: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(values, [0.25, 0.75])
    for _ in range(50):
        upper = values > 0.5 * (low + high)
        if upper.all() or not upper.any():
            break
        before, (low, high) = (low, high), (np.median(values[~upper]), np.median(values[upper]))
        if before == (low, high):
            break
    return float(high), float(low)


def told_apart(delta: Tensor, levels: Sequence[float], pixel: int, options: TwoMaterials = DEFAULT) -> Tensor:
    """Occupancies [C, Z, Y, X] of the materials of δ `levels`, the largest first, in a volume [Z, Y, X] of δ.

    Voxels nearest to a smaller level are full of its material, unless they are part of a layer thinner than about two
    pixels: between the densest one and nothing every value occurs. All others hold the densest one in part. Levels on
    either side of zero are told apart by themselves.
    """
    found = delta.new_zeros(len(levels), *delta.shape)
    for side in (1, -1):
        own = [k for k, level in enumerate(levels) if side * level > 0]
        if own:
            found[own] = _told_apart(side * delta, [side * levels[k] for k in own], pixel, options)
    return found


def _told_apart(delta: Tensor, levels: Sequence[float], pixel: int, options: TwoMaterials) -> Tensor:
    """The same of positive levels."""
    values = delta.numpy()
    edges = [0.5 * (level + below) for level, below in zip(levels, [*levels[1:], 0.0])]
    between = ((values > low) & (values <= high) for high, low in pairwise(edges))
    lighter = [binary_dilation(eroded(inside, pixel), iterations=pixel) for inside in between]
    densest = np.where(np.any(lighter, axis=0), 0, np.clip(values / levels[0], 0, 1))
    densest[densest < options.sliver] = 0
    return torch.from_numpy(np.stack([densest, *lighter]).astype(np.float32))


def eroded(inside: np.ndarray, steps: int) -> np.ndarray:
    """`inside` [Z, Y, X] bool without its voxels that are `steps` or fewer from outside; matter goes on beyond the
    volume, so that a volume of few rows has an inside, too."""
    return np.asarray(binary_erosion(inside, iterations=steps, border_value=1), dtype=bool)


def absorption(
    scan: Scan,
    values: Tensor,
    grid: Grid,
    deltas: Sequence[float],
    backend: Backend = "auto",
    options: TwoMaterials = DEFAULT,
) -> list[float]:
    """β, none of another sign than δ, of the materials of δ `deltas` with occupancies `values` [C, Z, Y, X] on `grid`.

    Those whose frames, blurred until no fringe is left, come nearest to the blurred frames of `scan` (least squares,
    linearised a few times): refraction moves light about, only absorption takes it away.
    """
    from scipy.optimize import nnls  # which takes long to load

    instrument, lines = _lines(scan, values, grid, backend)
    optics = scan.exposures.optical
    fringe = np.sqrt((wavelength(optics.energy_kev) * optics.distance).max()) / optics.views.pixel_size
    sigma = options.blur * fringe

    def blurred(frames: Tensor) -> np.ndarray:
        return gaussian_filter(frames.cpu().numpy().astype(np.float64), (0, sigma, sigma)).ravel()

    measured = blurred(torch.from_numpy(scan.frames))
    betas, step = np.zeros(len(deltas)), math.copysign(STEP, deltas[0])
    for _ in range(ITERATIONS):
        now = blurred(_frames(instrument, lines, zip(deltas, betas)))
        varied = (betas + step * unit for unit in np.eye(len(betas)))
        slopes = np.stack([blurred(_frames(instrument, lines, zip(deltas, b))) - now for b in varied], axis=1)
        betas = step * nnls(slopes, measured - now + slopes @ (betas / step))[0]
    return [float(beta) for beta in betas]


def at_one_ratio(scan: Scan, shares: Shares, ratio: float, backend: Backend = "auto") -> Scan:
    """The scan as if all materials had the ratio δ/β `ratio`, by what the wave optics says of `shares`."""
    instrument, lines = _lines(scan, shares.values, shares.grid, backend)
    same = [(delta, delta / ratio) for delta, _ in shares.materials]
    change = _frames(instrument, lines, same) / _frames(instrument, lines, shares.materials).clamp_min(1e-3)
    return replace(scan, frames=scan.frames * change.cpu().numpy())


def _lines(scan: Scan, values: Tensor, grid: Grid, backend: Backend) -> tuple[Instrument, Tensor]:
    """The instrument of a scan, and the line integrals [V, C, H, W] in metres that it wants of `values`."""
    voxels = scan.views.finest / min(grid.voxel_size)
    instrument = Instrument(scan.exposures, fringe_sampling(scan.exposures, voxels=voxels), backend=backend)
    if instrument.backend == "reference":
        return instrument, voxel_line_integrals(values, grid, instrument.views, step=1.0)
    return instrument, VoxelLines(grid, instrument.views, instrument.backend)(values.to(instrument.device))


def _frames(instrument: Instrument, lines: Tensor, materials: Iterable[tuple[float, float]]) -> Tensor:
    return instrument.frames(LineIntegrals(lines, tuple((float(delta), float(beta)) for delta, beta in materials)))
