"""Decisions by unseen frames: hypotheses about light and noise, each carried as far as a volume in every fold of the
coarse frames; and whether Gaussians or the surfaces cut out of them predict better. Training frames prefer the freer of
these two kinds, which also explains by half a density what is in the wrong place.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from ..backends import coarse_work
from ..checks import InputError, NoMatterError, require
from ..inference import MARGIN, Decision, Score, select
from ..optics.background import FLUX, ORDER, Background, Light, LightOptions
from ..optics.noise import NoiseModel
from ..optics.patterns import fixed_pattern, smooth_modes
from ..representations import Stored, VoxelGrid
from ..scan import Scan
from .cross_validation import (
    FirstVolumes,
    Folds,
    coarse_binning,
    lit_by_halves,
    plain_light,
    predicted_frames,
    predictions,
)
from .keeper import NAME, Unseen
from .method import Method, Task, run_stages, unheard
from .spherical import SphericalMatter

NULL = "as measured"
UNEVEN = "uneven light"
FREE = "; of unseen frames free: "
"""A rival of light of each frame's own: the volume before it, whose prediction is allowed the same light."""
WITHOUT = "; without matter"
"""The same without its volume: a volume that predicts frames worse than none decides nothing."""

Predict = Callable[[Light], Tensor]
"""Frames [V, H, W] in even light, as the volume of those that were measured in some light has them."""

Hypothesis = tuple[str, ...]
"""What is added to the null, in the order in which it was taken."""


def name_of(hypothesis: Hypothesis) -> str:
    """What a decision calls it."""
    return " and ".join(hypothesis) or NULL


def named(name: str) -> Hypothesis:
    """The hypothesis of a name that `name_of` gave."""
    return () if name == NULL else tuple(name.split(" and "))


def hypothesis_of(name: str) -> Hypothesis:
    """That of a name, of one of its `rivals`, or of the same without matter."""
    return named(name.partition(";")[0])


def rivals(before: Hypothesis, one: str) -> tuple[str, ...]:
    """What `one` must win against beside the hypothesis `before` it: where it is light of each frame's own, the volume
    before it in such light."""
    return (name_of(before) + FREE + one,) if one in (FLUX, UNEVEN) else ()


@dataclass(frozen=True)
class Trial:
    """A hypothesis in a fold. volume: by the fitted frames `seen`; light: what the hypothesis says of these; unseen,
    expected: the frames that are not fitted, and what the volume predicts for them in even light"""

    volume: VoxelGrid | SphericalMatter
    light: Light
    seen: Scan
    unseen: Scan
    expected: Tensor

    @property
    def measured(self) -> Tensor:
        """The unseen frames [V, H, W]."""
        return self.unseen.measured

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
        return Score.of(self.unseen.left(lit if light.still is None else lit * light.still))


