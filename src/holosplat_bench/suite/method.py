"""A method of the benchmark: options of the library's own methods, with a name and a heading for the tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from holosplat.align.derivatives import in_pixels, projections
from holosplat.align.find import align_views
from holosplat.align.initial_geometry import shifts_by_mass
from holosplat.align.newton import blurred
from holosplat.baselines import TOMOGRAPHIES
from holosplat.geometry import Grid, Views
from holosplat.matter import Known, MaterialPrior
from holosplat.methods import Method as Options
from holosplat.methods.assumed import assumed_material
from holosplat.optics.retrieval import tikhonov
from holosplat.progress import Progress
from holosplat.scan import Scan
from holosplat.volume import Object
from holosplat.workflows.reconstruct import reconstruct

Aligner = Callable[[Scan, MaterialPrior, Progress], Scan]
"""The training frames in other exposures."""

ROUNDS = 6
"""Volumes and poses in turn: errors of a pixel settle in four."""
BLUR = 1.0
"""Projections are compared after a Gaussian of this standard deviation [pixels], as `align` compares frames."""
RIGID = [0, 1, 4]
"""Of the derivatives of a projection: by the two shifts and by the roll, which move an image in its plane."""


def by_mass(scan: Scan, prior: MaterialPrior, on_progress: Progress) -> Scan:
    """Shifts that bring the centres of mass of retrieved thickness to the projections of one point."""
    found = shifts_by_mass(_thickness(scan, prior, on_progress).double().numpy(), scan.views)
    return scan.with_views(replace(scan.views, shifts=scan.views.shifts + scan.views.pixel_size * found))


def by_reprojection(scan: Scan, prior: MaterialPrior, on_progress: Progress, rounds: int = ROUNDS) -> Scan:
    """Shifts and roll of each view by which its retrieved thickness fits that of a volume of all views, in turn.

    Iterative reprojection (Dengler 1989, Ultramicroscopy 30, 337; Gürsoy et al. 2017, Sci. Rep. 7, 11818), with the
    volume of total-variation tomography, and least squares in place of cross-correlation, so that parts of a pixel and
    the roll are found, too.
    """
    lines = _thickness(scan, prior, on_progress) / scan.views.pixel_size
    upper, views = 1.0 if isinstance(prior, Known) else None, scan.views
    for n in range(rounds):
        plain = in_pixels(views)
        grid = Grid.of_views(in_pixels(scan.views))
        volume = TOMOGRAPHIES["tv"](lines, plain, grid, upper, lambda fraction: None)
        views = _registered(lines, volume, grid, views)
        on_progress("reprojection", (n + 1) / rounds)
    return scan.with_views(views)


def by_align(scan: Scan, prior: MaterialPrior, on_progress: Progress) -> Scan:
    """`holosplat align`: shifts, roll and turns by the frames themselves."""
    found = align_views(scan, prior, on_progress=on_progress)
    return Scan(scan.frames, found.exposures, scan.is_test, scan.provenance)


ALIGNERS: dict[str, tuple[str, Aligner]] = {
    "mass": ("views shifted by centres of mass", by_mass),
    "reprojection": ("views aligned with the tikhonov-tv volume", by_reprojection),
    "align": ("views aligned by holosplat align", by_align),
}
"""Name → one line of what it does, and the aligner."""


def _thickness(scan: Scan, prior: MaterialPrior, on_progress: Progress) -> Tensor:
    """Retrieved thickness [V, H, W] [m]."""
    material = assumed_material(scan, prior, on_progress)
    return tikhonov(torch.from_numpy(scan.frames), scan.exposures, *material)


def _registered(lines: Tensor, volume: Tensor, grid: Grid, views: Views) -> Views:
    """`views` after a step of shifts and roll by which the projections of `volume` are nearest to `lines` [pixels]."""
    projected, slopes = projections(volume, grid, in_pixels(views))
    missing = blurred(lines - projected, BLUR).flatten(1).double().numpy()
    columns = blurred(slopes[:, RIGID], BLUR).flatten(2).double().numpy()
    rotations, shifts = views.rotations.copy(), views.shifts.copy()
    for v, (column, left) in enumerate(zip(columns, missing)):
        x, y, roll = np.linalg.lstsq(column.T, left, rcond=1e-9)[0]
        rotations[v] = Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix() @ rotations[v]
        shifts[v] += views.pixel_size * np.array([x, y])
    return replace(views, rotations=rotations, shifts=shifts)


@dataclass(frozen=True)
class BenchMethod:
    """name: for the command line and the table; family: its heading in the table; summary: one line of what it does;
    options: of the library's method that runs; aligner: what first finds where the beams are (None: nothing)."""

    name: str
    family: str
    summary: str
    options: Options
    aligner: Aligner | None = None

    def run(self, scan: Scan, prior: MaterialPrior, seed: int, on_progress: Progress) -> Object:
        """The Object that the method makes of the training frames `scan`; `InputError` where it cannot."""
        if self.aligner is not None:
            scan = self.aligner(scan, prior, on_progress)
        return reconstruct(
            scan, prior, self.options, seed, on_progress=lambda stage, part, record: on_progress(stage, part)
        ).object
