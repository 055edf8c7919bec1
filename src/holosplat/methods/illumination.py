"""Unequal flux, uneven light, a fixed pattern and correlated noise: hypotheses beside the null, frames as measured.

Each is carried as far as a volume, and taken only where this predicts unseen measured frames better (`inference`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch
from torch import Tensor

from ..backends import Backend, resolve
from ..baselines import HolographicTV, holographic_tv
from ..checks import InputError, require
from ..inference import MARGIN, Decision, Score, select
from ..matter import MaterialPrior, Matter
from ..optics.background import FLUX, Background, Light, LightOptions
from ..optics.noise_model import NoiseModel
from ..optics.patterns import fixed_pattern
from ..progress import Progress
from ..representations import VoxelGrid
from ..scan import Scan
from .assumed import assumed_material
from .contrast import STAGE as SIGN
from .contrast import Scoring, decide_sign, with_sign
from .cross_validation import predicted_frames
from .first_volumes import BY_FISSION, FirstVolumes, Folds, lit_by_halves, predictions, score_of
from .method import Method, Task

STAGE = "light and noise"
NULL = "as measured"
UNEVEN = "uneven light"
HYPOTHESES = ("fixed pattern", FLUX, UNEVEN, "correlated noise")
"""What may be added to the null, in this order where several predict alike."""
FREE = "; of unseen frames free: "
"""Beside light of each frame's own: the volume before it, whose prediction is allowed the same light."""

Hypothesis = tuple[str, ...]
"""What is added to the null, in the order in which it was taken."""


Prepared = tuple[Hypothesis, tuple[Decision, ...]]
"""What was taken, and the decisions that led to it."""


@dataclass(frozen=True)
class Trial:
    """A hypothesis in a fold. volume: by the fitted frames `seen`; light: what the hypothesis says of these; unseen,
    expected: the frames that are not fitted, and what the volume predicts for them in even light"""

    volume: VoxelGrid
    light: Light
    seen: Scan
    unseen: Scan
    expected: Tensor

    @property
    def measured(self) -> Tensor:
        """The unseen frames [V, H, W]."""
        return torch.from_numpy(self.unseen.frames)

    @cached_property
    def predicted(self) -> Tensor:
        """The fitted frames [V, H, W] as the volume has them in even light."""
        return predictions(self.volume, self.seen)

    def of(self, expected: Tensor) -> Trial:
        """The same with another prediction of the unseen frames."""
        return replace(self, expected=expected)

    def score(self, light: Light) -> Score:
        """Of the unseen frames in such light as `light` is."""
        measured = self.measured if light.still is None else (self.measured / light.still).to(self.measured.dtype)
        known = light.background
        lit = self.expected.double() if known is None else lit_by_halves(measured, self.expected, known)
        return score_of(self.measured, lit if light.still is None else lit * light.still)


