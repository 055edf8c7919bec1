"""What to try next where frames are not explained: a sentence and a command for each likely cause; and mistakes in
the metadata of a scan, compared on held-out frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Protocol

import numpy as np
import torch

from ..align import find_axis
from ..checks import InputError
from ..geometry import Views, rotation_y
from ..inference import Decision, Score, select
from ..matter import DeltaBeta, MaterialPrior
from ..methods import Method, Uncertain
from ..methods.cross_validation import predicted_frames
from ..optics.background import LightOptions
from ..progress import Progress
from ..scan import Scan, interleaved_split
from ..tables import overridden
from .run_illumination import light_of

STIFF = "stiff"
"""The cause where no change of the frames explains them: the model of the matter, or views that do not agree."""


@dataclass(frozen=True)
class Step:
    """why: a sentence on what the command does; command: as it is typed, with SCAN for the scan."""

    why: str
    command: str


STEPS = {
    "mass": Step("let the frames find the distance in a range [m] of yours:", "--distance LOW:HIGH"),
    "distance": Step("let the frames find the distance in a range [m] of yours:", "--distance LOW:HIGH"),
    "absorption": Step("let the frames find δ/β in a range of yours:", "--delta-beta LOW:HIGH"),
    "shift_x": Step("find the axis of rotation, then reconstruct the new scan:", "--axis-only"),
    "shift_y": Step("find where the beams are, then reconstruct the new scan:", ""),
    "shifts": Step("find where the beam of each view is, then reconstruct the new scan:", ""),
    "light": Step("find the uneven light of each frame:", "--light smooth"),
    "sign": Step("name the medium, from which δ of the matter differs to the other side:", "--medium MEDIUM"),
    "angles": Step("give the angles of the frames in degrees, in the frames' order:", "--angles FILE"),
    "beyond": Step("let matter lie beyond the field:", "--method volume --set volume.beside=0.5"),
    STIFF: Step("take the matter as continuous, without sharp edges:", "--matter continuous"),
}
"""What to do, by the likeliest cause of a verdict, with the options of the command; of others there is none."""
ALIGNED = ("shift_x", "shift_y", "shifts")
"""Causes that `align` finds; all others are found by `reconstruct`."""


def next_step(cause: str, scan: str = "SCAN") -> Step | None:
    """What to try where `cause` is the likeliest one; None where no command mends it. scan: its name, as typed."""
    step = STEPS.get(cause)
    if step is None:
        return None
    act, out = ("align", "aligned.nxs") if cause in ALIGNED else ("reconstruct", "another_run")
    return replace(step, command=" ".join(filter(None, ("holosplat", act, scan, step.command, "--out", out))))


NULL = "metadata as given"
"""The candidate that leaves scan and prior alone."""
NAME, BY = "mistake in the metadata", "held-out frames"
FEWEST = 4
"""Frames of which one can be held out."""
RANGE = 3.0
"""Factor by which a distance or δ/β may be larger or smaller than given."""


class Again(Protocol):
    """Reconstructs other frames as a run did (`certainty.Again`)."""

    @property
    def prior(self) -> MaterialPrior:
        """That of the run."""
        ...

    @property
    def method(self) -> Method:
        """That of the run."""
        ...

    def __call__(self, scan: Scan, **changed: Any) -> Any:
        """The `Reconstruction` of the training frames of `scan`, with `changed` arguments of `reconstruct`."""
        ...


Change = Callable[[Scan, Again], tuple[Scan, Mapping[str, Any]]]
"""A scan and what is changed of its reconstruction, as `Again` takes it by name, if a mistake is put right."""


def _other_sign(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
    prior = again.prior
    flipped = [DeltaBeta(-delta, -beta) for delta, beta in prior.materials]
    return scan, {
        "prior": MaterialPrior.known(*flipped) if flipped else prior.signed(-1 if prior.delta_sign > 0 else 1)
    }


def _axis(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
    return replace(scan, exposures=find_axis(scan.train()).applied(scan.exposures)), {}


def _turned(angles: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Other angles [rad] than those of the scan."""

    def change(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
        views = scan.views
        if not views.shares_axis:
            raise InputError("views without a common axis have no angles.")
        rotations = rotation_y(np.rad2deg(angles(np.unwrap(angles_of(views)))))
        return replace(scan, exposures=replace(scan.exposures, views=replace(views, rotations=rotations))), {}

    return change


def angles_of(views: Views) -> np.ndarray:
    """Angles [V] about the y axis, in radians from -π to π."""
    return np.arctan2(views.rotations[:, 0, 2], views.rotations[:, 0, 0])


def _spread(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
    return scan, {"uncertain": Uncertain(distance=_about(float(np.median(scan.exposures.distance))))}


def _ratio(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
    prior = again.prior
    ratio = prior.materials[0].ratio if prior.materials else getattr(prior, "ratio", 0.0)
    if not ratio or len(prior.materials) > 1:
        raise InputError("there is no one known ratio δ/β.")
    return scan, {"prior": MaterialPrior.unknown(prior.sign), "uncertain": Uncertain(delta_beta=_about(abs(ratio)))}


def _about(value: float) -> tuple[float, float]:
    return value / RANGE, value * RANGE


def _beyond(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
    return scan, {"method": overridden(again.method, ["volume.beside=0.5"])}


def _steps(turn: float) -> Change:
    return _turned(lambda angles: np.arange(len(angles)) * turn / len(angles))


MISTAKES: Mapping[str, tuple[str, Change]] = {
    "axis of rotation": ("shift_x", _axis),
    "other sign of δ": ("sign", _other_sign),
    "angles in reverse order": ("angles", _turned(lambda angles: angles[::-1])),
    "angles in radians": ("angles", _turned(lambda angles: np.rad2deg(angles))),
    "twice the angles": ("angles", _turned(lambda angles: 2 * angles)),
    "half the angles": ("angles", _turned(lambda angles: 0.5 * angles)),
    "equal steps over 180°": ("angles", _steps(np.pi)),
    "equal steps over 360°": ("angles", _steps(2 * np.pi)),
    "uneven light": ("light", lambda scan, again: (scan, {"light": LightOptions("smooth")})),
    "distance": ("distance", _spread),
    "δ/β": ("absorption", _ratio),
    "continuous matter": (STIFF, lambda scan, again: (scan, {"matter": "continuous"})),
    "matter beyond the field": ("beyond", _beyond),
}
"""Mistakes from simple to complex: each with the key of `STEPS`, and what puts it right."""


def compare_causes(scan: Scan, again: Again, on_progress: Progress = lambda stage, fraction: None) -> Decision:
    """Which of `MISTAKES`, put right, predicts held-out frames better than the metadata as given, the null.

    Without held-out frames, every fourth one is held out. Another sense of rotation is none of the mistakes: the
    mirrored object gives the same frames. The choice is a key of `STEPS`, or the null.
    """
    if len(scan) < FEWEST:
        return Decision(NAME, NULL, f"fewer than {FEWEST} frames, of which none can be held out")
    scan = scan if scan.is_test.any() else replace(scan, is_test=interleaved_split(len(scan)))
    keys = {name: key for name, (key, _) in MISTAKES.items()} | {NULL: NULL}
    order = list(MISTAKES)

    @cache
    def score(name: str) -> Score:
        changed, how = (scan, {}) if name == NULL else MISTAKES[name][1](scan, again)
        found = again(changed, **how)
        placed = found.placed(changed)
        lit, test = light_of(placed, found.light, found.still), placed.test()
        predicted = predicted_frames(test.exposures, found.object, found.oversample)
        lamp = 1.0 if lit is None else lit.factor()[torch.from_numpy(scan.is_test)].to(predicted)
        return Score.of(test.left(predicted * lamp))

    possible = [NULL]
    for number, name in enumerate(order):
        on_progress(f"cause: {name}", number / len(order))
        try:
            score(name)
        except InputError:  # this mistake cannot have been made here
            continue
        possible.append(name)
    decision = select(NAME, possible, lambda name, fold: score(name), by=BY)
    return replace(decision, choice=keys[decision.choice])
