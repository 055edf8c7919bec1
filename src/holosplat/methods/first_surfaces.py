"""The first surfaces of closed bodies: those of a first volume, or of Gaussians where frames are noisy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from ..baselines import holographic_tv
from ..checks import InputError
from ..matter import Matter
from ..optics.noise import noise_share
from ..representations import GaussianCloud, SurfaceMesh
from .gaussian_options import GaussianOptions
from .method import Task
from .sharp_level import material_of_levels
from .surface_fit import Extraction, cut_surfaces, extract_surfaces


def first_surfaces(
    task: Task, options: GaussianOptions, extraction: Extraction, fitted: Callable[[Task], GaussianCloud]
) -> SurfaceMesh | None:
    """Surfaces cut out of the volume of retrieval and tomography, on voxels of a pixel; None where there are none.

    The task is `bounded`. Edges of that volume are a part of a pixel off, which surfaces mend in a few steps; rounds of
    agreement and Gaussians do not bring them nearer. In noise from which on there are no such rounds
    (`HolographicTV.noisy`), and where a network is asked, they are those of Gaussians `fitted` to the frames, whose
    start and terms on the volume hold against it.
    """
    try:
        if options.start == "learned" or is_noisy(task, options):
            cloud = fitted(task)
            return extract_surfaces(cloud, task.scan, extraction) if cloud.matter.single else None
        material = material_of_levels(task, options.volume.backend, options.estimate)
        how = replace(options.volume, corrections=0)
        volume, grid = holographic_tv(task.scan, material, how, task.on_progress, task.uneven)
        return cut_surfaces(volume, grid, task.scan.views.finest, Matter.one(*material), extraction)
    except InputError:  # there is no matter, or no surface
        return None


def is_noisy(task: Task, options: GaussianOptions) -> bool:
    """Whether the frames of `task` are too noisy to make a volume agree with them."""
    return noise_share(torch.from_numpy(task.scan.frames)) > options.volume.noisy
