"""The start of a reconstruction: one material's occupancy from a few holograms, on voxels.

Paganin retrieval of each view, then total-variation tomography with the occupancy kept in [0, 1], then a few
corrections that make the volume agree with the holograms themselves: single-view retrieval leaves errors at low
frequencies that only consistency between views can mend.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from ..checks import at_least
from ..forward import Instrument, resolving_oversample
from ..geometry import Grid, Views
from ..materials import DeltaBeta
from ..memory import memory_kept
from ..optics.retrieval import invert_contrast, paganin
from ..projectors.voxels import projector_for
from ..scan import Scan
from ..volume import LineIntegrals
from .primal_dual import PrimalDual

SETTLING = 2
"""Rounds of agreement after which misfits are compared."""

Progress = Callable[[str, float], None]
"""Called with (stage, fraction done of it)."""


@dataclass(frozen=True)
class HolographicTV:
    """Options. weight: of total variation, in pixels of path length; iterations: primal–dual steps on the retrieved
    thickness; corrections: rounds of agreement with the holograms, of `inner` steps each; refine: voxels along a
    pixel's edge (0: as the first fringe needs); max_voxels: coarser voxels rather than more than this many;
    upper: bound of the occupancy (0: none); backend: `cpu`, or `reference` (plain torch, slow).
    """

    weight: float = 0.3
    iterations: int = 100
    corrections: int = 6
    inner: int = 20
    refine: int = 0
    max_voxels: int = 70_000_000
    upper: float = 1.0
    backend: Literal["cpu", "reference"] = "cpu"

    def __post_init__(self) -> None:
        at_least(self, 0, "weight", "corrections", "inner", "refine", "upper")
        at_least(self, 1, "iterations", "max_voxels")


def holographic_tv(
    scan: Scan, material: DeltaBeta, options: HolographicTV, on_progress: Progress
) -> tuple[Tensor, Grid]:
    """Occupancy [Z, Y, X] of `material` (δ > 0, β of any sign) from the frames of `scan`, and its grid.

    `on_progress(stage, fraction)` is called between pieces of work.
    """
    with memory_kept():
        return _holographic_tv(scan, material, options, on_progress)


def _holographic_tv(
    scan: Scan, material: DeltaBeta, options: HolographicTV, on_progress: Progress
) -> tuple[Tensor, Grid]:
    scan, refine = _working_resolution(scan, options)
    exposures, pitch = scan.exposures, scan.views.pixel_size
    frames = torch.from_numpy(scan.frames)
    on_progress("phase retrieval", 0.0)
    lines = paganin(frames, exposures, material.delta, material.beta) / pitch

    views = _in_pixels(scan.views)
    grid = Grid.of_views(views)
    upper = options.upper or None
    projector = projector_for(grid, views, options.backend)
    solver = PrimalDual(projector, torch.zeros(grid.shape), options.weight, upper, backend=options.backend)
    for done in range(0, options.iterations, 10):
        on_progress("tomography", done / options.iterations)
        solver.run(lines, min(10, options.iterations - done))
    volume = solver.volume

    if options.corrections > 0:
        volume, grid = _agree(scan, material, volume, options, refine, on_progress)
    return volume, _in_metres(grid, pitch)


def _agree(
    scan: Scan, material: DeltaBeta, volume: Tensor, options: HolographicTV, refine: int, on_progress: Progress
) -> tuple[Tensor, Grid]:
    """The volume after rounds of agreement with the holograms, on voxels `refine` times finer than pixels.

    Each round runs the wave optics on the volume's projection, inverts what is missing from the frames, and
    gives the corrected projection to a few primal–dual steps. The round that agrees best is returned, for the
    iteration may diverge; the first ones, in which the solver finds its dual variables, do not count.
    """
    frames, pitch, views = torch.from_numpy(scan.frames), scan.views.pixel_size, _in_pixels(scan.views)
    physics = (pitch, scan.exposures.distance, scan.exposures.energy_kev, material.delta, material.beta)
    grid = Grid.of_views(views, refine)
    finer = math.ceil(resolving_oversample(scan.exposures, 1.5, at_least=1) / refine)
    instrument = Instrument(scan.exposures, refine * finer, backend=options.backend)
    projector = projector_for(grid, views.refined(refine), options.backend)
    start = interpolate(volume[None, None], size=grid.shape, mode="trilinear", align_corners=False)[0, 0]
    upper = options.upper or None
    solver = PrimalDual(projector, start, options.weight, upper, 1 / refine**2, options.backend)
    best, least = start, float("inf")
    for done in range(options.corrections + 1):
        on_progress("agreement with the holograms", done / options.corrections)
        lines = solver.lines()
        missing = frames - _image(instrument, _refined(lines, finer) * pitch, material).detach()
        misfit = float(missing.square().sum())
        if misfit < least or done <= SETTLING:
            best, least = solver.volume.clone(), misfit
        if done < options.corrections:
            change = invert_contrast(missing, *physics) / pitch
            solver.run(lines + _refined(change, refine), options.inner)
    return best, grid


def _working_resolution(scan: Scan, options: HolographicTV) -> tuple[Scan, int]:
    """The scan, binned if its voxels would be too many, and the voxels along a pixel's edge."""
    refine = options.refine or resolving_oversample(scan.exposures, 1.5, at_least=1)
    h, w = scan.views.shape
    while refine > 1 and w * w * h * refine**3 > options.max_voxels:
        refine -= 1
    factor = 1
    while w * w * h / factor**3 > options.max_voxels:
        factor += 1
    return scan.binned(factor), refine


def _image(instrument: Instrument, lines: Tensor, material: DeltaBeta) -> Tensor:
    """Frames from thickness [V, H, W] in metres on the unpadded raster (matter outside it counts as none)."""
    (my, mx), s = instrument.margin, instrument.oversample
    padded = pad(lines, (mx * s, mx * s, my * s, my * s))
    return instrument.frames(LineIntegrals(padded[:, None], ((material.delta, material.beta),)))


def _refined(images: Tensor, factor: int) -> Tensor:
    if factor == 1:
        return images
    return interpolate(images[None], scale_factor=factor, mode="bilinear", align_corners=False)[0]


def _in_pixels(views: Views) -> Views:
    """The same views with the pixel as the unit of length."""
    return Views(views.rotations, views.shifts / views.pixel_size, views.shape, 1.0)


def _in_metres(grid: Grid, pitch: float) -> Grid:
    size, origin = ([v * pitch for v in values] for values in (grid.voxel_size, grid.origin))
    return Grid(grid.shape, (size[0], size[1], size[2]), (origin[0], origin[1], origin[2]))
