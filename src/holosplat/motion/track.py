"""`follow`: the frames of several times in, closed bodies on smooth paths out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..bodies.poses import two_beams
from ..bodies.rest_shape import KnownBody, guessed_cells
from ..checks import InputError, require
from ..fit.run import Journal, Run
from ..inference import Score, select
from ..matter import DeltaBeta, Matter
from ..optics.background import Light
from ..progress import FitProgress
from ..representations import MovingSurfaces
from ..scan import Scan
from .body_tracker import BodyTracker, Followed, require_times
from .detections import predicted
from .expected import Expected, require_reach
from .forecast import Forecast
from .track_linking import TrackOptions

NAME, CELLS, ANY = "shape of the bodies", "red cells", "any shape"
PRIOR, AFTER, ALONE = "prior of the paths", "a forecast", "none"


def compared_kinds(cells: BodyTracker, other: BodyTracker) -> Followed:
    """What `cells`, of red cells, found, or `other`, of bodies of any shape, which has its sightings.

    Errors: those of either; where there are no cells of that size, of `other` alone.
    """
    if cells.stage == "sightings":
        cells.seen, cells.counts, cells.guess, cells.stage = other.seen, other.counts, other.guess, "first paths"
        cells.decisions = list(other.decisions)
    try:
        cells.until("stiff")
    except InputError:  # no cell of that size
        other.until("done")
        return other.followed("; no red cells of their size were found")
    cells.until("halves")
    other.until("halves")
    scores = {CELLS: unexplained(cells), ANY: unexplained(other)}
    decision = select(NAME, tuple(scores), lambda name, fold: scores[name], by="training frames")
    kept = cells if decision.choice == CELLS else other
    kept.decisions = [*(each for each in kept.decisions if each.name != NAME), decision]
    kept.until("done")
    return kept.followed()


def compared_priors(train: Scan, corrected: Followed, alone: Followed) -> Followed:
    """What `corrected`, of a forecast, found; or what frames of two beams show `alone`, where that leaves less of them
    by the policy of `select`: these leave shapes open, which a wrong forecast then keeps."""
    both = {AFTER: corrected, ALONE: alone}

    def scored(name: str, fold: int) -> Score:
        return residual(train, both[name].bodies, both[name].oversample)

    decision = select(PRIOR, tuple(both), scored, by="training frames")
    kept = both[decision.choice]
    return replace(kept, decisions=(*kept.decisions, decision))


def unexplained(of: BodyTracker) -> Score:
    """The residual of the training frames beside the frames of the bodies."""
    assert of.bodies is not None
    return residual(of.train, of.bodies, of.oversample)


def residual(train: Scan, bodies: MovingSurfaces, oversample: int) -> Score:
    """What `bodies` leave of the frames `train`."""
    return Score.of(torch.from_numpy(train.frames - predicted(train, bodies, oversample)))


def require_prior(after: Forecast | None, options: TrackOptions, times: np.ndarray) -> None:
    """`InputError` for a forecast that cannot be the prior of frames of these `times` [T] s."""
    if after is None:
        return
    require(
        options.body is None,
        "the shape at rest must not be given beside a forecast, which has the shapes, but both are; leave --body, or "
        "--after.",
    )
    require_reach(after, times)


USUAL = TrackOptions()
"""The usual options of `follow`."""


def follow(
    scan: Scan,
    material: DeltaBeta,
    options: TrackOptions = USUAL,
    seed: int = 0,
    *,
    light: Light | None = None,
    after: Forecast | None = None,
    journal: Journal | None = None,
    on_progress: FitProgress = lambda stage, fraction, record: None,
) -> Followed:
    """The bodies of `material` in the training frames of `scan`, of several times.

    after: the forecast of these times by earlier ones, with which the bodies begin, and from which frames draw them as
    far as its standard errors allow; of two beams, unless these show more without it (`compared_priors`). light: of the
    training frames, which were divided by it, where it is uneven. journal: keeps every stage that is done, and fits
    from time to time; what it holds already is not done again, and the result is the same bit for bit. Where all frames
    are of two beams, of unknown shape, and a network of red cells guesses the bodies, they are followed as red cells,
    too; these are kept unless bodies of any shape leave less (`compared_kinds`). Errors: `InputError` for a scan of one
    time, where no body is seen, and for a forecast that does not reach over the times, has no standard errors, or is
    given beside a shape at rest.
    """
    train = scan.train()
    require_times(train)
    run = Run(journal)
    require_prior(after, options, train.instants)

    def tracker(name: str, body: KnownBody | None, expected: Expected | None = None) -> BodyTracker:
        how = replace(options, body=body)
        return BodyTracker(train, material, how, seed, light, run.part(name), on_progress, expected)

    def alone() -> Followed:
        every = tracker("any", options.body)
        if options.body is None and options.cells and two_beams(train.views) is not None:
            every.until("first paths")
            if every.cells > 0:
                return compared_kinds(tracker("cells", guessed_cells(every.cells)), every)
        every.until("done")
        return every.followed()

    if after is None:
        return alone()
    expected = Expected.of(after, train.instants, train.views.finest, Matter.one(*material))
    corrected = tracker("after", None, expected)
    corrected.until("done")
    found = corrected.followed()
    if two_beams(train.views) is None:
        return found
    try:
        other = alone()
    except InputError as error:
        return replace(found, begun=f"{found.begun}; without the forecast: {error}")
    return compared_priors(train, found, other)
