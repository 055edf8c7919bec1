"""The first surfaces of closed bodies: those of a first volume, of Gaussians, or of guessed levels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import combinations

import torch
from torch import Tensor

from ..baselines import holographic_tv
from ..baselines.algebraic import Algebraic, sirt
from ..baselines.holographic_tv import Correction, agreed, correlated
from ..baselines.two_materials import Shares, at_one_ratio
from ..checks import InputError, require
from ..geometry import Grid
from ..inference import Score, select
from ..matter import DeltaBeta, Matter
from ..mesh import TriangleMesh, joined
from ..optics.noise import noise_share
from ..representations import GaussianCloud, SurfaceMesh, VoxelGrid
from .coarse import CoarseToFine, Way, settled, unexplained
from .gaussian_options import GaussianOptions
from .keeper import BY
from .method import Task
from .surface_fit import Extraction, SurfaceOptions, cut_surfaces, extract_surfaces, frames_of
from .volume import SmoothStage, SmoothVolume, material_of_levels


def first_surfaces(
    task: Task, options: GaussianOptions, surfaces: SurfaceOptions, fitted: Callable[[Task], GaussianCloud]
) -> Sequence[Way]:
    """Surfaces cut out of the volume of retrieval and tomography, on voxels of a pixel, and where these explain the
    frames badly, such as have taken turns with that volume (`in_turns`).

    The task is `bounded`. In noise (`HolographicTV.noisy`) surfaces are those of Gaussians `fitted` to the frames,
    whose start and terms on the volume hold against it; and those of the volume are the second way, for of bodies that
    pixels hardly resolve Gaussians may lose most. Several known materials have one way (`surfaces_of_levels`).
    """

    def of_volume(before: SurfaceMesh | None) -> SurfaceMesh:
        return _of_volume(task, options, surfaces)

    def of_turns(before: SurfaceMesh | None) -> SurfaceMesh | None:
        after = None if before is None else in_turns(task, before, options, surfaces)
        return None if after is before else after

    if len(task.prior.materials) > 1:
        return (_if_any(lambda before: surfaces_of_levels(task, options, surfaces)),)

    def of_gaussians(before: SurfaceMesh | None) -> SurfaceMesh | None:
        cloud = fitted(task)
        cut = partial(extract_surfaces, cloud, task.scan)
        return cut_as_seen(task, cut, surfaces) if cloud.matter.single else None

    if is_noisy(task, options):
        return (_if_any(of_gaussians), *surfaces_of_volume(task, options, surfaces))
    return (_if_any(of_volume), of_turns)


def surfaces_of_volume(task: Task, options: GaussianOptions, surfaces: SurfaceOptions) -> Sequence[Way]:
    """Of the ways of `first_surfaces` in noise, that of a volume with which surfaces have taken turns."""

    def of_volume(before: SurfaceMesh | None) -> SurfaceMesh:
        matter = material_of_levels(task, options.volume.backend, options.estimate)
        rounds = replace(options.volume.in_noise(), refine=1)
        volume, grid = holographic_tv(task.scan, matter, rounds, task.on_progress, task.unlike_null)
        cut = cut_as_seen(task, _cutter(task, volume, grid, Matter.one(*matter)), surfaces)
        how = options.coarse.of_views(len(task.scan.train()))
        return in_turns(task, settled(task, cut, surfaces, how), options, surfaces)

    return (_if_any(of_volume),)


def _if_any(way: Way) -> Way:
    """The same way, which ends with None where there is no matter, or no surface."""

    def found(before: SurfaceMesh | None) -> SurfaceMesh | None:
        try:
            return way(before)
        except InputError:
            return None

    return found


def _of_volume(task: Task, options: GaussianOptions, surfaces: SurfaceOptions) -> SurfaceMesh:
    """Those of a volume, before or after its rounds of agreement.

    Edges of a first volume are a part of a pixel off, which surfaces mend in a few steps; rounds do not bring them
    nearer. Where bodies crowd, the volume lacks whole parts of them, which surfaces cannot mend: so where they leave
    more than `CoarseToFine.missing` of the finest structure unexplained, the volume of rounds is cut, too, and what
    leaves less is taken.
    """
    tried = list[tuple[float, SurfaceMesh]]()
    matter = material_of_levels(task, options.volume.backend, options.estimate)

    def poor(volume: Tensor, grid: Grid) -> bool:
        """Whether the surfaces of a volume, which join those that were tried, explain the frames badly."""
        cut = cut_surfaces(volume, grid, task.scan.views.finest, Matter.one(*matter), surfaces.extraction)
        tried.append((unexplained(cut, task.scan, surfaces), cut))
        return tried[-1][0] > options.coarse.missing

    how = replace(options.volume, refine=1)
    known = {"wanted": poor, "lines": task.lines(task.scan, matter, how)}
    last = holographic_tv(task.scan, matter, how, task.on_progress, task.unlike_null, **known)
    if not tried or tried[0][0] > options.coarse.missing:
        poor(*last)
    return min(tried, key=lambda one: one[0])[1]


def is_noisy(task: Task, options: GaussianOptions) -> bool:
    """Whether the frames of `task` are too noisy to make a volume agree with them."""
    return noise_share(task.scan.measured) > options.volume.noisy


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
        return Score.of(task.scan.left(frames_of(found[name], task.scan, surfaces.fit).double()))

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
    cut = cut_as_seen(task, _cutter(task, occupancy, volume.grid, matter), surfaces)
    how = options.coarse.of_views(len(task.scan.train()))
    return settled(task, cut, surfaces, how)


LEVELS = (0.2, 0.3, 0.4, 0.5, 0.6)
"""Occupancies at which a volume may be cut."""


def in_turns(task: Task, found: SurfaceMesh, options: GaussianOptions, surfaces: SurfaceOptions) -> SurfaceMesh:
    """Surfaces that explain the frames of `task`, a bounded one, better than `found`, which is settled; else that.

    A surface moves its edges, but begins no body, and follows no fringe from a few pixels away. Rounds of agreement
    that begin with its bodies (`baselines.holographic_tv.agreed`) say what is missing, or too much, elsewhere; the
    volume is cut again, and its surfaces are settled. So it goes on, at most `CoarseToFine.turns` times, as long as the
    square of what they leave of the frames falls by `turn_gain` of it or more. Without rounds, which matter on both
    sides of its medium does not have, there are no turns.
    """
    how = options.coarse.of_views(len(task.scan.train()))
    least = _left(task, found, surfaces)
    for _ in range(how.turns if options.volume.corrections > 0 and not task.prior.two_sided else 0):
        try:
            turned = settled(task, _cut_again(task, found, options, surfaces), surfaces, how)
        except InputError:  # the volume holds no surface
            break
        left = _left(task, turned, surfaces)
        if left < least:
            found = turned
        if left > (1 - how.turn_gain) * least:
            break
        least = left
    return found


def _cut_again(task: Task, found: SurfaceMesh, options: GaussianOptions, surfaces: SurfaceOptions) -> SurfaceMesh:
    """Surfaces of the volume after rounds that began with the bodies of `found`."""
    grid = Grid.of_views(task.scan.views)
    shares, first = found.shares(grid), found.matter.channels[0]
    start = sum(float(each.delta / first.delta) * share for each, share in zip(found.matter.channels, shares))
    scan, backend = task.scan, options.volume.backend
    if found.matter.others:
        scan = at_one_ratio(scan, Shares(shares.float().cpu(), grid, found.matter.channels), first.ratio, backend)
    how = options.volume.in_noise()
    volume, grid = agreed(scan, first, torch.as_tensor(start).float(), how, task.on_progress, task.unlike_null)
    return cut_as_seen(task, _cutter(task, volume, grid, found.matter), surfaces)


Cut = Callable[[Extraction], SurfaceMesh]
"""Gets surfaces out of Gaussians or a volume."""


def _cutter(task: Task, volume: Tensor, grid: Grid, matter: Matter) -> Cut:
    """What cuts surfaces out of an occupancy [Z, Y, X] on `grid`."""
    return partial(cut_surfaces, volume, grid, task.scan.views.finest, matter)


def cut_as_seen(task: Task, cut: Cut, surfaces: SurfaceOptions) -> SurfaceMesh:
    """The surfaces that `cut` gets at the one of `LEVELS` at which they leave least of the frames; another level that
    the options ask for scales them.

    Noise and total variation make what is thin fainter, and a surface that is too large shrinks, but one that is
    missing does not grow. Errors: `InputError` if there are none at any level.
    """
    how, tried = surfaces.extraction, list[tuple[float, SurfaceMesh]]()
    for level in LEVELS:
        with suppress(InputError):  # no surface at this level
            found = cut(replace(how, level=min(level * how.level / Extraction.level, 0.99)))
            tried.append((_left(task, found, surfaces), found))
    require(len(tried) > 0, "the volume holds no surface.")
    return min(tried, key=lambda one: one[0])[1]


MISSING = "surfaces: missing bodies"


def with_missing_bodies(
    task: Task, found: SurfaceMesh, surfaces: SurfaceOptions, how: CoarseToFine, levels: Sequence[float] = LEVELS
) -> tuple[float, SurfaceMesh] | None:
    """`found` of one material and bodies that the frames of `task` show beside it, after some steps, and the level that
    cut these out; None where the frames show none.

    The thickness that explains what `found` leaves of the frames (`Correction`) changes its occupancy within 0 and 1,
    by SIRT, so that what is too much may be taken away where it is, and need not be made up for elsewhere. Where
    occupancy is added, a body is missing; it has at least the volume of a voxel, and bodies with less after the steps
    are left out. Few views and noise make it faint, so that `levels`, from the lowest on as long as less of the frames
    is left, are shares of the largest addition.
    """
    if not found.matter.single:
        return None
    matter, grid = DeltaBeta(found.matter.delta, found.matter.beta), Grid.of_views(task.scan.views)
    left = task.scan.left(frames_of(found, task.scan, surfaces.fit))
    lines, shares = Correction(task.scan, matter, noise=correlated(task.lit))(left), found.shares(grid)[0].float().cpu()
    kept = {"options": Algebraic(nonnegative=True), "missing": task.scan.gaps, "start": shares}
    added = sirt(lines, task.scan.views, grid, 1.0, partial(task.on_progress, MISSING), **kept) - shares
    best, least, largest = None, math.inf, float(added.max())
    for level in levels if largest > 0 else ():
        every = replace(surfaces.extraction, level=level, least_volume=1.0)
        try:
            bodies = cut_surfaces(added / largest, grid, task.scan.views.finest, found.matter, every)
            more = settled(task, _of_bodies([found.mesh(), bodies.mesh()], found), surfaces, how)
            lasting = [body for body in more.bodies() if body.volume >= more.unit_length**3]
        except InputError:  # none has the volume of a voxel, or none is left
            break
        if not lasting:
            break
        more = _of_bodies(lasting, more)
        if (left_over := _left(task, more, surfaces)) >= least:
            break
        best, least = (level, more), left_over
    return best


def _of_bodies(bodies: Sequence[TriangleMesh], like: SurfaceMesh) -> SurfaceMesh:
    """Surfaces of `bodies` [m], of the unit and the one material of `like`."""
    whole = joined(bodies)
    vertices = torch.from_numpy(whole.vertices / like.unit_length)
    return SurfaceMesh(vertices, torch.from_numpy(whole.faces), like.unit_length, like.matter, like.lines)


def _left(task: Task, found: SurfaceMesh, surfaces: SurfaceOptions) -> float:
    """Mean square of what `found` leaves of the frames."""
    return float(task.scan.left(frames_of(found, task.scan, surfaces.fit)).double().square().mean())
