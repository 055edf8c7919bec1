"""Unequal flux, uneven light, a fixed pattern and correlated noise: hypotheses beside the null, frames as measured.

Each is carried as far as a volume, and taken only where this predicts unseen measured frames better (`inference`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ..backends import coarse_work, resolve
from ..baselines import HolographicTV, holographic_tv
from ..checks import InputError, require
from ..inference import Decision, Score, select
from ..matter import MaterialPrior, Matter, MatterKind
from ..optics.background import FLUX, Light, LightOptions
from ..progress import Progress
from ..representations import VoxelGrid
from ..scan import Scan
from .auto import Auto
from .continued import Continued
from .contrast import STAGE as SIGN
from .contrast import Scoring, decide_sides, decide_sign, with_sign
from .cross_validation import BY_FISSION, EFFORT, FirstVolumes, assumed_material, plain_light, predicted_frames
from .levels import SHOWN, TrialFits, at_decided, blind, decide_ratio
from .method import Method, Task, first_of_task, one_material
from .trials import UNEVEN, WITHOUT, Hypothesis, Trials, name_of, named, rivals, with_more
from .volume import SmoothVolume

STAGE = "light and noise"
CORRELATED = "correlated noise"
HYPOTHESES = ("fixed pattern", FLUX, UNEVEN, CORRELATED)
"""What may be added to the null, in this order where several predict alike."""

Prepared = tuple[Hypothesis, tuple[Decision, ...]]
"""What was taken, and the decisions that led to it."""
Scored = Callable[[str, int], Score]
"""The score of a hypothesis, by its name, in a fold."""


def decided(
    first: FirstVolumes,
    options: LightOptions,
    told: Hypothesis,
    hypotheses: tuple[str, ...],
    scored: Scored | None = None,
) -> Prepared:
    """The hypotheses that are added to what is told, one after another as long as one of the rest wins, and how.

    scored: by what hypotheses are compared (default: by their first volumes).
    """
    trials, taken, made = Trials(first, options), told, list[Decision]()
    by = first.folds.by if scored is None else f"{first.folds.by}, by fits"
    if first.folds.by == BY_FISSION:  # of two views, a pattern is what volumes leave in both
        hypotheses = tuple(one for one in hypotheses if one != "fixed pattern")
    while left := [one for one in hypotheses if one not in taken and trials.proposed((*taken, one))]:
        null, names = name_of(taken), [name_of((*taken, one)) for one in left]
        beside = {name: rivals(taken, one) for name, one in zip(names, left)}
        decision = select(STAGE, (null, *names), scored or trials.score, first.folds.count, by=by, beside=beside)
        made.append(decision)
        if decision.choice == null:
            break
        taken = named(decision.choice)
    return taken, tuple(made)


def shows_matter(first: FirstVolumes, options: LightOptions, taken: Hypothesis) -> Decision:
    """Whether the first volumes under a hypothesis predict unseen frames better than no matter would, surely or not."""
    trials, name = Trials(first, options), name_of(taken)
    return select(SHOWN, (name + WITHOUT, name), trials.score, first.folds.count, by=first.folds.by, surely=False)


def by_fits(task: Task, first: FirstVolumes, kinds: Mapping[MatterKind, Method]) -> Scored:
    """The score of a hypothesis by fits of coarse frames, for the kind of matter that predicts them better under it."""
    fits = TrialFits(task, first, kinds)

    def scored(name: str, fold: int) -> Score:
        found = [fits.score(name, kind, fold) for kind in kinds]
        return max(found, key=lambda each: each.gain_over(found[0])[0])

    return scored


def confirmed(task: Task, first: FirstVolumes, told: Hypothesis) -> Decision:
    """What first volumes have taken of light and noise beside what is told, against fits of smooth volumes.

    A first volume gains by a hypothesis that only steadies it: what it leaves of matter passes for correlated noise, or
    for light. A whole fit through the waves, in units of the noise, leaves less; its first steps say little of its end.
    That there is a gain, first volumes have shown; by fits it must be of practical size.
    """
    fits = TrialFits(task, first, {"continuous": SmoothVolume()})
    counts = range(len(told), len(first.taken))
    candidates = [name_of(first.taken[:count]) for count in (*counts, len(first.taken))]
    beside = {name_of(first.taken[: n + 1]): rivals(first.taken[:n], first.taken[n]) for n in counts}
    by = f"{first.folds.by}, by fits"

    def scored(name: str, fold: int) -> Score:
        return fits.score(name, "continuous", fold)

    return select(STAGE, candidates, scored, first.folds.count, by=by, beside=beside, surely=False)


@coarse_work()
def prepared(task: Task, method: Method | None = None, before: Prepared | None = None) -> Task:
    """The task with frames in even light, where evidence or `task.light` says that their light was not even; and, where
    nothing tells it, with the sign of the contrast (`contrast`), which is decided first.

    Frames that were divided by light before stay as they are: what that left open (`Scan.light`) is then what is not
    known of it. A pattern that is an unknown of the `method` itself is not looked for. Of several times the middle one
    decides for all. Errors: those of `Light.of`, and `InputError` for matter on both sides of its medium, where the
    method has none, and for several materials where it has the level of one.
    """
    if task.lit is not None:
        return task
    if method is not None:
        require(
            method.two_sided or not task.prior.two_sided or len(task.prior.materials) > 1,
            f"matter on both sides of its medium is continuous, but the method is {method.kind}, whose matter lies on "
            "one; take --method auto or volume.",
        )
        require(
            method.several or len(task.prior.materials) < 2,
            f"--material must be given once for the method {method.kind}, whose matter has one level, but it is given "
            f"{len(task.prior.materials)} times; give one, or take --method auto, gaussians, surfaces or volume.",
        )
        require(
            task.prior.two_sided or not _volume_of(method).two_sided,
            "volume.two_sided must be false, for --contrast says on which sides matter lies, but it is true; leave it, "
            "or give --contrast both.",
        )
    first = first_of_task(task, _volume_of(method).backend)
    if before is None:
        first, signs = decide_sign(first, *_scores(task.light), fitted=partial(_fitted, task.light))
    else:
        signs = tuple(each for each in before[1] if each.name == SIGN)
    task = replace(task, prior=with_sign(task.prior, signs), decisions=(*task.decisions, *signs))
    frames, options, handed = task.scan.measured, task.light, task.scan.light
    if handed is not None and options.kind != "even":
        return replace(task, lit=Light.handed(frames, options, handed))
    light = plain_light(frames, options)
    open_to = _open_to(task, method)
    told = tuple([UNEVEN] * (options.kind == "smooth"))
    if before is None:
        spherical = isinstance(method, Auto | SmoothVolume)
        free = not (task.prior.fixes_ratio or task.prior.two_sided or task.scan.is_series)
        if free:  # light and noise would make up for a wrong δ/β, so they are compared after it
            lights = tuple(one for one in open_to if one != CORRELATED)  # noise does not pass for absorption
            first, ratio = decide_ratio(task, first, lambda one: decided(one, options, told, lights)[0], spherical)
            task = replace(task, decisions=(*task.decisions, *ratio))
        task.on_progress(STAGE, 0.0)
        first.taken, made = decided(first, options, told, open_to)
        if _may_have_both_sides(task, method, bool(signs)) and (spherical or first.folds.by != BY_FISSION):
            first, sides = decide_sides(first, options, told, spherical)
            task = replace(task, prior=with_sign(task.prior, (sides,)), decisions=(*task.decisions, sides))
            if task.prior.two_sided:
                first.taken, made = decided(first, options, told, open_to)
        shown = None if method is None or method.of_series or not made else shows_matter(first, options, first.taken)
        if isinstance(method, Auto) and shown is not None and blind([shown]):
            kinds = method.with_effort(EFFORT).kinds
            alone: dict[MatterKind, Method] = {"continuous": kinds["continuous"]}
            scored = by_fits(task, first, alone if task.prior.two_sided else kinds)
            first.taken, again = decided(first, options, told, open_to, scored)
            made = (*made, shown, *again)
        elif method is not None and first.taken != told and not method.of_series:
            decision = confirmed(task, first, told)
            first.taken, made = named(decision.choice), (*made, decision)
        if options.noise == "correlated":
            first.taken = (*first.taken, "correlated noise")
    else:
        first = at_decided(replace(first, prior=task.prior), before[1])
        first.taken, made = before[0], tuple(each for each in before[1] if each.name != SIGN)
    task = replace(task, decisions=(*task.decisions, *made), first=first)
    scan, light = _applied(task, light, first.taken)
    return replace(task, scan=scan, lit=light)


def _open_to(task: Task, method: Method | None) -> Hypothesis:
    """The hypotheses that are asked for."""
    options = task.light
    asked = {
        "fixed pattern": options.still == "auto" and options.kind != "even" and not still_order(method),
        FLUX: options.kind == "auto" and not task.scan.is_series,  # several times have no one volume
        UNEVEN: options.kind == "auto",
        CORRELATED: options.noise == "auto",
    }
    return tuple(one for one, free in asked.items() if free)


def _may_have_both_sides(task: Task, method: Method | None, decided: bool) -> bool:
    """Whether matter may be on both sides of its medium: a known material is on one, and matter whose sign is told, and
    not decided by frames. Where a method goes on from a run, that has decided."""
    told = bool(task.prior.materials) or task.prior.two_sided or (task.prior.sign != 0 and not decided)
    can = method is not None and method.two_sided and not (task.scan.is_series or isinstance(method, Continued))
    return can and not told


def _scores(options: LightOptions) -> list[Scoring]:
    """The scores of volumes of frames as they were measured, and in smooth light where that may be."""

    def under(hypothesis: Hypothesis, volumes: FirstVolumes, fold: int, without: str) -> Score:
        trials = Trials(volumes, options)
        require(not hypothesis or trials.proposed(hypothesis, fold), "the light of the frames is even.")
        return trials.score(name_of(hypothesis) + without, fold)

    return [partial(under, one) for one in ((), (UNEVEN,)) if not one or options.kind != "even"]


def _fitted(options: LightOptions, volumes: FirstVolumes, fold: int, without: str) -> Score:
    """The score of a volume, or of none, on the frames that it was made of, as they were measured."""
    trial = Trials(volumes, options).tried((), fold)
    return Score.of(trial.seen.left(torch.ones_like(trial.predicted) if without else trial.predicted))


def _applied(task: Task, light: Light, taken: Hypothesis) -> tuple[Scan, Light]:
    """The frames in even light, and that light, on the frames' own pixels."""
    frames = torch.from_numpy(task.scan.frames)
    order = [one for one in HYPOTHESES if one in taken]

    def evened(light: Light) -> Scan:
        return replace(task.scan, frames=light.evened(frames).numpy().astype(np.float32))

    def predict(light: Light) -> Tensor:
        how = HolographicTV(upper=0.0, two_sided=task.prior.two_sided)
        return predicted_first(evened(light), one_material(task), how, task.on_progress, light)

    for one in order:
        if one != UNEVEN and task.scan.is_series:
            continue  # several times have no one volume
        found = with_more(light, one, task.scan, predict, task.light)
        if found is None:
            raise InputError(
                "no frame shows air, by which smooth light could be told from matter; give boxes of it by --air, or "
                "take --light even."
            )
        light = found
    return evened(light) if order else task.scan, light


def still_order(method: Method | None) -> int:
    """Half waves of the fixed pattern that is an unknown of `method`; 0 where it has none."""
    return _volume_of(method).still_light


def _volume_of(method: Method | None) -> HolographicTV:
    """The options of a method's first volume, or the usual ones."""
    volume = getattr(method, "volume", None)
    volume = getattr(volume, "volume", volume)
    return volume if isinstance(volume, HolographicTV) else HolographicTV()


def predicted_first(
    train: Scan, prior: MaterialPrior, options: HolographicTV, on_progress: Progress, light: Light | None = None
) -> Tensor:
    """Frames [V, H, W] of a first volume by those of `train`, which are in even light; light: what they were before."""
    material = assumed_material(train, prior, on_progress, options.backend)
    values, grid = holographic_tv(train, material, options, on_progress, light)
    found = VoxelGrid(values[None], grid, Matter.one(*material)).on(resolve(options.backend))
    return predicted_frames(train.exposures, found)
