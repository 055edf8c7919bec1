"""On which side of its medium's the δ of matter lies: bodies in air or in a lighter medium, or holes in a denser one.

The null is matter above its medium. Holes are taken where a volume of them predicts unseen frames better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from ..checks import InputError
from ..inference import Decision, Score, select
from ..matter import MaterialPrior
from .first_volumes import FirstVolumes

STAGE = "sign of the contrast"
ABOVE, BELOW = "δ above the medium's", "δ below the medium's"


Scoring = Callable[[FirstVolumes, int], Score]
"""Of first volumes, on the unseen frames of a fold."""


def decide_sign(first: FirstVolumes, *scores: Scoring) -> tuple[FirstVolumes, tuple[Decision, ...]]:
    """The first volumes of the sign that unseen frames speak for, and the decision; none where the sign is known.

    scores: in even light, and then in such light as may have hidden the sign: each is asked where those before it have
    left the sign open. A sign under which no matter is found predicts even light.
    """
    if first.prior.sign:
        return first, ()
    first.on_progress(STAGE, 0.0)
    holes = FirstVolumes(first.folds, first.prior.signed(-1), first.on_progress, first.options)
    volumes = {ABOVE: first, BELOW: holes}

    def asked(score: Scoring) -> Decision:
        def scored(name: str, fold: int) -> Score:
            try:
                return score(volumes[name], fold)
            except InputError:  # there is no such matter, or no such light
                unseen = first.folds.split(fold)[1]
                return Score.of(unseen.left(torch.ones(unseen.frames.shape, dtype=torch.float64)))

        return select(STAGE, (ABOVE, BELOW), scored, first.folds.count, by=first.folds.by)

    decision = asked(scores[0])
    for score in scores[1:]:
        if decision.choice == BELOW or decision.compared[0].loses:
            break
        decision = asked(score)
    return volumes[decision.choice], (decision,)


def with_sign(prior: MaterialPrior, decisions: Sequence[Decision]) -> MaterialPrior:
    """`prior` with the sign that was decided for, if any was."""
    for each in decisions:
        if each.name == STAGE:
            return prior.signed(-1 if each.choice == BELOW else 1)
    return prior
