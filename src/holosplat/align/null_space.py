"""Directions of pose space that frames do not determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..geometry import Views
from .derivatives import NUMBERS
from .row_sums import COUNT, FACTOR, RETRIEVED

NAMES = ("shift x", "shift y", "turn x", "turn y", "roll")
NOTHING = 1.0
"""Information, in units of the prior's, below which frames add less about a combination than the prior."""
ANGLES = 0.9
"""Share of turns about the axis that all beams are normal to, from which a combination is called an angle."""
STRETCHED = (
    "frames of no object tell the angle between two beams, for an object that is stretched explains them as well: "
    "it is as planned"
)
UNTOLD = "rows say too little of the angles between beams: they are as planned"
PART = 0.35
"""Numbers whose part in a combination is less than this share of the largest are not named."""


@dataclass(frozen=True)
class RowInformation:
    """Information of rows on the 5 parameters of V views (`NAMES`), up to a motion of the whole object.

    errors: [V, 5] standard errors, with what is expected
    ratios: [K] information of each independent combination, over that of what is expected, in growing order
    combinations: [K, V, 5] of numbers in units of their expected deviations
    """

    errors: np.ndarray
    ratios: np.ndarray
    combinations: np.ndarray

    @classmethod
    def of(cls, information: np.ndarray, views: Views, expected: np.ndarray) -> RowInformation:
        """information: [V · 6, V · 6] of a `RowEstimate`; views: planned, lengths in pixels; expected: [5] standard
        deviations, 0 for what is known."""
        count = len(views)
        whole = information + np.diag(np.tile([0.0] * FACTOR + [RETRIEVED**-2], count))
        places = np.arange(count * COUNT).reshape(count, COUNT)
        free = np.tile(expected > 0, count)
        ours, factors = places[:, :FACTOR].reshape(-1)[free], places[:, FACTOR]
        across = whole[np.ix_(ours, factors)]
        information = whole[np.ix_(ours, ours)] - across @ np.linalg.solve(whole[np.ix_(factors, factors)], across.T)
        scales, moved = np.tile(expected, count)[free], motions(views)
        kept = beside(moved[free] @ null(moved[~free]) / scales[:, None])
        ratios, vectors = np.linalg.eigh(kept.T @ (scales[:, None] * information * scales) @ kept)
        combinations, errors = np.zeros((len(ratios), free.size)), np.zeros(free.size)
        combinations[:, free] = (kept @ vectors).T
        errors[free] = scales * np.sqrt((combinations[:, free] ** 2 / (1 + np.maximum(ratios, 0)[:, None])).sum(0))
        return cls(errors.reshape(count, -1), ratios, combinations.reshape(-1, count, FACTOR))

    def words(self, held: float) -> list[str]:
        """Combinations that stay as planned, for frames do not determine them; angles between beams also where their
        information is less than `held`."""
        shares = (self.combinations[:, :, 3] ** 2).sum(1) / (self.combinations**2).sum((1, 2)).clip(1e-12)
        said = []
        if (self.ratios < held)[shares > ANGLES].any():
            said.append(STRETCHED if self.combinations.shape[1] == 2 else UNTOLD)
        for part in self.combinations[(self.ratios < NOTHING) & (shares <= ANGLES)]:
            named = np.argwhere(np.abs(part) > PART * np.abs(part).max())
            which = ", ".join(f"{NAMES[k]} of view {v} ({part[v, k]:+.2f})" for v, k in named)
            said.append(f"rows say less than is known of this combination, which is nearly as planned: {which}")
        return said


def motions(views: Views) -> np.ndarray:
    """[5 V, 6] what three motions and three turns of the whole object do to the numbers of the views.

    Frames are the same if the object moves by t and the detectors by `R t`, or if it turns and the views turn back.
    """
    columns = np.zeros((len(views), FACTOR, 6))
    columns[:, :2, :3] = views.rotations[:, :2]
    columns[:, 2:, 3:] = views.rotations
    return columns.reshape(-1, 6)


def null(matrix: np.ndarray) -> np.ndarray:
    """Orthonormal columns that `matrix` sends to zero."""
    if not len(matrix):
        return np.eye(matrix.shape[1])
    _, sizes, rows = np.linalg.svd(matrix)
    return rows[np.count_nonzero(sizes > 1e-9) :].T


def beside(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns of the space beside that of `columns` [N, K]."""
    basis, sizes, _ = np.linalg.svd(columns)
    return basis[:, np.count_nonzero(sizes > 1e-9 * max(sizes.max(initial=0.0), 1e-12)) :]


HARDLY = 0.3
"""A direction is hardly told if more than this part of its prior standard deviation is left."""
SHARES = 0.35
"""A number belongs to a direction if it has this part of it, in units of its own prior deviation."""


def hardly_told(covariances: Tensor, expected: Tensor) -> list[str]:
    """Describe each direction of pose space that some views hardly determine, given the matter.

    covariances: [V, K, K] of `NUMBERS`, prior included; expected: [K] prior standard deviations, 0 for what stays.
    Numbers are taken in units of these, so that an undetermined direction has the variance 1.
    """
    free = torch.nonzero(expected > 0)[:, 0]
    units = expected[free]
    scaled = covariances[:, free][:, :, free] / (units[:, None] * units)
    values, ways = torch.linalg.eigh(scaled)
    found = dict[str, list[tuple[int, float]]]()
    for view in range(len(covariances)):
        left, way = float(values[view, -1].clamp_min(0).sqrt()), ways[view, :, -1]
        if left > HARDLY:
            parts = [NUMBERS[int(free[k])] for k in torch.nonzero(way.abs() >= SHARES)[:, 0]]
            found.setdefault(" with ".join(parts), []).append((view, left))
    return [
        f"hardly told: {name}, in views {', '.join(str(view) for view, _ in views)} "
        f"({max(left for _, left in views):.0%} of what was uncertain is left)"
        for name, views in found.items()
    ]
