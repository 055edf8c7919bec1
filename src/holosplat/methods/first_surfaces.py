"""The first surfaces of closed bodies: those of a first volume, or of Gaussians where frames are noisy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ..baselines import holographic_tv
from ..checks import InputError
from ..geometry import Grid
from ..matter import Matter
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
        return _of_volume(task, options, surfaces)
    except InputError:  # there is no matter, or no surface
        return None


def _of_volume(task: Task, options: GaussianOptions, surfaces: SurfaceOptions) -> SurfaceMesh:
    """Those of a volume, before or after its rounds of agreement."""
    tried = list[tuple[float, SurfaceMesh]]()
    matter = material_of_levels(task, options.volume.backend, options.estimate)

    def poor(volume: Tensor, grid: Grid) -> bool:
        """Whether the surfaces of a volume, which join those that were tried, explain the frames badly."""
        cut = cut_surfaces(volume, grid, task.scan.views.finest, Matter.one(*matter), surfaces.extraction)
        tried.append((unexplained(cut, task.scan, surfaces), cut))
        return tried[-1][0] > options.coarse.missing

    how = replace(options.volume, refine=1)
    last = holographic_tv(task.scan, matter, how, task.on_progress, task.uneven, poor)
    if not tried or tried[0][0] > options.coarse.missing:
        poor(*last)
    return min(tried, key=lambda one: one[0])[1]


def is_noisy(task: Task, options: GaussianOptions) -> bool:
    """Whether the frames of `task` are too noisy to make a volume agree with them."""
    return noise_share(torch.from_numpy(task.scan.frames)) > options.volume.noisy
