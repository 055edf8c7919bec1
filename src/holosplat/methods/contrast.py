"""On which side of its medium's the δ of matter lies: bodies in air or in a lighter medium, or holes in a denser one.

The null is matter above its medium. Holes are taken where a volume of them predicts unseen frames better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from ..checks import InputError
from ..inference import Decision, Score, select
from ..matter import MaterialPrior
from .first_volumes import FirstVolumes, score_of

STAGE = "sign of the contrast"
ABOVE, BELOW = "δ above the medium's", "δ below the medium's"


def decide_sign(
    first: FirstVolumes, score: Callable[[FirstVolumes, int], Score]
) -> tuple[FirstVolumes, tuple[Decision, ...]]:
    """The first volumes of the sign that unseen frames speak for, and the decision; none where the sign is known.

    score: of first volumes on the unseen frames of a fold. A sign under which no matter is found predicts even light.
    """
    if first.prior.sign:
        return first, ()
    first.on_progress(STAGE, 0.0)
    holes = FirstVolumes(first.folds, first.prior.signed(-1), first.on_progress, first.options)
    volumes = {ABOVE: first, BELOW: holes}

    def scored(name: str, fold: int) -> Score:
        try:
            return score(volumes[name], fold)
        except InputError:  # there is no such matter
            unseen = torch.from_numpy(first.folds.split(fold)[1].frames)
            return score_of(unseen, torch.ones_like(unseen))

    decision = select(STAGE, (ABOVE, BELOW), scored, first.folds.count, by=first.folds.by)
    return volumes[decision.choice], (decision,)


def with_sign(prior: MaterialPrior, decisions: Sequence[Decision]) -> MaterialPrior:
    """`prior` with the sign that was decided for, if any was."""
    for each in decisions:
        if each.name == STAGE:
            return prior.signed(-1 if each.choice == BELOW else 1)
    return prior
