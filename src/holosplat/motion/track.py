"""`follow`: the frames of several times in, closed bodies on smooth paths out."""

from __future__ import annotations

from dataclasses import replace

from ..bodies.rest_shape import KnownBody, guessed_cells
from ..bodies.twin import two_beams
from ..matter import DeltaBeta
from ..optics.background import Light
from ..progress import FitProgress
from ..scan import Scan
from .body_tracker import BodyTracker, Followed, require_times
from .journal import Journal, Nowhere
from .model_comparison import Parts, compared_kinds
from .track_options import TrackOptions

__all__ = ["NOWHERE", "USUAL", "Followed", "TrackOptions", "follow", "require_times"]

NOWHERE = Nowhere()
"""No journal."""

USUAL = TrackOptions()
"""The usual options of `follow`."""


def follow(
    scan: Scan,
    material: DeltaBeta,
    options: TrackOptions = USUAL,
    seed: int = 0,
    *,
    light: Light | None = None,
    journal: Journal = NOWHERE,
    on_progress: FitProgress = lambda stage, fraction, record: None,
) -> Followed:
    """The bodies of `material` in the training frames of `scan`, of several times.

    light: of the training frames, which were divided by it, where it is uneven. journal: keeps every stage that is
    done, and fits from time to time; what it holds already is not done again, and the result is the same bit for bit.
    Where all frames are of two beams, of unknown shape, and a network of red cells guesses the bodies, they are
    followed as red cells, too; these are kept unless bodies of any shape leave less (`model_comparison`). Errors:
    `InputError` for a scan of one time, and where no body is seen.
    """
    train = scan.train()
    require_times(train)
    parts = Parts(journal)

    def following(name: str, body: KnownBody | None) -> BodyTracker:
        run = BodyTracker(train, material, replace(options, body=body), seed, light, parts.of(name), on_progress)
        run.take_up()
        return run

    run = following("any", options.body)
    if options.body is None and options.cells and two_beams(train.views) is not None:
        run.until("first paths")
        if run.cells > 0:
            return compared_kinds(following("cells", guessed_cells(run.cells)), run)
    run.until("done")
    return run.followed()
