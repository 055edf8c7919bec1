"""What the holograms themselves say about the material, where it is not known."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..backends import Backend, resolve
from ..checks import NoMatterError, at_least, require
from ..geometry import Grid
from ..memory import memory_kept
from ..optics.retrieval import paganin
from ..progress import Progress
from ..ranges import Weight, checked_dataclass
from ..scan import Scan
from .rays import rays_of
from .tomography import TotalVariation, plateau, tv_solver

TRIAL_DELTA = 1e-6
"""The retrieved D = δT does not depend on it, but what a weight of total variation means does."""


@checked_dataclass
class MaterialEstimate:
    """How a material that is not known is estimated from the frames."""

    lowest: float = 1.75
    """Decimal logarithm of the smallest δ/β that is tried: heavy elements at low energy."""
    highest: float = 4.25
    """Decimal logarithm of the largest: soft matter at high energy."""
    tried: int = 11
    """Ratios that are tried, evenly spaced on a logarithmic scale; between them a parabola decides."""
    width: int = 64
    """Frames are binned to about so many pixels for δ/β, which acts on the lowest frequencies only; to twice as many
    for δ."""
    weight: Weight = 0.1
    """Weight of total variation in the trial volumes, in pixels of path length."""
    iterations: int = 40
    """Primal–dual steps for a trial volume."""

    def __post_init__(self) -> None:
        rises = self.lowest < self.highest
        require(rises, f"lowest must be below highest, {self.highest:g}, but it is {self.lowest:g}.")
        at_least(self, 3, "tried")
        at_least(self, 1, "width", "iterations")


DEFAULT = MaterialEstimate()


def estimate_ratio(
    scan: Scan,
    on_progress: Progress,
    backend: Backend = "auto",
    options: MaterialEstimate = DEFAULT,
    sign: float = 1.0,
) -> float:
    """A coarse δ/β of the matter in `scan`, whose δ has that `sign`: the one that gives the most compact volume.

    A wrong ratio leaves halos of positive or negative matter around everything, in every view alike, which
    lower the level of the matter itself. So of several ratios, the one whose non-negative tomography has the highest
    `plateau` is taken (the first such peak, from low ratios on), and refined by a parabola on a logarithmic
    scale. Good to a factor of about two; photon noise pulls it down.
    """
    coarse = scan.coarsened(max(1, round(scan.views.shape[1] / options.width)))
    ratios = np.logspace(options.lowest, options.highest, options.tried)
    levels = np.empty(len(ratios))
    for i, ratio in enumerate(ratios):
        on_progress("estimate of delta/beta", i / len(ratios))
        trial = _trial_volume(coarse, ratio, backend, options, sign)
        levels[i] = plateau(trial) if bool((trial > 0).any()) else 0.0  # a wrong ratio may leave nothing
    if not bool(levels.any()):
        raise NoMatterError
    best = _first_peak(levels)
    left, middle, right = levels[best - 1 : best + 2]
    curvature = left - 2 * middle + right
    offset = float(np.clip(0.5 * (left - right) / curvature, -1, 1)) if curvature < 0 else 0.0
    return float(ratios[best] * (ratios[1] / ratios[0]) ** offset)


def _first_peak(levels: np.ndarray) -> int:
    """Index of the first local maximum (not an end); beyond it, ratios so high that retrieval barely filters.

    There, whatever noise and fringes are left pass for matter and the level rises again.
    """
    inner = np.flatnonzero((levels[1:-1] > levels[:-2]) & (levels[1:-1] >= levels[2:])) + 1
    return int(inner[0]) if len(inner) else int(np.clip(np.argmax(levels), 1, len(levels) - 2))


def estimate_delta(
    scan: Scan,
    ratio: float,
    on_progress: Progress,
    backend: Backend = "auto",
    options: MaterialEstimate = DEFAULT,
    sign: float = 1.0,
    two_sided: bool = False,
) -> float:
    """δ, of that `sign`, of the one material in `scan` with δ/β = `ratio`: the plateau of a non-negative tomography, or
    of one that may have matter on both sides of its medium."""
    on_progress("estimate of delta", 0.0)
    coarse = scan.coarsened(max(1, round(scan.views.shape[1] / (2 * options.width))))
    return plateau(_trial_volume(coarse, ratio, backend, options, sign, two_sided).abs()) * sign * TRIAL_DELTA


def level_of(occupancy: Tensor) -> float:
    """The level [units of `occupancy`] of matter with one level beside a faint haze, both in [Z, Y, X] ≥ 0.

    The `plateau` of the denser of the two classes whose means differ most for their numbers (Otsu 1979): of small
    bodies in a large field, haze may have more mass.
    """
    values = occupancy.double().flatten().sort(descending=True).values
    require(bool(values[0] > 0), "an empty volume has no level; look at its frames first.")
    count = torch.arange(1, len(values), dtype=values.dtype, device=values.device)
    upper = values.cumsum(0)[:-1]
    between = (upper * len(values) - values.sum() * count).square() / (count * (len(values) - count))
    return plateau(occupancy * (occupancy >= values[int(between.argmax())]))


def _trial_volume(
    scan: Scan, ratio: float, backend: Backend, options: MaterialEstimate, sign: float, two_sided: bool = False
) -> Tensor:
    """Occupancy by Paganin's retrieval and a little total variation without an upper bound; not negative, unless matter
    is `two_sided`."""
    frames, delta, used = torch.from_numpy(scan.frames), sign * TRIAL_DELTA, resolve(backend)
    lines = paganin(frames, scan.exposures, delta, delta / ratio, missing=scan.gaps)
    rays = rays_of(lines, scan.views, Grid.of_views(scan.views), used, scan.gaps)
    how = TotalVariation(options.weight, options.iterations, 0, per_level=False, two_sided=two_sided)
    with memory_kept():
        return tv_solver(rays, None, how, lambda fraction: None, used).volume.cpu()