class Trials:
    """The hypotheses about some frames, each carried to a volume in every fold that is asked for."""

    def __init__(self, first: FirstVolumes, options: LightOptions) -> None:
        folds = first.folds
        self.first, self._options = (
            first,
            binned_options(options, folds.shape or folds.scan.views.shape, folds.binning),
        )

    def tried(self, hypothesis: Hypothesis, fold: int) -> Trial:
        """The volume and the score of a hypothesis."""
        return self.first.once(("light", hypothesis), fold, lambda: self._made(hypothesis, fold))

    def proposed(self, hypothesis: Hypothesis, fold: int = 0) -> bool:
        """Whether the last part of a hypothesis changes frames by more than the margin of what is left without it: a
        smaller correction could not take that away, and needs no volume."""
        before = self.tried(hypothesis[:-1], fold)
        light = self._light(hypothesis, fold)
        if light is None:
            return False
        change = (light.factor() / before.light.factor() - 1).square().mean()
        left = before.light.evened(before.seen.measured) - before.predicted
        power = float(change) + max(light.noise.grain_level**2 - before.light.noise.grain_level**2, 0.0)
        return power > MARGIN**2 * float(left.double().square().nanmean())

    def score(self, name: str, fold: int) -> Score:
        """That of a hypothesis by its name, of one of its `rivals`, or of the same without matter."""
        return self.score_of(name, fold, self.tried(hypothesis_of(name), fold).expected)

    def score_of(self, name: str, fold: int, expected: Tensor) -> Score:
        """The same where a volume predicts the unseen frames `expected` [V, H, W] in even light."""
        plain, _, free = name.removesuffix(WITHOUT).partition(FREE)
        light = self._light((*named(plain), free) if free else named(plain), fold)
        assert light is not None  # it was proposed
        expected = torch.ones_like(expected) if name.endswith(WITHOUT) else expected
        return self.tried(named(plain), fold).of(expected).score(light)

    def _light(self, hypothesis: Hypothesis, fold: int) -> Light | None:
        """What a hypothesis says of the fitted frames, by the volume without its last part.

        None where it says nothing of those of the first fold, for which it is proposed; of a later fold it then adds
        nothing.
        """
        found = self.first.once(("light of", hypothesis), fold, lambda: self._found(hypothesis, fold))
        return self._light(hypothesis[:-1], fold) if found is None and fold else found

    def _found(self, hypothesis: Hypothesis, fold: int) -> Light | None:
        if not hypothesis:
            frames = self.first.folds.split(fold)[0].measured
            return plain_light(frames, self._options)
        before = self.tried(hypothesis[:-1], fold)

        def predict(light: Light) -> Tensor:
            same = light is before.light
            return before.predicted if same else predictions(self.first.volume(fold, light), before.seen)

        return with_more(before.light, hypothesis[-1], before.seen, predict, self._options)

    def _made(self, hypothesis: Hypothesis, fold: int) -> Trial:
        seen, unseen = self.first.folds.split(fold)
        light = self._light(hypothesis, fold)
        require(
            light is not None, "--light must be even or auto, but it is smooth, and a part of the frames shows no air."
        )
        assert light is not None
        volume = self.first.volume(fold, light)
        return Trial(volume, light, seen, unseen, predictions(volume, unseen))


def accepted(task: Task, first: FirstVolumes, fold: int) -> Trial:
    """The trial of what was decided of light and noise, in a fold."""
    return Trials(first, task.light).tried(first.taken, fold)


def with_more(light: Light, hypothesis: str, seen: Scan, predict: Predict, options: LightOptions) -> Light | None:
    """`light` and what a hypothesis adds to it, by frames and what volumes predict of them in even light; None where it
    cannot be: a pattern of one frame, or light where none shows air. The volume that tells flux from absorption is made
    in light of unknown flux. Smooth light is that of coarse pixels, on which it is compared: on finer ones, what passes
    for air may be matter."""
    frames = seen.measured
    if hypothesis == "fixed pattern":
        if len(seen) < 2:
            return None
        views = seen.views
        axis = 0.5 * (views.shape[1] - 1) - float((views.shifts[:, 0] / views.pixel_sizes).mean())
        return replace(light, still=fixed_pattern(light.evened(frames), predict(light), axis))
    if hypothesis == "correlated noise":
        return replace(light, noise=NoiseModel.of_residuals(light.evened(frames), predict(light)))
    if hypothesis == FLUX:
        if light.background is not None:
            return None  # it holds the flux
        even = light.evened(frames)
        unknown = Background.unknown_flux(even)
        if unknown.size_of_doubt == 0:
            return light  # the means differ no more than by noise
        return replace(light, background=Background.of_flux(even, predict(replace(light, background=unknown))))
    frames, factor = frames if light.still is None else (frames / light.still).float(), coarse_binning(seen)
    smooth = replace(binned_options(options, seen.views.shape, factor), kind="smooth")
    try:
        found = Light.of(replace(seen, frames=frames.numpy()).binned(factor).measured, smooth)
    except InputError:  # no frame shows air
        return None
    return replace(finer_light(found, frames, factor), still=light.still)


