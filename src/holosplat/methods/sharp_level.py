"""The level of matter with sharp edges of which the ratio δ/β is known, but not the density."""

from __future__ import annotations

import numpy as np

from ..backends import Backend
from ..baselines.material import DEFAULT, MaterialEstimate, level_of
from ..matter import DeltaBeta, KnownRatio
from ..representations import VoxelGrid
from .assumed import assumed_material
from .method import Task, first_of_task
from .volume import SmoothStage, SmoothVolume

STAGE = "level of the matter"
EDGE, VIEWS = 96, 12
"""Voxels along an edge of the volume whose level is taken, at most, and views of so many voxels: that takes some ten
seconds on one core. A smaller volume is fitted to as many more views, evenly chosen, as take no longer."""


def material_of_levels(task: Task, backend: Backend = "auto", options: MaterialEstimate = DEFAULT) -> DeltaBeta:
    """The `assumed_material` of a task; where a level bounds its matter and has to be found, that of the likeliest
    volume.

    Tomography takes noise off its volume, and with it a tenth to a third of the level in noise of a fifth of the
    contrast, and a third to a half in noise of half of it. The likeliest volume under noise and prior
    (`SmoothVolume`, of at most `EDGE`³ voxels) keeps it, for its prior hardly shrinks what is large
    (docs/data/level.csv); begun with even matter, it would give small balls in noise as strong as the contrast half of
    it. Where that volume is empty, or its level lower, the material is that of tomography: larger voxels than thin
    shells dilute them.
    """
    prior = task.prior
    if not (task.bounded and isinstance(prior, KnownRatio)):
        return assumed_material(task.scan, prior, task.on_progress, backend, options)

    def found() -> DeltaBeta:
        material = assumed_material(task.scan, prior, task.on_progress, backend, options)
        delta = max(material.delta, level_in(task.likeliest or _likeliest(task, options)), key=abs)
        return DeltaBeta(delta, delta / prior.ratio)

    return first_of_task(task).once(("material of levels", prior, backend, options), 0, found)


def _likeliest(task: Task, options: MaterialEstimate) -> VoxelGrid:
    task.on_progress(STAGE, 0.0)
    few = in_few_views(task)
    stage = SmoothStage(SmoothVolume(estimate=options, max_voxels=EDGE**3, rounds=1, faint=0.0))
    fit = stage.fit(few, stage.start(few, None))
    fit.run(lambda record: task.on_progress(STAGE, fit.share))
    return fit.voxels


def level_in(volume: VoxelGrid) -> float:
    """δ of the level of a volume of one channel; 0 of an empty one."""
    values = volume.values[0]
    return level_of(values) * volume.matter.channels[0].delta if bool((values > 0).any()) else 0.0


def in_few_views(task: Task) -> Task:
    """The task with views, evenly chosen, so few that views times voxels are those of `VIEWS` of EDGE³ at most."""
    rows, columns = task.scan.views.shape
    most = VIEWS * EDGE**3 // min(rows * columns**2, EDGE**3)
    if len(task.scan) <= most:
        return task
    return task.of_views(np.linspace(0, len(task.scan) - 1, most).round().astype(int))
