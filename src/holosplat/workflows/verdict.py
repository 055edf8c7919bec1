"""The verdict on a run: does the reconstruction explain the frames to within their noise, and if not, why not?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ..align import find_axis
from ..checks import InputError, as_written
from ..fit.misfit_diagnosis import Cause, cause_scores, likely_causes
from ..fit.residuals import Prediction, Residuals, residuals, split_validation
from ..fit.run import Running
from ..frames import evenly
from ..methods import Task
from ..model import LightField, Model, SolvedLight
from ..optics.noise import NoiseModel, noise_levels
from ..representations import Stored, VoxelGrid
from ..scan import Scan
from ..units import in_percent, plain, two_digits
from .next_step import STIFF, next_step

TOO_MUCH = 1.15
"""Residual over what is allowed (rms) from which on a band counts as unexplained."""
SURE = 5.0
"""Standard deviations of chance from which on something counts as seen."""
SCATTER = 3.0
"""Standard deviations by which a band's mean power may exceed that limit by chance."""
FEWEST_ROWS = 11
"""Rows and columns from which on air and grain are looked for in frames."""
NOISELESS = 0.02
"""Noise, as a share of the contrast, below which frames count as free of noise."""
LARGE = {"mass": 0.1, "distance": 0.1, "shift_x": 0.3, "shift_y": 0.3}
"""Changes (shares; pixels) that count as a fault by themselves, whatever the bands say, if they are seen."""
BELOW = 0.8
"""Residual over noise (rms) below which a fit has followed the noise."""
ODD = 1.5
"""Residual of a view over the median one (rms) from which on the view is named."""
MANIFOLD = 2.0
"""Residual over contrast from which on it is said as a factor, not in per cent."""
NOISE_TOLD = 0.05
"""Share of the noise's power that its estimate may be wrong by."""
POWERS = ("residual", "noise", "contrast", "allowed")
"""What residuals have the power of, by view and band."""
MOST_VIEWS = 4
"""Views that are named, at most."""


