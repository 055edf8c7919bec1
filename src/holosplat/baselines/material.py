"""What the holograms themselves say about the material, where it is not known."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..backends import Backend, resolve
from ..checks import NoMatterError
from ..geometry import Grid
from ..memory import memory_kept
from ..optics.retrieval import paganin
from ..progress import Progress
from ..ranges import Natural, Weight, checked_dataclass
from ..scan import Scan
from .rays import rays_of
from .tomography import TotalVariation, plateau, tv_solver

LIKELY_RATIOS = (56.0, 18_000.0)
"""δ/β that matter may have of which nothing is known: heavy elements at low energy, soft matter at high energy."""
RATIOS = tuple(float(ratio) for ratio in np.geomspace(LIKELY_RATIOS[1], LIKELY_RATIOS[0], 7))
"""Those of first volumes, the largest first: a step changes how far absorption blurs a volume by 1.6."""
USUAL_RATIO = RATIOS[len(RATIOS) // 2]
"""δ/β where frames do not tell it, about 1000: that of soft matter and light elements is 300 to 3000 at 8 to 30 keV."""
TRIAL_DELTA = 1e-6
"""The retrieved D = δT does not depend on it, but what a weight of total variation means does."""


@checked_dataclass
class MaterialEstimate:
    """How δ of a material that is not known is estimated from the frames."""

    width: Natural = 128
    """Frames are binned to about so many pixels."""
    weight: Weight = 0.1
    """Weight of total variation in the trial volumes, in pixels of path length."""
    iterations: Natural = 40
    """Primal–dual steps for a trial volume."""


DEFAULT = MaterialEstimate()


def estimate_delta(
    scan: Scan,
    ratio: float,
    on_progress: Progress,
    backend: Backend = "auto",
    options: MaterialEstimate = DEFAULT,
    sign: float = 1.0,
    two_sided: bool = False,
) -> float:
    """δ, of that `sign`, of the one material in `scan` with δ/β = `ratio`: the plateau of a non-negative tomography; or
    the level of one that may have matter on both sides of its medium, where noise leaves a haze of either sign all over
    the field, with more mass than the matter."""
    on_progress("estimate of delta", 0.0)
    coarse = scan.coarsened(max(1, round(scan.views.shape[1] / options.width)))
    trial = _trial_volume(coarse, ratio, backend, options, sign, two_sided)
    return (level_of(trial.abs()) if two_sided else plateau(trial)) * sign * TRIAL_DELTA


def level_of(occupancy: Tensor) -> float:
    """The level [units of `occupancy`] of matter with one level beside a faint haze, both in [Z, Y, X] ≥ 0.

    The `plateau` of the denser of the two classes whose means differ most for their numbers (Otsu 1979): of small
    bodies in a large field, haze may have more mass.
    """
    values = occupancy.double().flatten().sort(descending=True).values
    if not values[0] > 0:
        raise NoMatterError
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