class Trials:
    """The hypotheses about some frames, each carried to a volume in every fold that is asked for."""

    def __init__(self, first: FirstVolumes, options: LightOptions) -> None:
        self._first, self._options = first, options

    def tried(self, hypothesis: Hypothesis, fold: int) -> Trial:
        """The volume and the score of a hypothesis."""
        return self._first.once(("light", hypothesis), fold, lambda: self._made(hypothesis, fold))

    def proposed(self, hypothesis: Hypothesis, fold: int = 0) -> bool:
        """Whether the last part of a hypothesis changes frames by more than the margin of what is left without it: a
        smaller correction could not take that away, and needs no volume."""
        before = self.tried(hypothesis[:-1], fold)
        light = self._light(hypothesis, fold)
        if light is None:
            return False
        change = (light.factor() / before.light.factor() - 1).square().mean()
        left = before.light.evened(torch.from_numpy(before.seen.frames)) - before.predicted
        power = float(change) + max(light.noise.grain_level**2 - before.light.noise.grain_level**2, 0.0)
        return power > MARGIN**2 * float(left.double().square().mean())

    def score(self, name: str, fold: int) -> Score:
        """That of a hypothesis by its name."""
        plain, _, free = name.partition(FREE)
        parts = () if plain == NULL else tuple(plain.split(" and "))
        tried = self.tried(parts, fold)
        if not free:
            return tried.score(tried.light)
        known = self._light((*parts, free), fold)
        assert known is not None  # it was proposed
        return tried.score(known)

    def _light(self, hypothesis: Hypothesis, fold: int) -> Light | None:
        """What a hypothesis says of the fitted frames, by the volume without its last part; None where it cannot be."""
        return self._first.once(("light of", hypothesis), fold, lambda: self._found(hypothesis, fold))

    def _found(self, hypothesis: Hypothesis, fold: int) -> Light | None:
        if not hypothesis:
            frames = torch.from_numpy(self._first.folds.split(fold)[0].frames)
            return plain_light(frames, self._options)
        before = self.tried(hypothesis[:-1], fold)
        return with_more(before.light, hypothesis[-1], before.seen, before.predicted, self._options)

    def _made(self, hypothesis: Hypothesis, fold: int) -> Trial:
        seen, unseen = self._first.folds.split(fold)
        light = self._light(hypothesis, fold)
        assert light is not None
        volume = self._first.volume(seen, light)
        return Trial(volume, light, seen, unseen, predictions(volume, unseen))


