"""Surfaces of several materials of known level: cut out of the likeliest volume, and fitted together."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from itertools import combinations

from ..backends import resolve
from ..checks import InputError, require
from ..inference import Score, select
from ..matter import Matter
from ..representations import SurfaceMesh, VoxelGrid
from .coarse import settled
from .cross_validation import predicted_frames
from .gaussian_options import GaussianOptions
from .keeper import BY
from .method import Task
from .surface_fit import SurfaceOptions, oversampling
from .turns import cut_as_seen, in_turns
from .volume import SmoothStage, SmoothVolume

NAME, STAGE = "materials", "likeliest volume"


def surfaces_of_levels(task: Task, options: GaussianOptions, surfaces: SurfaceOptions) -> SurfaceMesh:
    """Surfaces of the known materials of `task`, or of fewer of them where more explain no more of the frames.

    They are cut out of the likeliest volume, whose prior knows their levels, one inside another, fitted to the frames
    together, and take turns with a volume. Fewer materials are the null. Errors: `InputError` where none has a surface.
    """
    volume = _likeliest(task, options)
    found = dict[str, SurfaceMesh]()
    materials = task.prior.materials
    for count in range(1, len(materials) + 1):
        for chosen in combinations(range(len(materials)), count):
            with suppress(InputError):  # one of them has no surface
                matter = Matter.several(*(materials[k] for k in chosen))
                name = "δ " + " and ".join(f"{delta:.3g}" for delta, _ in matter.channels)
                found[name] = _of_levels(task, volume, matter, options, surfaces)
    require(len(found) > 0, "the volume holds no surface of the known materials.")

    def scored(name: str, fold: int) -> Score:
        there = found[name].on(resolve(surfaces.fit.backend))
        predicted = predicted_frames(task.scan.exposures, there, oversampling(task.scan, surfaces.fit))
        return Score.of(task.scan.left(predicted.double()))

    decision = select(NAME, tuple(found), scored, by=BY)
    task.on_start(decision, None)
    return in_turns(task, found[decision.choice], options, surfaces)


def _likeliest(task: Task, options: GaussianOptions) -> VoxelGrid:
    stage = SmoothStage(SmoothVolume(volume=replace(SmoothVolume().volume, backend=options.volume.backend)))
    fit = stage.fit(task, stage.start(task, None))
    fit.run(lambda record: task.on_progress(STAGE, fit.share))
    return fit.voxels


def _of_levels(
    task: Task, volume: VoxelGrid, matter: Matter, options: GaussianOptions, surfaces: SurfaceOptions
) -> SurfaceMesh:
    """Surfaces of `matter`, cut out of a `volume` and settled."""
    occupancy = volume.values[0].cpu() * (volume.matter.delta / matter.delta)
    cut = cut_as_seen(task, occupancy, volume.grid, matter, surfaces)
    how = options.coarse.of_views(len(task.scan.train()))
    return settled(task, cut, surfaces, how)
