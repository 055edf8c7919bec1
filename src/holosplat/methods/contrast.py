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
from .trials import WITHOUT

STAGE = "sign of the contrast"
ABOVE, BELOW = "δ above the medium's", "δ below the medium's"


Scoring = Callable[[FirstVolumes, int, str], Score]
"""Of first volumes, on the unseen frames of a fold; `WITHOUT` their matter, or with it ("")."""


def decide_sign(first: FirstVolumes, *scores: Scoring) -> tuple[FirstVolumes, tuple[Decision, ...]]:
    """The first volumes of the sign that unseen frames speak for, and the decision; none where the sign is known.

    scores: in even light, and then in such light as may have hidden the sign: each is asked where those before it have
    left the sign open. A sign under which no matter is found predicts even light, and a sign is sure only where its
    matter predicts frames better than none.
    """
    if first.prior.sign:
        return first, ()
    first.on_progress(STAGE, 0.0)
    holes = FirstVolumes(first.folds, first.prior.signed(-1), first.on_progress, first.options)
    volumes = {ABOVE: first, BELOW: holes}

    def asked(score: Scoring, null: str, other: str) -> Decision:
        def scored(name: str, fold: int) -> Score:
            sign, without, _ = name.partition(WITHOUT)
            try:
                return score(volumes[sign], fold, without)
            except InputError:  # there is no such matter, or no such light
                unseen = first.folds.split(fold)[1]
                return Score.of(unseen.left(torch.ones(unseen.frames.shape, dtype=torch.float64)))

        beside = {other: (other + WITHOUT,)}
        return select(STAGE, (null, other), scored, first.folds.count, by=first.folds.by, beside=beside)

    for score in scores:
        decision = asked(score, ABOVE, BELOW)
        if decision.choice == BELOW or asked(score, BELOW, ABOVE).choice == ABOVE:
            break
    return volumes[decision.choice], (decision,)


def with_sign(prior: MaterialPrior, decisions: Sequence[Decision]) -> MaterialPrior:
    """`prior` with the sign that was decided for, if any was."""
    for each in decisions:
        if each.name == STAGE:
            return prior.signed(-1 if each.choice == BELOW else 1)
    return prior
