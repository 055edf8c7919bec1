"""Whether matter has levels of δ with sharp edges, or is continuous: what is known, and what frames say.

The inside of a first volume without any bound is flattened, to one level or to two, with its rims left as they are. Of
matter with levels, the flat volume predicts unseen views as well or better, for the differences were errors; of
continuous matter it predicts them worse.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from scipy.ndimage import binary_erosion
from torch import Tensor

from ..baselines.material import plateau
from ..baselines.two_materials import best_levels, told_apart
from ..inference import Decision, Score, select
from ..matter import KnownTwo
from ..representations import VoxelGrid
from .first_volumes import BY_FISSION, predictions
from .illumination import Trial, accepted, first_of_task
from .method import Task

STAGE = "levels or continuous matter"
NAME = "matter"
LEVELS = ("one level", "two levels")
CONTINUOUS = "continuous"


def decide_matter(task: Task) -> Decision:
    """Whether the training frames of `task` show levels, `LEVELS` the null, or continuous matter.

    One ratio δ/β holds one level; two known materials are two. Where views are too few to set some aside, or nothing
    lies more than a pixel inside matter, the null stands.
    """
    if isinstance(task.prior, KnownTwo):
        return Decision(NAME, LEVELS[1], "two materials are known")
    task.on_progress(STAGE, 0.0)
    first = first_of_task(task)
    if first.folds.by == BY_FISSION:
        return Decision(NAME, LEVELS[0], "too few views to set some aside")

    def flat(fold: int) -> tuple[Trial, list[VoxelGrid]]:
        trial = accepted(task, first, fold)
        grid, seen = trial.volume.grid, trial.seen
        pixel = max(1, round(seen.views.finest / grid.voxel_size[0]))
        made = [VoxelGrid(one[None], grid, trial.volume.matter) for one in flattened(trial.volume.values[0], pixel)]
        return trial, made

    def score(name: str, fold: int) -> Score:
        trial, volumes = first.once("flat", fold, lambda: flat(fold))
        if name == CONTINUOUS:
            return trial.score(trial.light)
        number = min(LEVELS.index(name), len(volumes) - 1)
        if number < 0:
            return trial.score(trial.light)
        expected = first.once(("flat", number), fold, lambda: predictions(volumes[number], trial.unseen))
        return trial.of(expected).score(trial.light)

    most = 1 if task.prior.fixes_ratio else 2
    candidates = (*LEVELS[: min(most, len(first.once("flat", 0, lambda: flat(0))[1]))], CONTINUOUS)
    if len(candidates) == 1:
        return Decision(NAME, LEVELS[0], "nothing in a first volume lies more than a pixel inside matter")
    return select(NAME, candidates, score, first.folds.count, by=first.folds.by)


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
