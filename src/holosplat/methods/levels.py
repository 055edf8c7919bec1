"""Whether matter has levels of δ with sharp edges, or is continuous: what is known, and what unseen views show.

The inside of a first volume without any bound is flattened, to one level or to two, with its rims left as they are. Of
matter with levels the flat volume predicts unseen views better, for the differences were errors; of continuous matter
it predicts them worse. Where neither is sure, or a known material would be called continuous, the methods for either
kind are fitted to the coarse frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import binary_erosion
from torch import Tensor

from ..baselines.material import plateau
from ..baselines.two_materials import best_levels, told_apart
from ..inference import Decision, Score, select
from ..matter import KnownTwo, MaterialPrior, MatterKind
from ..representations import VoxelGrid
from .first_volumes import BY_FISSION, FirstVolumes, predictions
from .illumination import Trial, accepted, first_of_task
from .method import Method, Task, solve_stages

STAGE = "levels or continuous matter"
NAME = "matter"
LEVELS = ("one level", "two levels")
CONTINUOUS = "continuous"


def decide_matter(task: Task, methods: Mapping[MatterKind, Method] | None = None) -> Decision:
    """Whether the training frames of `task` show levels, `LEVELS`, or continuous matter.

    A known material has one level, two have two: that is the null, which flat volumes may keep, but fits of `methods`
    for either kind alone overturn. Where less is known and there are such methods, the null is continuous matter, which
    bounds nothing; where flat volumes predict neither better nor worse, these are fitted. One ratio δ/β holds one
    level. Of views that are too few to set some aside, levels are taken.
    """
    if isinstance(task.prior, KnownTwo):
        return Decision(NAME, LEVELS[1], "two materials are known")
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
    found = select(NAME, candidates, flat.score, first.folds.count, by=first.folds.by)
    sure = found.choice != CONTINUOUS or (not known and all(each.loses for each in found.compared))
    if methods is None or sure:
        return found
    fits = _Fits(task, first, methods)
    return select(NAME, candidates, fits.score, by=f"{first.folds.by}, by fits")


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
        grid, seen = trial.volume.grid, trial.seen
        pixel = max(1, round(seen.views.finest / grid.voxel_size[0]))
        flat = (
            VoxelGrid(one[None], grid, trial.volume.matter) for one in flattened(trial.volume.values[0].cpu(), pixel)
        )
        return trial, [one.on(trial.volume.backend) for one in flat]


class _Fits:
    """Fits of the methods for either kind of matter to the frames of the first fold.

    Two levels alone need no ratio δ/β; else it is, where nothing is known, that of the first volume.
    """

    def __init__(self, task: Task, first: FirstVolumes, methods: Mapping[MatterKind, Method]) -> None:
        self._task, self._methods = task, methods
        self._trial = accepted(task, first, 0)
        self._ratio = MaterialPrior.of_ratio(first.material.ratio, task.prior.sign)

    def score(self, name: str, fold: int) -> Score:
        """Of the fit for one kind of matter."""
        assert fold == 0
        trial, kind = self._trial, kind_of(name)
        self._task.on_progress(f"{STAGE}: {self._methods[kind].kind}", 0.0)
        seen = replace(trial.seen, frames=trial.light.evened(torch.from_numpy(trial.seen.frames)).numpy())
        prior = self._task.prior if self._task.prior.fixes_ratio or name == LEVELS[1] else self._ratio
        task = replace(self._task, scan=seen, prior=prior, lit=trial.light, matter=kind, first=None)
        return trial.of(predictions(solve_stages(self._methods[kind], task), trial.unseen)).score(trial.light)


def kind_of(choice: str) -> MatterKind:
    """The kind of matter that a choice of `decide_matter` is of."""
    return "continuous" if choice == CONTINUOUS else "levels"


def flattened(values: Tensor, pixel: int) -> Iterator[Tensor]:
    """Volumes [Z, Y, X] whose inside is flat, at one level and at two; rims, `pixel` voxels and more, stay.

    Nothing is given where nothing lies inside.
    """
    v, rim = values.numpy(), 1 + pixel // 2
    inside = _eroded(v > 0.5 * plateau(values), rim)
    if not inside.any():
        return
    yield torch.from_numpy(np.where(inside, v[inside].mean(), v))
    found = best_levels(values, pixel)
    levels = (found.high, found.low)
    lighter = _eroded(told_apart(values, levels, pixel)[1].numpy() > 0, rim)
    denser = _eroded(v > 0.5 * sum(levels), rim)
    if lighter.any() and denser.any():
        flat = np.where(denser, v[denser].mean(), v)
        yield torch.from_numpy(np.where(lighter, v[lighter].mean(), flat))


def _eroded(inside: np.ndarray, steps: int) -> np.ndarray:
    return np.asarray(binary_erosion(inside, iterations=steps), dtype=bool)
