"""What could be reached by who knew more: made from the truth, and shown apart from the methods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from holosplat.baselines import TOMOGRAPHIES
from holosplat.beamline.declared.declaration import Case
from holosplat.checks import require
from holosplat.geometry import Grid
from holosplat.matter import Matter
from holosplat.progress import Progress
from holosplat.representations.voxels import VoxelGrid
from holosplat.volume import Object, Volume

from .prepare import MeasuredCase


@dataclass(frozen=True)
class Reference:
    """name: for the table; summary: one line of what it is; run: (case, true volume, on_progress) → Object,
    `InputError` with the reason where the case has no such reference."""

    name: str
    summary: str
    run: Callable[[Case | MeasuredCase, Volume, Progress], Object]


def truth_on_voxels(case: Case | MeasuredCase, truth: Volume, on_progress: Progress) -> VoxelGrid:
    """The true volume itself: what voxels of one pixel can hold, at their best."""
    on_progress("truth on voxels", 0.0)
    scales = [float(np.abs(values).max()) for values in (truth.delta, truth.beta)]
    channels = [values / (scale or 1.0) for values, scale in zip((truth.delta, truth.beta), scales)]
    return VoxelGrid(torch.from_numpy(np.stack(channels)), truth.grid, Matter.free(*scales))


def tv_of_true_lines(case: Case | MeasuredCase, truth: Volume, on_progress: Progress) -> VoxelGrid:
    """Total-variation tomography from the true thickness in the training views: phase retrieval without error."""
    require(
        isinstance(case, Case) and case.prior.fixes_level,
        "the true thickness needs a known material, but methods are told of none here.",
    )
    assert isinstance(case, Case)
    views = case.true_exposures().views[np.flatnonzero(~case.is_test)]
    material = case.prior.materials[0]
    _, projected_delta = case.scene.project(views)
    lines = (projected_delta / material.delta).float()
    grid = Grid.of_views(views)
    values = TOMOGRAPHIES["tv"](lines, views, grid, 1.0, lambda fraction: on_progress("tomography", fraction))
    return VoxelGrid(values[None], grid, Matter.one(*material))


REFERENCES = {
    reference.name: reference
    for reference in (
        Reference("truth-on-voxels", "the true volume on voxels of one pixel", truth_on_voxels),
        Reference("tv-true-lines", "TV tomography from the true thickness of the training views", tv_of_true_lines),
    )
}
"""Name → reference."""
