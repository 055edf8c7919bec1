"""The first surfaces of closed bodies: those of a first volume, or of Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..baselines import holographic_tv
from ..checks import InputError, require
from ..geometry import Grid
from ..matter import Matter
from ..optics.noise import noise_share
from ..representations import GaussianCloud, SurfaceMesh
from .coarse import missing_matter, unexplained
from .gaussian_options import GaussianOptions
from .method import Task
from .sharp_level import material_of_levels
from .surface_fit import SurfaceOptions, cut_surfaces, extract_surfaces

Way = Callable[[], SurfaceMesh | None]
"""How first surfaces are made; None where there are none."""


def first_surfaces(
    task: Task, options: GaussianOptions, surfaces: SurfaceOptions, fitted: Callable[[Task], GaussianCloud]
) -> Sequence[Way]:
    """Surfaces cut out of the volume of retrieval and tomography, on voxels of a pixel; None where there are none.

    The task is `bounded`. In noise (`HolographicTV.noisy`), and where a network is asked, surfaces are those of
    Gaussians `fitted` to the frames, whose start and terms on the volume hold against it; and in noise those of the
    volume are the second way, for of bodies that pixels hardly resolve Gaussians may lose most.
    """

    def of_volume() -> SurfaceMesh:
        return _of_volume(task, options, surfaces)

    def of_gaussians() -> SurfaceMesh | None:
        cloud = fitted(task)
        return extract_surfaces(cloud, task.scan, surfaces.extraction) if cloud.matter.single else None

    if options.start == "learned":
        return (_if_any(of_gaussians),)
    return (_if_any(of_gaussians), _if_any(of_volume)) if is_noisy(task, options) else (_if_any(of_volume),)


def surfaces_of_volume(task: Task, options: GaussianOptions, surfaces: SurfaceOptions) -> Sequence[Way]:
    """Of the ways of `first_surfaces`, that of a volume alone."""
    return (_if_any(lambda: _of_volume(task, options, surfaces)),)


def _if_any(way: Way) -> Way:
    """The same way, which ends with None where there is no matter, or no surface."""

    def found() -> SurfaceMesh | None:
        try:
            return way()
        except InputError:
            return None

    return found


def _of_volume(task: Task, options: GaussianOptions, surfaces: SurfaceOptions) -> SurfaceMesh:
    """Those of a volume, before or after its rounds of agreement.

    Edges of a first volume are a part of a pixel off, which surfaces mend in a few steps; rounds do not bring them
    nearer. Where bodies crowd, the volume lacks whole parts of them, which surfaces cannot mend: so where they leave
    more than `CoarseToFine.missing` of the finest structure unexplained, the volume of rounds is cut, too, and what
    leaves less is taken. In noise, which hides that structure, all matter counts (`missing_matter`), and rounds are
    those of `HolographicTV.in_noise`.
    """
    tried, noisy = list[tuple[float, SurfaceMesh]](), is_noisy(task, options)
    matter = material_of_levels(task, options.volume.backend, options.estimate)
    most = options.coarse.missing_matter if noisy else options.coarse.missing

    def poor(volume: Tensor, grid: Grid) -> bool:
        """Whether the surfaces of a volume, which join those that were tried, explain the frames badly."""
        try:
            cut = cut_surfaces(volume, grid, task.scan.views.finest, Matter.one(*matter), surfaces.extraction)
        except InputError:  # no surface yet
            return True
        left = missing_matter(cut, task, surfaces) if noisy else unexplained(cut, task.scan, surfaces)
        tried.append((left, cut))
        return left > most

    how = replace(options.volume.in_noise() if noisy else options.volume, refine=1)
    last = holographic_tv(task.scan, matter, how, task.on_progress, task.uneven, poor)
    if not tried or tried[0][0] > most:
        poor(*last)
    require(len(tried) > 0, "the volume holds no surface.")
    return min(tried, key=lambda one: one[0])[1]


def is_noisy(task: Task, options: GaussianOptions) -> bool:
    """Whether the frames of `task` are too noisy to make a volume agree with them."""
    return noise_share(torch.from_numpy(task.scan.frames)) > options.volume.noisy
