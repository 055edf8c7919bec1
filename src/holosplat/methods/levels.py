"""Whether matter has levels of δ with sharp edges, or is continuous: what is known, and what unseen views show.

The inside of a first volume without any bound is flattened, to one level or to two, with its rims left as they are. Of
matter with levels the flat volume predicts unseen views better, for the differences were errors; of continuous matter
it predicts them worse. Where neither is sure, or a known material would be called continuous, the methods for either
kind are fitted to the coarse frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..baselines.material import LIKELY_RATIOS
from ..baselines.tomography import plateau
from ..baselines.two_materials import best_levels, eroded, told_apart
from ..checks import InputError, NoMatterError
from ..inference import Decision, Score, select
from ..matter import MatterKind
from ..representations import Stored, VoxelGrid
from ..tables import with_entries
from .cross_validation import BY_FISSION, EFFORT, FirstVolumes, is_plain, predictions, without_matter
from .method import Method, Task, first_of_task, solve_stages
from .smooth_fit import EMPTY, WORTH
from .trials import FREE, WITHOUT, Hypothesis, Trial, Trials, accepted, hypothesis_of, name_of
from .uncertain import Determined, likeliest_ratio
from .volume import SmoothVolume, unexplained

STAGE = "levels or continuous matter"
SHOWN = "matter in first volumes"
NAME, RATIO = "matter", "δ/β in frames as measured"
LEVELS = ("one level", "two levels")
IN_LIGHT = "in the light that each calls for"
SEVERAL = "several levels"
CONTINUOUS = "continuous"

Lit = Callable[[FirstVolumes], Hypothesis]
"""What first volumes call for of light and noise."""


def decide_matter(task: Task, methods: Mapping[MatterKind, Method] | None = None) -> Decision:
    """Whether the training frames of `task` show levels, `LEVELS`, or continuous matter.

    A known material has one level, two have two: that is the null, which flat volumes may keep, but fits of `methods`
    for either kind alone overturn. Where less is known and there are such methods, the null is continuous matter, which
    bounds nothing, and is sure where it wins against levels; where flat volumes predict neither better nor worse, or
    first volumes show no matter, these are fitted: bodies, which take longest, briefly at first, for short fits of
    levels that predict better than a whole one of continuous matter are enough. One ratio δ/β holds one level. Of views
    that are too few to set some aside, levels are taken.
    """
    task.on_progress(STAGE, 0.0)
    first = first_of_task(task)
    if first.folds.by == BY_FISSION:
        return Decision(NAME, LEVELS[0], "too few views to set some aside")
    flat = _FlatVolumes(task, first)
    levels = LEVELS[: flat.most]
    if not levels:
        return Decision(NAME, LEVELS[0], "nothing in a first volume lies more than a pixel inside matter")
    known = methods is None or bool(task.prior.materials)
    candidates = (*levels, CONTINUOUS) if known else (CONTINUOUS, *levels)
    if methods is None or not blind(task.decisions):
        how = flat.score, first.folds.count
        found = select(NAME, candidates, *how, by=first.folds.by)
        sure = found.choice != CONTINUOUS or (
            not known and select(NAME, (*levels, CONTINUOUS), *how, by=first.folds.by).choice == CONTINUOUS
        )
        if methods is None or sure:
            return found
    for effort in (EFFORT, 1.0):
        kinds: dict[MatterKind, Method] = {**methods, "levels": methods["levels"].with_effort(effort)}
        fits = TrialFits(task, first, kinds, whole=effort == 1.0)

        def scored(name: str, fold: int, fits: TrialFits = fits) -> Score:
            return fits.score(name_of(first.taken), kind_of(name), fold, two=name == LEVELS[1])

        found = select(NAME, candidates, scored, first.folds.count, by=f"{first.folds.by}, by fits")
        if found.choice != CONTINUOUS:
            break
    return found


class _FlatVolumes:
    """First volumes of a task, and the same with flat insides."""

    def __init__(self, task: Task, first: FirstVolumes) -> None:
        self._task, self._first = task, first

    @property
    def most(self) -> int:
        """Levels to which volumes may be flattened."""
        return min(1 if self._task.prior.fixes_ratio else 2, len(self._volumes(0)[1]))

    def score(self, name: str, fold: int) -> Score:
        """Of a volume with the levels that `name` says, or of a continuous one."""
        trial, volumes = self._volumes(fold)
        number = -1 if name == CONTINUOUS else min(LEVELS.index(name), len(volumes) - 1)
        if number < 0:
            return trial.score(trial.light)
        expected = self._first.once(("flat", number), fold, lambda: predictions(volumes[number], trial.unseen))
        return trial.of(expected).score(trial.light)

    def _volumes(self, fold: int) -> tuple[Trial, list[VoxelGrid]]:
        return self._first.once("flat", fold, lambda: self._flat(fold))

    def _flat(self, fold: int) -> tuple[Trial, list[VoxelGrid]]:
        trial = accepted(self._task, self._first, fold)
        assert isinstance(trial.volume, VoxelGrid)  # spherical matter is continuous
        grid, seen = trial.volume.grid, trial.seen
        pixel = max(1, round(seen.views.finest / grid.voxel_size[0]))
        flat = (
            VoxelGrid(one[None], grid, trial.volume.matter) for one in flattened(trial.volume.values[0].cpu(), pixel)
        )
        return trial, [one.on(trial.volume.backend) for one in flat]


class TrialFits:
    """Fits of the methods for either kind of matter to coarse frames, under hypotheses about light and noise.

    They start from volumes on voxels of a pixel, as first ones are. Two levels alone need no ratio δ/β; else it is,
    where nothing is known, the likeliest one, as in a run; before light is decided, that of the first volume. whole:
    whether bodies that surfaces lack join them. These join only where they predict unseen frames better, so that fits
    without them that speak for levels are enough; they cost half.
    """

    def __init__(
        self, task: Task, first: FirstVolumes, methods: Mapping[MatterKind, Method], whole: bool = False
    ) -> None:
        self._task, self._whole, self._first = task, first, first.for_fits
        how = {"refine": 1, "join_missing": whole}
        self._methods = {kind: with_entries(method, how) for kind, method in methods.items()}
        self._trials = Trials(self._first, task.light)

    def score(self, name: str, kind: MatterKind, fold: int, two: bool = False) -> Score:
        """Of the fit for a `kind` of matter (two: of two levels) to the fitted frames of a fold, under the hypothesis
        that has this `name`, or as a rival of one (`trials.rivals`).

        Unseen frames are in free light for no rival that is `refuted`: such light makes up for what a fit got wrong.
        """
        hypothesis, (before, _, more) = hypothesis_of(name), name.partition(FREE)
        name = before if more and self.refuted(hypothesis, more, fold) else name
        found = self._fit(hypothesis, kind, fold, two)
        trial = self._trials.tried(hypothesis, fold)
        expected = torch.ones_like(trial.expected) if found is None else predictions(found, trial.unseen)
        return self._trials.score_of(name, fold, expected)

    def _fit(self, hypothesis: Hypothesis, kind: MatterKind, fold: int, two: bool = False) -> Stored | None:
        """What is fitted; None where no matter is found."""
        key = ("fit", hypothesis, kind, self._methods[kind], two)
        return self._first.once(key, fold, lambda: self._fitted(hypothesis, kind, fold, two))

    def _fitted(self, hypothesis: Hypothesis, kind: MatterKind, fold: int, two: bool) -> Stored | None:
        method, fitted = self._methods[kind], self._fitted_to(hypothesis, kind, fold, two)
        fitted.on_progress(f"fit of coarse frames: {method.kind}", 0.0)
        if fitted.bounded and not fitted.prior.materials and "continuous" in self._methods:
            volume = self._fit(hypothesis, "continuous", fold)
            fitted = replace(fitted, likeliest=volume if isinstance(volume, VoxelGrid) else None)
        try:
            return solve_stages(method, fitted)
        except NoMatterError:
            return None

    def _fitted_to(self, hypothesis: Hypothesis, kind: MatterKind, fold: int, two: bool = False) -> Task:
        """The fitted frames of a fold as a hypothesis has them."""
        task, trial = self._task, self._trials.tried(hypothesis, fold)
        seen = replace(trial.seen, frames=trial.light.evened(torch.from_numpy(trial.seen.frames)).numpy())
        prior = task.prior
        if not (prior.fixes_ratio or two):
            known = task.lit is not None
            ratio = ratio_of_one(task, self._whole).value if known else self._first.material.ratio
            prior = prior.with_ratio(ratio)
        fitted = replace(task, scan=seen, prior=prior, lit=trial.light, matter=kind, first=None)
        first = first_of_task(fitted).at_ratio(self._first.material.ratio)
        shared = is_plain(trial.light) and self._first.folds.by != BY_FISSION
        return replace(fitted, first=replace(first, part_of=(self._first, fold) if shared else None))

    def refuted(self, before: Hypothesis, more: str, fold: int) -> bool:
        """Whether the fit of continuous matter under the hypothesis `before` leaves its own frames unexplained beyond
        noise, of which that with `more` explains at least `WORTH`."""
        left, after = (self._unexplained(one, fold) for one in (before, (*before, more)))
        return left is not None and after is not None and left > EMPTY and after - 1 <= WORTH * (left - 1)

    def _unexplained(self, hypothesis: Hypothesis, fold: int) -> float | None:
        """χ² a pixel that the fit of continuous matter leaves of its own frames; None where no matter is found."""
        found, method = self._fit(hypothesis, "continuous", fold), self._methods["continuous"]
        assert isinstance(method, SmoothVolume)
        return None if found is None else unexplained(self._fitted_to(hypothesis, "continuous", fold), found, method)


def ratio_of_one(task: Task, first: FirstVolumes) -> Determined:
    """δ/β where nothing is known and all matter has one, found once for what was taken of light (`decide_ratio`)."""
    return _ratio(task, first)[0]


def decide_ratio(
    task: Task, first: FirstVolumes, lit: Lit | None = None, likely: bool = True
) -> tuple[FirstVolumes, tuple[Decision, ...]]:
    """First volumes of a task of which nothing is known at its δ/β, and whether frames as measured need that.

    The null is the likeliest one (`likeliest_ratio`), or where the likelihood tells none, or is not asked (`likely`),
    that of `FirstVolumes.ratio`. The largest of `LIKELY_RATIOS`, of matter that absorbs least, is taken where first
    volumes of such matter predict unseen frames better, as measured, or both in the light that each calls for (`lit`):
    absorption may stand for light, and light for absorption. In light or noise that was taken, which were found at the
    first δ/β, nothing is decided.
    """
    found, decision = _ratio(task, first, lit, likely)
    if decision is None:
        return first, ()
    there = at_decided(first, [decision])
    there.once(("ratio", first.taken), 0, lambda: (found, decision))
    return there, (first.ratio[1], decision)


def _ratio(
    task: Task, first: FirstVolumes, lit: Lit | None = None, likely: bool = True
) -> tuple[Determined, Decision | None]:
    return first.once(("ratio", first.taken), 0, lambda: _compared(task, first, lit, likely))


def _compared(task: Task, first: FirstVolumes, lit: Lit | None, likely: bool) -> tuple[Determined, Decision | None]:
    if likely:
        found = likeliest_ratio(replace(task, first=first))
    else:
        found = Determined("delta_beta", first.material.ratio, *LIKELY_RATIOS, LIKELY_RATIOS, told=False)
    most = LIKELY_RATIOS[1]
    if first.taken:
        return found, None
    found = replace(found, value=float(f"{found.value:.4g}"))  # as the decision names it, so that runs may go on
    tried = {f"{found.value:.4g}": found}
    tried.setdefault(f"{most:.4g}", replace(found, value=most, high=most, told=False))
    trials = {name: Trials(first.at_ratio(each.value), task.light) for name, each in tried.items()}

    def decided(light: Mapping[str, Hypothesis], by: str) -> Decision:
        def scored(name: str, fold: int) -> Score:
            try:
                return trials[name].score(name_of(light.get(name, ())), fold)
            except InputError:  # there is no such matter
                return without_matter(first, fold)

        return select(RATIO, tuple(tried), scored, first.folds.count, by=by)

    decision = decided({}, first.folds.by)
    if lit and tried[decision.choice].value != most:
        decision = decided({name: lit(each.first) for name, each in trials.items()}, f"{first.folds.by}, {IN_LIGHT}")
    chosen = tried[decision.choice]
    return (chosen if chosen.told or not likely else replace(chosen, remark=decision.line)), decision


def at_decided(first: FirstVolumes, decisions: Iterable[Decision]) -> FirstVolumes:
    """First volumes at the δ/β that `decide_ratio` has found, if it was asked."""
    for each in decisions:
        if each.name == RATIO:
            first = first.at_ratio(float(each.choice))
    return first


def blind(decisions: Iterable[Decision]) -> bool:
    """Whether it was decided that first volumes predict unseen frames no better than no matter would."""
    return any(each.name == SHOWN and each.choice.endswith(WITHOUT) for each in decisions)


def kind_of(choice: str) -> MatterKind:
    """The kind of matter that a choice of `decide_matter` is of."""
    return "continuous" if choice == CONTINUOUS else "levels"


def flattened(values: Tensor, pixel: int) -> Iterator[Tensor]:
    """Volumes [Z, Y, X] whose inside is flat, at one level and at two; rims, `pixel` voxels and more, stay.

    Nothing is given where nothing lies inside.
    """
    v, rim = values.numpy(), 1 + pixel // 2
    inside = eroded(v > 0.5 * plateau(values), rim)
    if not inside.any():
        return
    yield torch.from_numpy(np.where(inside, v[inside].mean(), v))
    found = best_levels(values, pixel)
    levels = (found.high, found.low)
    lighter = eroded(told_apart(values, levels, pixel)[1].numpy() > 0, rim)
    denser = eroded(v > 0.5 * sum(levels), rim)
    if lighter.any() and denser.any():
        flat = np.where(denser, v[denser].mean(), v)
        yield torch.from_numpy(np.where(lighter, v[lighter].mean(), flat))
