"""The number of pieces of paths: as many as predict frames that a short fit has not seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from ..checks import at_least, in_range
from ..fit.residuals import Prediction
from ..fit.run import Run
from ..inference import Compared, Decision, Score
from ..optics.background import Light
from ..ranges import ranged
from ..representations import MovingSurfaces
from ..scan import Scan
from .elastic import Rest
from .fit import MotionFit, motion_fit

NAME, BY = "pieces of paths", "frames set aside"


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
    run: Run | None = None,
) -> tuple[MovingSurfaces, Decision | None]:
    """`start` on paths of the asked number of pieces, or of the number that predicts held-out frames best; and the
    decision, None where there was none.

    The number is doubled as long as a fit predicts the held-out frames better with it than with the number before
    (`inference.Compared`). A fit has half the steps of `how`. There are never more coefficients than times. run: whose
    step each fit is.
    """
    if options.pieces > 0:
        return refined(start, options.pieces), None
    most = min(options.most_pieces, len(train.instants) - options.degree)
    candidates = [n for n in (2**k for k in range(8)) if n <= most]
    if len(candidates) < 2 or len(train) < 2 * options.held_out:
        return start, None
    aside = np.zeros(len(train), dtype=bool)
    aside[np.random.default_rng(seed).permutation(len(train))[: len(train) // options.held_out]] = True
    short = replace(how, schedule=replace(how.schedule, steps=max(1, how.schedule.steps // 2)))
    kept, left = train.with_split(aside), train[np.flatnonzero(aside)]

    run = run or Run()

    def tried(bodies: MovingSurfaces) -> tuple[torch.Tensor, torch.Tensor]:
        fit = motion_fit(kept, bodies, short, seed, _part(light, ~aside), rest)
        fit.run(lambda record: None)
        found = fit.result().object
        assert isinstance(found, MovingSurfaces)
        return found.coefficients.detach(), _left(left, found, fit.oversample)

    def fitted(bodies: MovingSurfaces) -> tuple[MovingSurfaces, Score]:
        coefficients, left = run.step("paths", lambda: tried(bodies))
        return bodies.with_parameters({"coefficients": coefficients}), Score(left.numpy(), len(left))

    best, begun, compared = start.basis.pieces, fitted(start)[0], list[Compared]()
    for pieces in candidates[1:]:
        same, finer = fitted(begun), fitted(refined(begun, pieces))
        compared.append(Compared(str(pieces), *finer[1].gain_over(same[1])))
        if not compared[-1].wins:
            break
        best, begun = pieces, finer[0]
    return refined(start, best), Decision(NAME, str(best), BY, tuple(compared))


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


def _left(held_out: Scan, found: MovingSurfaces, oversample: int) -> torch.Tensor:
    """Powers [V, K] of `Score` of the held-out frames, one block a frame: frames differ by more than their parts do."""
    said, measured = Prediction(found, held_out.exposures, oversample), torch.from_numpy(held_out.frames)
    with torch.no_grad():
        left = torch.stack([said.view(v).frames()[0] - one for v, one in enumerate(measured)])
    return torch.from_numpy(Score.of(left).powers).unflatten(0, (len(left), -1)).mean(dim=1)


def _part(light: Light | None, kept: np.ndarray) -> Light | None:
    return None if light is None else light.part(torch.from_numpy(np.flatnonzero(kept)))
