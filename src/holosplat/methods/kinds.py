"""Whether Gaussians or the surfaces cut out of them predict unseen views: kinds of unequal freedom.

Training frames prefer the freer kind, which also explains by half a density what is in the wrong place.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cache, partial

import torch

from ..checks import NoMatterError
from ..inference import Decision, Score, select
from ..representations import Stored
from ..scan import Scan
from .cross_validation import EFFORT, Folds, predicted_frames
from .keeper import NAME, Unseen
from .method import Method, Task, run_stages, unheard

STAGE = "kinds of results"


def unseen_kinds(task: Task, method: Method) -> Unseen | None:
    """What decides between kinds of results of a run; None where there is one kind, or where poses are free, for those
    of unseen views are not known."""
    return partial(decide_kind, task, method) if method.mixes_kinds and task.freedom is None else None


def decide_kind(task: Task, method: Method, null: str, other: str) -> Decision:
    """Which kind of result predicts unseen views, where `method` makes both on its way; null: the kind of its last one.

    The method runs on coarse frames of the other views, with a part `EFFORT` of its steps. A kind that it does not make
    there predicts what its last state does. Two views are compared by data fission.
    """
    folds = Folds.of(task.scan)

    @cache
    def scores(fold: int) -> dict[str, Score]:
        seen, unseen = folds.split(fold)
        lit = task.lit and task.lit.part(torch.from_numpy(folds.kept(fold)), folds.binning)
        last = dict[str, tuple[Stored, int]]()

        def look(name: str, found: Stored, oversample: int, fitted: bool, train: Scan) -> None:
            last[found.kind] = found, oversample

        part = replace(task, scan=seen, lit=lit, first=None, near=False, on_start=unheard)
        with suppress(NoMatterError):  # what is made before it stands
            run_stages(method.with_effort(EFFORT), part, look)
        expected = {kind: predicted_frames(unseen.exposures, *state) for kind, state in last.items()}
        expected = expected or {null: torch.ones(unseen.frames.shape)}
        return {kind: Score.of(unseen.left(frames.double())) for kind, frames in expected.items()}

    def score(kind: str, fold: int) -> Score:
        found = scores(fold)
        return found.get(kind) or list(found.values())[-1]

    task.on_progress(STAGE, 0.0)
    return select(NAME, (null, other), score, folds.count, by=folds.by)
