"""How many pieces paths have: as many as predict frames that a short fit has not seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from ..checks import at_least, in_range
from ..fit.residuals import Prediction
from ..fit.running import Steps
from ..optics.background import Light
from ..ranges import ranged
from ..representations import MovingSurfaces
from ..scan import Scan
from .elastic import Rest
from .fit import MotionFit, motion_fit

SURE = 2.0
"""Standard errors by which more pieces must be better."""


@dataclass(frozen=True)
@ranged
class PathOptions:
    """How vertices move."""

    degree: int = 2
    """Of the polynomials of time: 2 leaves 0.002 µm of the paths of flowing cells over 16 times."""
    pieces: int = 0
    """Pieces of their splines (0: chosen from the data)."""
    most_pieces: int = 8
    """At most, where frames are asked."""
    held_out: int = 5
    """One frame in so many is held out to ask them."""

    def __post_init__(self) -> None:
        in_range("degree", self.degree, 1, 5)
        at_least(self, 1, "most_pieces")
        at_least(self, 2, "held_out")


def chosen_paths(
    train: Scan,
    start: MovingSurfaces,
    options: PathOptions,
    how: MotionFit,
    seed: int = 0,
    light: Light | None = None,
    rest: Rest | None = None,
    *,
    steps: Steps | None = None,
) -> MovingSurfaces:
    """`start` on paths of the asked number of pieces, or of the number that predicts held-out frames best.

    Numbers are doubled as long as a fit goes on better so than with as many pieces as before: half the steps of `how`,
    on all but the held-out frames, which it then predicts better by more than chance. There are never more coefficients
    than times. steps: in which it is done, one for each fit.
    """
    if options.pieces > 0:
        return refined(start, options.pieces)
    most = min(options.most_pieces, len(train.instants) - options.degree)
    candidates = [n for n in (2**k for k in range(8)) if n <= most]
    if len(candidates) < 2 or len(train) < 2 * options.held_out:
        return start
    aside = np.zeros(len(train), dtype=bool)
    aside[np.random.default_rng(seed).permutation(len(train))[: len(train) // options.held_out]] = True
    short = replace(how, schedule=replace(how.schedule, steps=max(1, how.schedule.steps // 2)))
    kept, left = train.with_split(aside), train[np.flatnonzero(aside)]

    steps = steps or Steps()

    def run(bodies: MovingSurfaces) -> tuple[torch.Tensor, torch.Tensor]:
        fit = motion_fit(kept, bodies, short, seed, _part(light, ~aside), rest)
        fit.run(lambda record: None)
        found = fit.result().object
        assert isinstance(found, MovingSurfaces)
        return found.coefficients.detach(), _errors(left, found, fit.oversample)

    def fitted(bodies: MovingSurfaces) -> tuple[MovingSurfaces, np.ndarray]:
        coefficients, errors = steps.of(lambda: run(bodies))
        return bodies.with_parameters({"coefficients": coefficients}), errors.numpy()

    best, begun = start.basis.pieces, fitted(start)[0]
    for pieces in candidates[1:]:
        same, finer = fitted(begun), fitted(refined(begun, pieces))
        if not _better(same[1], finer[1]):
            break
        best, begun = pieces, finer[0]
    return refined(start, best)


def refined(start: MovingSurfaces, pieces: int) -> MovingSurfaces:
    """`start` on splines of so many pieces, which hold its paths exactly where they are multiples of its own."""
    basis = replace(start.basis, pieces=pieces)
    if basis == start.basis:
        return start
    times = np.linspace(basis.first, basis.last, 4 * (basis.count + start.basis.count))
    weights = start.basis.weights(times)
    places = np.einsum("tk,kpx->tpx", weights, start.coefficients.detach().numpy())
    paths = torch.from_numpy(basis.fitted(times, places))
    return MovingSurfaces(paths, start.faces, start.of_body, basis, start.unit_length, start.matter, start.lines)


def _errors(held_out: Scan, found: MovingSurfaces, oversample: int) -> torch.Tensor:
    """Mean square residual [V] of each held-out frame."""
    said, measured = Prediction(found, held_out.exposures, oversample), torch.from_numpy(held_out.frames)
    with torch.no_grad():
        left = [float((said.view(v).frames()[0] - one).square().mean()) for v, one in enumerate(measured)]
        return torch.tensor(left, dtype=torch.float64)


def _better(before: np.ndarray, after: np.ndarray) -> bool:
    gain = before - after
    return bool(gain.mean() > SURE * gain.std(ddof=1) / np.sqrt(len(gain)))


def _part(light: Light | None, kept: np.ndarray) -> Light | None:
    return None if light is None else light.part(torch.from_numpy(np.flatnonzero(kept)))