@dataclass(frozen=True)
class Verdict:
    """What the residual of a reconstruction says. Root mean squares by view and band, of coefficients of `rfft2`.

    good: whether the frames are explained
    words: that in one sentence
    reasons: likely causes, one sentence each, and other remarks
    periods: [B, 2] shortest and longest period of each band [m]; the longest of the first is infinite
    residual, noise, contrast, allowed: [V, B] of what is left, of the frames' noise, of the frames minus one, and of
        what a residual may have
    tested: each change of the frames that was tested by itself: its value (mean over views), error, significance and
        share of the excess
    cause: the likeliest cause, a key of `next_step.STEPS`; empty where none is known
    """

    good: bool
    words: str
    reasons: tuple[str, ...]
    periods: np.ndarray
    residual: np.ndarray
    noise: np.ndarray
    contrast: np.ndarray
    allowed: np.ndarray
    tested: dict[str, dict[str, float]]
    cause: str = ""

    def lines(self, frames: str) -> list[str]:
        """The verdict on `frames`, such as "training frames", as lines of text; the last is what to do next."""
        step = next_step(self.cause)
        last = [f"  Next: {step.why} {step.command}"] if step else []
        return [f"{frames}: {self.words}", *(f"  {reason}" for reason in self.reasons), *last]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON; `from_dict` reads them."""
        arrays = {name: [[float(f"{v:.4g}") for v in row] for row in getattr(self, name).tolist()] for name in POWERS}
        periods = [[low, None if math.isinf(high) else high] for low, high in self.periods.tolist()]
        plain = {"good": self.good, "words": self.words, "reasons": list(self.reasons), "periods_m": periods}
        return plain | arrays | {"tested": self.tested, "cause": self.cause}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Verdict:
        """The verdict that `as_dict` described; `InputError` for anything else."""
        with as_written("a verdict", "what reconstruct wrote"):
            periods = [[low, math.inf if high is None else high] for low, high in values["periods_m"]]
            return cls(
                good=bool(values["good"]),
                words=str(values["words"]),
                reasons=tuple(str(reason) for reason in values["reasons"]),
                periods=np.array(periods, dtype=np.float64),
                **{name: np.array(values[name], dtype=np.float64) for name in POWERS},
                tested=dict(values["tested"]),
                cause=str(values.get("cause", "")),
            )


LEAVES = (
    "Likely cause: matter goes on above or below the frames, for the outermost rows have as much of it as the others. "
    "What lies beyond is not known, so that matter is wrong near these rows and, of soft matter, far from them; take "
    "frames of more rows, to where the matter ends."
)
LEAVES_ASIDE = (
    "Likely cause: matter goes on at the sides of the frames, for the outermost columns have as much of it as the "
    "others. It lies on the rays of other views, which take it for matter inside; if it is sparse, make it an unknown "
    "by --method voxels --set volume.beside=0.5, else take frames of more columns."
)
NOTHING = "No matter was found: the frames are noise to within what is known of it, or matter is fainter than that."
"""The verdict on an empty object that explains its frames: right where nothing was in the beam, wrong otherwise."""
OF_NOISE = "What the volume holds was fitted to noise."
HELP = (
    "If something was in the beam, take more photons, join pixels (--bin), or give more of what is known (--material)."
)
OUTERMOST, LEAVING, FEW_VIEWS = 2, 0.3, 4
"""Rows or columns at either edge, the part of the mean thickness from which on matter goes on there, and the views that
are looked at."""


def judge(said: Prediction, frames: Scan, noise: NoiseModel | None = None) -> Verdict:
    """The verdict on a prediction of `frames`, whose exposures the prediction has; noise: None to estimate it."""
    measured = torch.from_numpy(frames.frames)
    left = residuals(said, measured, (noise or _noise(frames.measured)).power(), missing=frames.gaps)
    found = verdict(left)
    if found.cause == STIFF and isinstance(said.object, VoxelGrid):  # it has neither levels nor sharp edges to give up
        found = replace(found, cause="")
    views = said.exposures.views
    few = evenly(len(views), FEW_VIEWS)
    with torch.no_grad():
        beta, delta = said.object.project(views[few])
    absorbing, refracting = beta.abs().cpu(), delta.abs().cpu()
    if not bool(absorbing.any() or refracting.any()):
        return replace(found, good=False, words=NOTHING, reasons=(HELP, *found.reasons)) if found.good else found
    if _shows_nothing(left):
        return replace(found, good=False, words=NOTHING, reasons=(OF_NOISE, HELP), cause="")
    if found.good:
        return found
    leaves = tuple(why for axis, why in ((1, LEAVES), (2, LEAVES_ASIDE)) if _leaves_the_field(refracting, axis))
    return replace(found, reasons=(*leaves, *found.reasons), cause="") if leaves else found


def _leaves_the_field(matter: torch.Tensor, axis: int) -> bool:
    """Whether about as much `matter` [v, H, W] is in the outermost rows (axis 1) or columns (2) as in the others."""
    count = matter.shape[axis]
    outer = [matter.narrow(axis, at, min(OUTERMOST, count)) for at in (0, max(0, count - OUTERMOST))]
    return float(torch.cat(outer, dim=axis).mean()) > LEAVING * float(matter.mean())


def _shows_nothing(found: Residuals) -> bool:
    """Whether frames have no more power than their noise in any band, whatever was fitted to them."""
    counts, views = found.rings.counts, len(found.contrast)
    chance = SURE * np.sqrt(2 / (counts * views))
    return bool((found.contrast.mean(axis=0) <= (1 + NOISE_TOLD + chance) * found.noise.mean(axis=0)).all())


def _noise(frames: torch.Tensor) -> NoiseModel:
    """The noise of `frames`; of few rows it is taken for white, for they are too few to find air in."""
    shape = (frames.shape[1], frames.shape[2])
    if min(shape) < FEWEST_ROWS:
        return NoiseModel.white_only(noise_levels(frames), shape)
    return NoiseModel.of_frames(frames)


MOST_TOLD, MOST_NUMBERS = 5, 12
"""Unexplained times of which a terminal says why, and which are named, at most."""


def said_of_times(judged: Sequence[tuple[int, bool, str]], count: int) -> list[str]:
    """Which of `count` times are not explained, and why; how many are, where all are. judged: number, whether its
    frames are explained, and why, of each time of which that is known."""
    bad = [(number, words) for number, good, words in judged if not good]
    if not bad:
        return [f"the frames of {len(judged)} of {count} times are explained"]
    said = f"the frames of {len(bad)} of {count} times are not explained, do not trust them: "
    why = (f"  time {number}: {words}" for number, words in bad[:MOST_TOLD])
    return [said + some([number for number, _ in bad]), *why]


def some(numbers: Sequence[int]) -> str:
    """The first of some numbers."""
    shown = ", ".join(str(number) for number in numbers[:MOST_NUMBERS])
    return shown if len(numbers) <= MOST_NUMBERS else f"{shown} …"


def judge_run(found: Stored, fit: Running | None, task: Task, oversample: int) -> Verdict:
    """The verdict on the frames that were fitted, or on all training frames where nothing was.

    Frames in uneven light are flat-field corrected; the uncertainty of the light counts as noise.
    """
    said, fitted = said_of_run(found, fit, task, oversample)
    verdict = judge(said, fitted, task.noise if task.uneven and said.light is None else None)
    return verdict if verdict.good else _about_another_axis(verdict, task.scan)


def _about_another_axis(found: Verdict, frames: Scan) -> Verdict:
    """The verdict with the axis of rotation as the likeliest cause, where projections tell for sure that it is
    elsewhere, and unseen views do not refute it: matter that was fitted about a wrong one has followed it, so that the
    residual does not show it."""
    if frames.is_series:
        return found
    try:
        axis = find_axis(frames)
    except InputError:  # no common axis, or nothing to tell it by
        return found
    offset = axis.offset
    if axis.stays or abs(offset.value) < LARGE["shift_x"] or not offset.compared("another axis").wins:
        return found
    reason = (
        f"Likely cause: the axis of rotation is {abs(offset.value):.2g} ± {offset.error:.1g} px to the "
        f"{'right' if offset.value > 0 else 'left'} of where the scan says: there the projections agree."
    )
    return replace(found, reasons=(reason, *found.reasons), cause="shift_x")


def said_of_run(found: Stored, fit: Running | None, task: Task, oversample: int) -> tuple[Prediction, Scan]:
    """What a run says of its frames, and these: those that were fitted, or all training frames where nothing was."""
    train = task.scan
    if fit is None:
        return Prediction(found, train.exposures, oversample, backend=found.backend), train
    # the frames of `task` are where the fit has found them
    fitted, light = split_validation(train, fit.aside)[0], _in_memory(fit.result())
    return Prediction(found, fitted.exposures, oversample, None, light, found.backend), fitted


def _in_memory(model: Model) -> LightField | None:
    """The light of a model, on the CPU."""
    light = model.light
    if isinstance(light, SolvedLight):
        with torch.no_grad():
            light = light.settled(replace(model, light=None).frames())
    return light and replace(light, coefficients=light.coefficients.cpu(), modes=light.modes.cpu())


def verdict(found: Residuals) -> Verdict:
    """What residuals say, in words."""
    counts, views = found.rings.counts, len(found.residual)
    over = found.residual.mean(axis=0) / found.allowed.mean(axis=0)
    limit = TOO_MUCH**2 * (1 + SCATTER * np.sqrt(2 / (counts * views)))
    bad, single = np.flatnonzero(over > limit), cause_scores(found)
    faults = [name for name, size in LARGE.items() if _is_fault(single[name], size)]
    good, cause = not len(bad) and not faults, next(iter(faults), "")
    if len(bad):
        named = likely_causes(found)
        cause = named[0].name if named else STIFF
        reasons = _reasons(found, named, single)
        words = _unexplained(found, bad, over)
    elif faults:
        reasons = tuple(f"It would be explained better with {_said(single[name])}." for name in faults)
        words = "The frames are explained band by band, but not as a whole."
    else:
        reasons, words = (), _explained(found, counts)
    return Verdict(
        good=good,
        words=words,
        reasons=(*reasons, *_remarks(found, counts)),
        periods=np.array([found.rings.periods(b) for b in range(len(counts))]),
        **{name: np.sqrt(getattr(found, name)) for name in POWERS},
        tested={name: _numbers(each) for name, each in single.items()},
        cause=cause,
    )


def _is_fault(cause: Cause, size: float) -> bool:
    return abs(float(cause.value[0])) >= size and cause.significance >= SURE


def _explained(found: Residuals, counts: np.ndarray) -> str:
    powers = found.residual, found.noise, found.contrast, found.allowed
    residual, noise, contrast, allowed = (_rms(power, counts) for power in powers)
    if noise < NOISELESS * contrast:
        return (
            f"The frames are explained to {in_percent(residual / contrast)} of their contrast; their noise is below "
            f"{in_percent(NOISELESS)} of it."
        )
    times = two_digits(residual / noise)
    if residual > TOO_MUCH * noise:
        of_both = f"{times} times the noise, {two_digits(residual / allowed)} of both"
        return f"The frames are explained to within noise and model error: the residual is {of_both}."
    return f"The frames are explained to within their noise: the residual is {times} of it."


def _unexplained(found: Residuals, bad: np.ndarray, over: np.ndarray) -> str:
    worst = int(bad[np.argmax(over[bad])])
    first = last = worst
    while first - 1 in bad:
        first -= 1
    while last + 1 in bad:
        last += 1
    residual, noise, contrast = (p.mean(axis=0)[worst] ** 0.5 for p in (found.residual, found.noise, found.contrast))
    noisy = _rms(found.noise, found.rings.counts) > NOISELESS * _rms(found.contrast, found.rings.counts)
    size = (
        f"{two_digits(residual / noise)} times the noise"
        if noisy
        else _of_contrast(residual / max(contrast, np.finfo(float).tiny))
    )
    wide = _band(found.rings.periods(last)[0], found.rings.periods(first)[1])
    said = "" if first == last else f"; it is too large at all periods {wide}"
    return (
        f"The frames are not explained: the residual is {size} at periods {_band(*found.rings.periods(worst))}{said}."
    )


def _of_contrast(share: float) -> str:
    """A residual over the contrast, in words; beyond `MANIFOLD` no share of it."""
    return f"{two_digits(share)} times the contrast" if share > MANIFOLD else f"{in_percent(share)} of the contrast"


def _reasons(found: Residuals, named: list[Cause], single: Mapping[str, Cause]) -> tuple[str, ...]:
    sentences = []
    for number, cause in enumerate(named):
        also = [] if number else [c for c in single.values() if _rivals(c, cause)]
        either = " or ".join(_said(c) for c in (cause, *also))
        sentences.append(
            f"Likely cause: the frames would be explained better with {either} "
            f"({min(cause.significance, 9999):.0f} σ; {in_percent(min(cause.share, 1.0))} of what is too much)."
        )
    if not sentences:
        sentences.append(
            "None of distance, blur, light, shifts of views, mass and absorption explains it: the method's model of "
            "the matter is too stiff (levels, bounds, smoothness), or the views do not agree with each other."
        )
    return tuple(sentences)


def _rivals(one: Cause, best: Cause) -> bool:
    """Whether a change that all views share explains nearly as much as the best: frames hardly tell them apart."""
    return one.name != best.name and one.name not in ("light", "shifts") and one.gain > 0.8 * best.gain


def _said(cause: Cause) -> str:
    """A change in words."""
    value, error = cause.value, cause.error
    if cause.name == "light":
        return f"uneven light in each frame, of {in_percent(float(np.sqrt((value**2).sum(axis=1).mean())))} (rms)"
    if cause.name == "shifts":
        largest = float(np.abs(value).max())
        return f"single views shifted (by up to {largest:.2g} px)"
    number, size = float(value[0]), f"{abs(value[0]):.2g} ± {error[0]:.1g}"
    return {
        "mass": f"{in_percent(abs(number))} {'more' if number > 0 else 'less'} matter",
        "absorption": f"{in_percent(abs(number))} {'more' if number > 0 else 'less'} absorption (another δ/β)",
        "distance": f"a distance {in_percent(abs(number))} {'longer' if number > 0 else 'shorter'}",
        "blur": f"a point-spread function {'wider' if number > 0 else 'narrower'} by {abs(number) ** 0.5:.2g} px",
        "shift_x": f"the axis of rotation {size} px to the {'left' if number > 0 else 'right'}",
        "shift_y": f"the detector {size} px {'lower' if number > 0 else 'higher'}",
    }[cause.name]


def _remarks(found: Residuals, counts: np.ndarray) -> tuple[str, ...]:
    """Single views that stand out, and a fit that followed the noise."""
    remarks = []
    of_view = np.sqrt((found.residual * counts).sum(axis=1) / (found.allowed * counts).sum(axis=1))
    odd = np.flatnonzero(of_view > ODD * max(float(np.median(of_view)), TOO_MUCH / ODD))
    if len(odd):
        odd = odd[np.argsort(-of_view[odd])]
        listed = ", ".join(
            f"{i + 1} ({two_digits(of_view[i] / np.median(of_view))} times the median)" for i in odd[:MOST_VIEWS]
        )
        more = f" and {len(odd) - MOST_VIEWS} more" if len(odd) > MOST_VIEWS else ""
        remarks.append(f"Views that stand out, counted from 1: {listed}{more}; look at their alignment and flux.")
    residual, noise, contrast = (_rms(p, counts) for p in (found.residual, found.noise, found.contrast))
    if noise > NOISELESS * contrast and residual < BELOW * noise:
        remarks.append(
            f"The residual is below the noise ({two_digits(residual / noise)} of it): some of the noise is in the "
            "volume, or the frames' fine structure was taken for noise."
        )
    return tuple(remarks)


def _numbers(cause: Cause) -> dict[str, float]:
    value = cause.value if cause.value.ndim == 1 else np.sqrt((cause.value**2).sum(axis=1).mean(keepdims=True))
    numbers = {"value": value[0], "standard_error": cause.error.mean(), "significance": cause.significance}
    return {name: float(f"{number:.4g}") for name, number in (numbers | {"share": cause.share}).items()}


def _rms(power: np.ndarray, counts: np.ndarray) -> float:
    return float(np.sqrt((power.mean(axis=0) * counts).sum() / counts.sum()))


def _band(shortest: float, longest: float) -> str:
    low = plain(1e6 * shortest)
    return f"above {low} µm" if math.isinf(longest) else f"of {low} to {plain(1e6 * longest)} µm"
