"""Initial geometry from retrieved thickness: centres of mass, mirrored beams, and parameters by rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..geometry import Views
from ..inference import Compared, Decision, Score, select
from ..matter import DeltaBeta
from ..optics.noise import left_of
from ..optics.retrieval import Tikhonov, tikhonov
from ..scan import Scan
from .derivatives import RowInformation, in_pixels
from .row_sums import FACTOR, RowEstimate, RowPrior, by_rows, plane_angles

BY = "the same rows"
SIDES = {"x": (-1,), "y": (-2,), "xy": (-1, -2)}
"""Names of mirror images, and the axes that are reversed."""


def retrieved(scan: Scan, material: DeltaBeta, steps: int) -> Tensor:
    """Thickness [V, H, W] [m] of `material` in the frames of `scan`, in so many steps."""
    how = Tikhonov(iterations=steps)
    return tikhonov(torch.from_numpy(scan.frames), scan.exposures, *material, options=how, missing=scan.gaps)


def shifts_by_mass(thickness: np.ndarray, views: Views) -> np.ndarray:
    """Detector shifts [V, 2] [pixels] beside those of `views` that bring all centres of mass to one point of space.

    thickness: [V, H, W] ≥ 0 of matter that lies in the field of every view. The centre of mass of a projection is the
    projection of the centre of mass (the moment of order one, Helgason 1980); the point is that which asks for the
    least shifts.
    """
    edges = views.relative[:, None]
    seen = centres_of_mass(thickness) + views.shifts / views.pixel_sizes[:, None]
    design = views.rotations[:, :2].reshape(-1, 3)
    point = np.linalg.lstsq(design, (seen * edges).reshape(-1), rcond=1e-9)[0]
    return (design @ point).reshape(-1, 2) / edges - seen


def centres_of_mass(images: np.ndarray) -> np.ndarray:
    """Centres of mass [V, 2] (x, y) [pixels] of images [V, H, W], from the middle of the image."""
    h, w = images.shape[1:]
    at_x, at_y = images.sum(1) @ (np.arange(w) + 0.5 - w / 2), images.sum(2) @ (np.arange(h) + 0.5 - h / 2)
    return np.stack([at_x, at_y], axis=1) / images.sum((1, 2))[:, None]


def mirrored(frames: Tensor, predicted: Tensor) -> list[str]:
    """Compare frames [V, H, W] with those of a volume [V, H, W]: "" or the mirror image that fits, for each.

    One of "x" (columns are reversed), "y" (rows are), "xy".
    """
    images = {"": frames, **{side: frames.flip(axes) for side, axes in SIDES.items()}}
    found = list[str]()
    for v in range(len(frames)):
        scores = {side: Score.of(left_of(image[[v]], predicted[[v]])) for side, image in images.items()}
        found.append(select("mirrored", tuple(scores), lambda side, fold, of=scores: of[side], by="a frame").choice)
    return found


REVERSED, NONE = "reversed beams", "none"
EDGE, PASSING = 1 / 16, 0.25
"""Share of the columns on either side of a frame that are its edge; matter passes it where thickness there is more than
this part of the mean (0.03 to 0.1 with the retrieval's errors alone, 0.4 and more with cells that pass)."""
FIRMLY = 25.0
"""Information, in units of the prior's, from which the angles between two or three beams are free: errors are then a
fifth of what they were. The noise of rows is not independent, so that less of it may be none."""
ANGLE = 3
"""Place of the turn about the axis that all beams are normal to."""


@dataclass(frozen=True)
class RowGeometry:
    """Estimates of V views from rows, lengths in pixels of the images.

    numbers, rates: [V, 5] shifts and turns [rad] at the middle of the times, and how much more at their end
    errors, rate_errors: [V, 5] of them
    before, after: [V] rms of what rows have against being of one object, as a share of their moments
    sides: [V] which mirror image each frame is, or ""
    believed: whether matter lies in the field of every view, else rows need not agree
    words: what they cannot tell; left: of all rows, before and after; decision: on reversed beams
    """

    numbers: np.ndarray
    rates: np.ndarray
    errors: np.ndarray
    rate_errors: np.ndarray
    before: np.ndarray
    after: np.ndarray
    sides: tuple[str, ...]
    believed: bool
    words: tuple[str, ...]
    left: tuple[Score, Score]
    decision: Decision


@dataclass(frozen=True)
class Images:
    """Retrieved thickness [T, V, H, W] of T times, whose views are planned (pixels of the images), and when [T] they
    were taken, from -1 to 1; is_test: [V], views that have no part in the numbers of others."""

    values: np.ndarray
    views: Views
    is_test: np.ndarray
    when: np.ndarray

    @classmethod
    def of(cls, scans: Sequence[Scan], when: Sequence[float], material: DeltaBeta, steps: int) -> Images:
        """Retrieved in `steps`, of scans of the same views."""
        first = scans[0]
        found = torch.stack([retrieved(scan, material, steps) for scan in scans])
        values = found.double().numpy() / first.views.pitch
        return cls(values, in_pixels(first.views), first.is_test, np.asarray(when))

    def passing(self) -> bool:
        """Whether matter passes the left or the right edge of some view."""
        columns, width = self.values.mean(axis=(0, 2)), max(2, round(EDGE * self.values.shape[-1]))
        edges = np.stack([columns[:, :width].mean(1), columns[:, -width:].mean(1)])
        return bool((edges > PASSING * columns.mean(1)).any())

    def reversed(self, view: int, side: str) -> Images:
        """The same with the images of one view reversed."""
        values = self.values.copy()
        values[:, view] = np.flip(values[:, view], SIDES[side])
        return replace(self, values=values)

    def estimate(self, prior: RowPrior, index: np.ndarray) -> RowEstimate:
        """Estimate from the rows of the views `index`, which have `prior`."""
        return by_rows(self.values[:, index], self.views[index], prior, self.when)


def geometry_from_rows(images: Images, expected: np.ndarray, drifts: np.ndarray, few: bool) -> RowGeometry | None:
    """Estimate poses from rows; None for beams that do not lie in one plane.

    expected: [5] standard deviations of shifts [pixels of the images] and turns [rad]; drifts: [5], as in `RowPrior`;
    few: keep the planned angles between beams unless the rows determine them.
    """
    if plane_angles(images.views) is None:
        return None
    train, everything = np.flatnonzero(~images.is_test), np.arange(len(images.views))
    planned = images.estimate(RowPrior.of(np.zeros_like(expected), len(everything)), everything)
    held = expected * (np.arange(len(expected)) != ANGLE) if few else expected
    images, sides, first, compared = _upright(images, train, RowPrior.of(held, len(train)))
    turned = ", ".join(f"beam {v} along {side}" for v, side in enumerate(sides) if side)
    decision = Decision(REVERSED, turned or NONE, BY, compared)
    told, free = RowInformation.of(first.information, images.views[train], expected), held
    if few and len(told.ratios) and told.ratios[0] >= FIRMLY:
        free = expected
    prior = replace(
        RowPrior.of(free, len(train)), drifts=drifts * (free > 0), begin=np.stack([first.numbers, first.rates])
    )
    found = images.estimate(prior, train)
    told = RowInformation.of(found.information, images.views[train], expected)
    whole = images.estimate(_of_others(found, free, images.is_test), everything)
    variances = np.diag(whole.covariance).reshape(2, len(whole.numbers), -1)[0, :, :FACTOR]
    errors, rate_errors = np.sqrt(np.maximum(variances, 0)), np.zeros((len(images.views), len(free)))
    errors[train] = told.errors
    rate_errors[train] = RowInformation.of(found.rate_information, images.views[train], prior.drifts).errors
    errors[:, free == 0] = expected[free == 0]
    return RowGeometry(
        whole.numbers[:, : len(free)],
        whole.rates[:, : len(free)],
        errors,
        rate_errors,
        planned.before,
        whole.after,
        tuple(sides),
        not images.passing(),
        tuple(told.words(FIRMLY if few else 0.0)) if few else (),
        (planned.left, whole.left),
        decision,
    )


def _of_others(found: RowEstimate, free: np.ndarray, is_test: np.ndarray) -> RowPrior:
    """The prior of all views of which those for training are as `found`."""
    begin = np.zeros((2, len(is_test), found.numbers.shape[1]))
    begin[:, ~is_test] = found.numbers, found.rates
    return RowPrior(np.where(is_test[:, None], free, 0.0), np.zeros(len(free)), begin)


def _upright(
    images: Images, train: np.ndarray, prior: RowPrior
) -> tuple[Images, list[str], RowEstimate, tuple[Compared, ...]]:
    """The images with reversed views turned back, which these are, the estimate by training views, and comparisons.

    One view after another is reversed, that which makes rows agree best; the later one of two that are as good. Masses
    of rows tell which are upside down. Columns that are reversed turn the signs of first moments; with two views, any
    two agree. Nothing is looked for where matter passes the edges, and rows need not agree.
    """
    sides, found = [""] * len(images.views), images.estimate(prior, train)
    kinds = tuple(SIDES) if len(train) > 2 else ("y",)
    compared = list[Compared]()
    for _ in range(0 if images.passing() else len(train) // 2):
        tried = {(v, side): images.reversed(v, side) for v in train[::-1] if not sides[v] for side in kinds}
        estimates = {key: each.estimate(prior, train) for key, each in tried.items()}
        gains = {key: each.left.gain_over(found.left) for key, each in estimates.items()}
        best = max(gains, key=lambda key: round(gains[key][0], 3))
        compared.append(Compared(f"beam {best[0]} along {best[1]}", *gains[best]))
        if not compared[-1].wins:
            break
        sides[best[0]], images, found = best[1], tried[best], estimates[best]
    return images, sides, found, tuple(compared)
