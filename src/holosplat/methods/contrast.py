"""On which side of its medium's the δ of matter lies: bodies in air or in a lighter medium, or holes in a denser one.

The null is matter above its medium. Holes are taken where a volume of them predicts unseen frames better; matter on
both sides, such as a shock and what is rarefied behind it, where this predicts them better than either. Few views leave
so much of a volume on both sides open that it predicts others worse than one that is bound to a side, even where that
side is wrong; the few unknowns of spherical matter they do tell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from ..baselines import HolographicTV
from ..checks import InputError
from ..inference import Decision, Score, select
from ..matter import MaterialPrior
from ..optics.background import LightOptions
from .cross_validation import BY_FISSION, FirstVolumes, without_matter
from .trials import WITHOUT, Hypothesis, Trials, name_of

STAGE = "sign of the contrast"
ABOVE, BELOW = "δ above the medium's", "δ below the medium's"
BOTH = "δ on both sides of the medium's"
BY_FITTED = "fitted frames"
SPHERICAL, BALL = f"spherical matter, {BOTH}", "spherical matter on one side of the medium"
LONGER = "matter on one side of the medium, by as many steps"


Scoring = Callable[[FirstVolumes, int, str], Score]
"""Of first volumes, on the unseen frames of a fold; `WITHOUT` their matter, or with it ("")."""


def decide_sign(first: FirstVolumes, *scores: Scoring, fitted: Scoring) -> tuple[FirstVolumes, tuple[Decision, ...]]:
    """The first volumes of the sign that unseen frames speak for, and the decision; none where the sign is known.

    scores: in even light, and then in such light as may have hidden the sign: each is asked where those before it have
    left the sign open; fitted: on the frames that a fold's volume was made of, in even light. A sign under which no
    matter is found predicts even light, and a sign is sure only where its matter predicts frames better than none. Some
    matter shows itself in few views, as walls along the beam do, and the others predict it under neither sign. Volumes
    of both signs have as many unknowns, so that views that they were fitted to compare them, too: holes are then taken
    that explain these better than matter above its medium and than none, and predict unseen ones no worse than none.
    """
    if first.prior.sign or first.prior.two_sided:
        return first, ()
    first.on_progress(STAGE, 0.0)
    holes = FirstVolumes(first.folds, first.prior.signed(-1), first.on_progress, first.options)
    volumes = {ABOVE: first, BELOW: holes}

    def asked(score: Scoring, null: str, other: str, by: str = first.folds.by, surely: bool = True) -> Decision:
        def scored(name: str, fold: int) -> Score:
            sign, without, _ = name.partition(WITHOUT)
            try:
                return score(volumes[sign], fold, without)
            except InputError:  # there is no such matter, or no such light
                return without_matter(first, fold, by == BY_FITTED)

        beside = {} if WITHOUT in other else {other: (other + WITHOUT,)}
        return select(STAGE, (null, other), scored, first.folds.count, by=by, beside=beside, surely=surely)

    for score in scores:
        decision = asked(score, ABOVE, BELOW)
        if decision.choice == BELOW or asked(score, BELOW, ABOVE).choice == ABOVE:
            return volumes[decision.choice], (decision,)
    if first.folds.by != BY_FISSION:  # its halves are of the same views
        seen = asked(fitted, ABOVE, BELOW, BY_FITTED)
        if seen.choice == BELOW and asked(scores[0], BELOW, BELOW + WITHOUT, surely=False).choice == BELOW:
            decision = seen
    return volumes[decision.choice], (decision,)


def decide_sides(
    first: FirstVolumes, light: LightOptions, told: Hypothesis = (), spherical: bool = True
) -> tuple[FirstVolumes, Decision]:
    """The first volumes of matter on one side of its medium, or on both, perhaps spherical, and the decision.

    Light makes up for matter that may not be there, and both sides for light. So both sides must predict unseen frames
    better than one, under the light that is `told` alone, and no worse than one in the light that was taken beside it:
    where these are alike, the frames are left alone. No bound ends their volumes sooner, so that these have more steps
    than first volumes; nor may they win by these alone. Spherical matter, which has the fewest unknowns, is asked for
    before any on both sides, and must predict more than a sphere on one side. What predicts unseen views by its few
    unknowns may yet leave much of those that it was fitted to, so it is refuted where other matter predicts the same
    views better, their noise apart (data fission). spherical: whether it is asked for, as methods that have it do. Of
    one view or two, none is unseen, and what is free on both sides is not asked for, but may refute what is spherical.
    """
    first.on_progress(STAGE, 0.0)
    one = ABOVE if first.prior.delta_sign > 0 else BELOW
    two = with_usual_steps(first, first.prior.on_both_sides())
    lit, single = f"{one} in {name_of(first.taken)}", Trials(first, light)
    spheres, ball = (
        replace(two, prior=each.prior.about_a_point(), _material=each.material, _made={}) for each in (two, first)
    )
    trials = {one: (single, told), SPHERICAL: (Trials(spheres, light), told), BOTH: (Trials(two, light), told)}
    if first.taken != told:
        trials[lit] = single, first.taken
    if not spherical:
        del trials[SPHERICAL]
    if first.folds.by == BY_FISSION:
        del trials[BOTH]
    longer = with_usual_steps(first, first.prior)
    rivals = {BALL: (Trials(ball, light), told), LONGER: (Trials(longer, light), told)}

    def scored(name: str, fold: int) -> Score:
        side, without, _ = name.partition(WITHOUT)
        tried, taken = (trials | rivals)[side]
        try:
            return tried.score(name_of(taken) + without, fold)
        except InputError:  # there is no such matter
            return without_matter(first, fold)

    beside, by = {SPHERICAL: (SPHERICAL + WITHOUT, BALL), BOTH: (BOTH + WITHOUT, LONGER)}, first.folds.by
    decision = select(STAGE, tuple(trials), scored, first.folds.count, by=by, beside=beside)
    if decision.choice == SPHERICAL and _refuted({SPHERICAL: spheres, one: first, BOTH: two}, light, told):
        return decide_sides(first, light, told, spherical=False)
    found = {SPHERICAL: spheres, BOTH: two}.get(decision.choice)
    return (found, decision) if found else (first, replace(decision, choice=one))


def _refuted(volumes: Mapping[str, FirstVolumes], light: LightOptions, told: Hypothesis) -> bool:
    """Whether other volumes than the first ones predict the same views with other noise better."""
    tried = {}
    for name, one in volumes.items():
        halves = replace(one, folds=replace(one.folds, count=1, by=BY_FISSION), _made={})
        tried[name] = Trials(halves, light)

    def scored(name: str, fold: int) -> Score:
        try:
            return tried[name].score(name_of(told), fold)
        except InputError:  # there is no such matter
            return without_matter(next(iter(volumes.values())), fold)

    null = next(iter(volumes))
    return select(STAGE, tuple(volumes), scored, by=BY_FISSION).choice != null


def with_usual_steps(first: FirstVolumes, prior: MaterialPrior) -> FirstVolumes:
    """The same, of the same δ/β, of matter as `prior` says, with the usual steps."""
    usual = HolographicTV()
    how = replace(first.options, retrieval=usual.retrieval, iterations=usual.iterations)
    found = FirstVolumes(first.folds, prior, first.on_progress, how)
    return found if prior.fixes_ratio else found.at_ratio(first.material.ratio)


def with_sign(prior: MaterialPrior, decisions: Sequence[Decision]) -> MaterialPrior:
    """`prior` with the sign, or both, that was decided for last, if any was."""
    for each in decisions:
        if each.name == STAGE:
            sides = {BOTH: prior.on_both_sides, SPHERICAL: prior.on_both_sides().about_a_point}.get(each.choice)
            prior = sides() if sides else prior.signed(-1 if each.choice == BELOW else 1)
    return prior