def first_of_task(task: Task, backend: Backend = "auto") -> FirstVolumes:
    """The first volumes that the decisions of a task share, computed by `backend` where they are new."""
    if task.first is not None:
        return task.first
    one_time = task.scan.at_instant(len(task.scan.instants) // 2) if task.scan.is_series else task.scan
    found = FirstVolumes(Folds.of(one_time), task.prior, task.on_progress)
    return replace(found, options=replace(found.options, backend=backend))


def accepted(task: Task, first: FirstVolumes, fold: int) -> Trial:
    """The trial of what was decided of light and noise, in a fold."""
    return Trials(first, task.light).tried(first.taken, fold)


def plain_light(frames: Tensor, options: LightOptions) -> Light:
    """Even light and white noise."""
    air = options.air_of(frames)
    return Light(air, NoiseModel.of_frames(frames, air), None)


def with_more(light: Light, hypothesis: str, seen: Scan, predicted: Tensor, options: LightOptions) -> Light | None:
    """`light` and what a hypothesis adds to it, by frames and their prediction [V, H, W] in even light; None where it
    cannot be: a pattern of one frame, or light where none shows air."""
    frames = torch.from_numpy(seen.frames)
    if hypothesis == "fixed pattern":
        return replace(light, still=fixed_pattern(light.evened(frames), predicted)) if len(seen) > 1 else None
    if hypothesis == "correlated noise":
        return replace(light, noise=NoiseModel.of_residuals(light.evened(frames), predicted))
    if hypothesis == FLUX:
        known = light.background is not None  # then it holds the flux
        return None if known else replace(light, background=Background.of_flux(light.evened(frames), predicted))
    try:
        found = Light.of(
            frames if light.still is None else (frames / light.still).float(), replace(options, kind="smooth")
        )
    except InputError:  # no frame shows air
        return None
    return replace(found, still=light.still)


def decided(
    first: FirstVolumes, options: LightOptions, told: Hypothesis, hypotheses: tuple[str, ...]
) -> tuple[Hypothesis, tuple[Decision, ...]]:
    """The hypotheses that are added to what is told, one after another as long as one of the rest wins, and how."""
    trials, taken, made = Trials(first, options), told, list[Decision]()
    if first.folds.by == BY_FISSION:  # of two views, a pattern is what volumes leave in both
        hypotheses = tuple(one for one in hypotheses if one != "fixed pattern")
    while left := [one for one in hypotheses if one not in taken and trials.proposed((*taken, one))]:
        null = " and ".join(taken) or NULL
        names = [" and ".join((*taken, one)) for one in left]
        beside = {name: (null + FREE + one,) for name, one in zip(names, left) if one in (FLUX, UNEVEN)}
        decision = select(STAGE, (null, *names), trials.score, first.folds.count, by=first.folds.by, beside=beside)
        made.append(decision)
        if decision.choice == null:
            break
        taken = tuple(decision.choice.split(" and "))
    return taken, tuple(made)


def prepared(task: Task, method: Method | None = None, before: Prepared | None = None) -> Task:
    """The task with frames in even light, where evidence or `task.light` says that their light was not even; and, where
    nothing tells it, with the sign of the contrast (`contrast`), which is decided first.

    Frames that were divided by light before stay as they are: what that left open (`Scan.light`) is then what is not
    known of it. A pattern that is an unknown of the `method` itself is not looked for. Of several times the middle one
    decides for all. Errors: those of `Light.of`.
    """
    if task.lit is not None:
        return task
    first = first_of_task(task, _volume_of(method).backend)
    if before is None:
        first, signs = decide_sign(first, *_scores(task.light))
    else:
        signs = tuple(each for each in before[1] if each.name == SIGN)
    task = replace(task, prior=with_sign(task.prior, signs), decisions=(*task.decisions, *signs))
    frames, options, handed = torch.from_numpy(task.scan.frames), task.light, task.scan.light
    if handed is not None and options.kind != "even":
        return replace(task, lit=Light.handed(frames, options, handed))
    light = plain_light(frames, options)
    open_to = [
        one
        for one, free in (
            ("fixed pattern", options.still == "auto" and options.kind != "even" and not still_order(method)),
            (FLUX, options.kind == "auto" and not task.scan.is_series),  # several times have no one volume
            (UNEVEN, options.kind == "auto"),
            ("correlated noise", options.noise == "auto"),
        )
        if free
    ]
    told = tuple([UNEVEN] * (options.kind == "smooth"))
    if before is None:
        task.on_progress(STAGE, 0.0)
        first.taken, made = decided(first, options, told, tuple(open_to))
        if options.noise == "correlated":
            first.taken = (*first.taken, "correlated noise")
    else:
        first = replace(first, prior=task.prior)
        first.taken, made = before[0], tuple(each for each in before[1] if each.name != SIGN)
    scan, light = _applied(task, light, first.taken)
    return replace(task, scan=scan, lit=light, decisions=(*task.decisions, *made), first=first)


def _scores(options: LightOptions) -> list[Scoring]:
    """The scores of volumes of frames as they were measured, and in smooth light where that may be."""

    def under(hypothesis: Hypothesis, volumes: FirstVolumes, fold: int) -> Score:
        trials = Trials(volumes, options)
        require(not hypothesis or trials.proposed(hypothesis, fold), "the light of the frames is even.")
        tried = trials.tried(hypothesis, fold)
        return tried.score(tried.light)

    return [partial(under, one) for one in ((), (UNEVEN,)) if not one or options.kind != "even"]


def _applied(task: Task, light: Light, taken: Hypothesis) -> tuple[Scan, Light]:
    """The frames in even light, and that light, on the frames' own pixels."""
    frames = torch.from_numpy(task.scan.frames)
    order = [one for one in HYPOTHESES if one in taken]

    def evened() -> Scan:
        return replace(task.scan, frames=light.evened(frames).numpy().astype(np.float32))

    for one in order:
        predicted = frames
        if one != UNEVEN and not task.scan.is_series:
            how = HolographicTV(upper=0.0)
            predicted = predicted_first(evened(), task.prior, how, task.on_progress, light)
        elif one != UNEVEN:
            continue  # several times have no one volume
        found = with_more(light, one, task.scan, predicted, task.light)
        if found is None:
            raise InputError(
                "no frame shows air, by which smooth light could be told from matter; give boxes of it by --air, or "
                "take --light even."
            )
        light = found
    return evened() if order else task.scan, light


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
