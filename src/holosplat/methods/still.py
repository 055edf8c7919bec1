"""Light that the training frames of a task have in common, divided out before any method sees them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..baselines import HolographicTV, holographic_tv
from ..matter import MaterialPrior, Matter
from ..optics.still_light import shows_still_light, still_light
from ..progress import Progress
from ..representations import VoxelGrid
from ..scan import Scan
from .assumed import assumed_material
from .cross_validation import predicted_frames
from .method import Method, Task

STAGE = "still light"


def prepared(task: Task, method: Method | None = None) -> Task:
    """The task with frames in even light: that of each frame by its air (`Task.evened`), then what all have in common.

    A first volume of frames of one time tells the latter from the matter; without light in common in the air there is
    none, nor where the `method` itself takes it for an unknown.
    """
    if task.lit is not None:
        return task
    task = task.evened()
    if task.scan.is_series:
        return task  # no one volume tells its matter from light
    light, frames = task.lit, torch.from_numpy(task.scan.frames)
    assert light is not None
    wanted = task.light.still == "auto" and task.light.kind != "even" and not still_order(method)
    if not wanted or not shows_still_light(frames, light.air, light.noise):
        return task
    task.on_progress(STAGE, 0.0)
    predicted = predicted_first(task.scan, task.prior, HolographicTV(upper=0.0), task.on_progress)
    found = still_light(frames, predicted, light.air, light.noise)
    if found is None:
        return task
    scan = replace(task.scan, frames=(frames / found).numpy().astype(np.float32))
    return replace(task, scan=scan, lit=replace(light, still=found))


def still_order(method: Method | None) -> int:
    """Half waves of the still light that is an unknown of `method`; 0 where it has none."""
    volume = getattr(method, "volume", None)
    return volume.still_light if isinstance(volume, HolographicTV) else 0


def predicted_first(train: Scan, prior: MaterialPrior, options: HolographicTV, on_progress: Progress) -> torch.Tensor:
    """Frames [V, H, W] of a first volume by those of `train`."""
    material = assumed_material(train, prior, on_progress, options.backend)
    values, grid = holographic_tv(train, material, options, on_progress)
    return predicted_frames(train.exposures, VoxelGrid(values[None], grid, Matter.one(*material)))