def binned_options(options: LightOptions, shape: tuple[int, int], factor: int) -> LightOptions:
    """`options` of frames of `shape` (H, W) for pixels `factor` times larger, as `Scan.binned` makes them: boxes of air
    hold the pixels that lie in them, or else the one about their middle."""
    if factor == 1 or not options.air:
        return options

    def side(first: int, end: int, count: int) -> tuple[int, int]:
        cut, few = (count % factor) // 2, count // factor
        start, stop = max(0, -((cut - first) // factor)), min((end - cut) // factor, few)
        middle = min(max(0, ((first + end) // 2 - cut) // factor), few - 1)
        return (start, stop) if start < stop else (middle, middle + 1)

    boxes = [(*side(top, bottom, shape[0]), *side(left, right, shape[1])) for top, bottom, left, right in options.air]
    return replace(options, air=tuple(boxes))


def finer_light(light: Light, frames: Tensor, factor: int) -> Light:
    """`light` of frames that were binned by `factor` out of `frames` [V, H, W], for these, in the same air.

    Their noise in even light is white: that it is correlated is a hypothesis of its own.
    """
    air, background, shape = light.air, light.background, (frames.shape[-2], frames.shape[-1])
    if factor > 1 and background is not None:
        air = _spread(air[:, None].double(), shape, factor, "nearest")[:, 0] > 0.5
        background = _finer(background, shape, factor)
    even = frames if background is None else frames / background.factor()
    return Light(air, NoiseModel.of_frames(even, air), background)


def _finer(known: Background, shape: tuple[int, int], factor: int) -> Background:
    """The modes of the coarse frames between their pixels, as modes of the fine ones, as `Background.binned` does."""
    fine = smooth_modes(shape, ORDER).double().flatten(1)
    old = _spread(smooth_modes(known.shape, ORDER).double()[None], shape, factor, "bicubic")[0].flatten(1)
    change = fine @ old.T / old.shape[1]
    covariances = change @ known.covariances @ change.T
    return Background(known.coefficients @ change.T, covariances, known.variances, known.powers * factor**2, shape)


def _spread(images: Tensor, shape: tuple[int, int], factor: int, how: str) -> Tensor:
    """Images [N, C, h, w] on pixels `factor` times smaller, out to the rows and columns that binning cut."""
    wide = interpolate(images, scale_factor=factor, mode=how)
    (top, bottom), (left, right) = (
        ((n % factor) // 2, n - few - (n % factor) // 2) for n, few in zip(shape, wide.shape[-2:])
    )
    return pad(wide, (left, right, top, bottom), mode="replicate")


KIND = "kinds of results"


def unseen_kinds(task: Task, method: Method) -> Unseen | None:
    """What decides between kinds of results of a run; None where there is one kind, or where poses are free, for those
    of unseen views are not known."""
    return partial(decide_kind, task, method) if method.mixes_kinds and task.freedom is None else None


class _NotMade(Exception):
    """A kind that a run on coarse frames does not make."""


@coarse_work()
def decide_kind(task: Task, method: Method, null: str, other: str) -> Decision | None:
    """Which kind of result predicts unseen views, where `method` makes both on its way; null: the kind of its last one.

    The method runs on coarse frames of the other views, with all of its steps: the first ones may say the opposite.
    Where it does not make both there, they cannot be compared: None. Two views are compared by data fission.
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
            run_stages(method, part, look)
        expected = {kind: predicted_frames(unseen.exposures, *state) for kind, state in last.items()}
        return {kind: Score.of(unseen.left(frames.double())) for kind, frames in expected.items()}

    def score(kind: str, fold: int) -> Score:
        if kind not in scores(fold):
            raise _NotMade
        return scores(fold)[kind]

    task.on_progress(KIND, 0.0)
    try:
        return select(NAME, (null, other), score, folds.count, by=folds.by)
    except _NotMade:
        return None
