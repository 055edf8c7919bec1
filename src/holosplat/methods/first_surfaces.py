"""The first surfaces of closed bodies: those of a first volume, or of Gaussians where frames are noisy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from ..baselines import holographic_tv
from ..checks import InputError
from ..matter import DeltaBeta, Matter
from ..optics.noise import noise_share
from ..representations import GaussianCloud, SurfaceMesh
from .coarse import unexplained
from .gaussian_options import GaussianOptions
from .method import Task
from .sharp_level import material_of_levels
from .surface_fit import SurfaceOptions, cut_surfaces, extract_surfaces


def first_surfaces(
    task: Task, options: GaussianOptions, surfaces: SurfaceOptions, fitted: Callable[[Task], GaussianCloud]
) -> SurfaceMesh | None:
    """Surfaces cut out of the volume of retrieval and tomography, on voxels of a pixel; None where there are none.

    The task is `bounded`. Edges of that volume are a part of a pixel off, which surfaces mend in a few steps; rounds of
    agreement and Gaussians do not bring them nearer. Where bodies crowd, the volume lacks whole parts of them, which
    surfaces cannot mend: so where they leave more than `CoarseToFine.missing` of the finest structure unexplained, the
    volume of rounds is cut, too, and what leaves less is taken. In noise from which on there are no such rounds
    (`HolographicTV.noisy`), and where a network is asked, surfaces are those of Gaussians `fitted` to the frames, whose
    start and terms on the volume hold against it.
    """
    try:
        if options.start == "learned" or is_noisy(task, options):
            cloud = fitted(task)
            return extract_surfaces(cloud, task.scan, surfaces.extraction) if cloud.matter.single else None
        cut = partial(_cut, task, options, surfaces, material_of_levels(task, options.volume.backend, options.estimate))
        first = cut(rounds=0)
        if (left := unexplained(first, task.scan, surfaces)) <= options.coarse.missing:
            return first
        agreed = cut(rounds=options.volume.corrections)
        return agreed if unexplained(agreed, task.scan, surfaces) < left else first
    except InputError:  # there is no matter, or no surface
        return None


def _cut(
    task: Task, options: GaussianOptions, surfaces: SurfaceOptions, material: DeltaBeta, rounds: int
) -> SurfaceMesh:
    """The surfaces of a volume of `material` after so many rounds of agreement."""
    how = replace(options.volume, corrections=rounds, refine=1)
    volume, grid = holographic_tv(task.scan, material, how, task.on_progress, task.uneven)
    return cut_surfaces(volume, grid, task.scan.views.finest, Matter.one(*material), surfaces.extraction)


def is_noisy(task: Task, options: GaussianOptions) -> bool:
    """Whether the frames of `task` are too noisy to make a volume agree with them."""
    return noise_share(torch.from_numpy(task.scan.frames)) > options.volume.noisy
