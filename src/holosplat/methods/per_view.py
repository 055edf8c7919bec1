"""Phase retrieval of each view by itself, then tomography: what others do, with svmbir as one of the tomographies."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from types import ModuleType
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from ..baselines import TOMOGRAPHIES
from ..baselines.rays import in_pixels
from ..checks import InputError, MissingError, at_least, require
from ..geometry import Grid, Views
from ..matter import Matter
from ..optics.retrieval import RETRIEVALS
from ..progress import Advance
from ..projectors.voxels import rows_match
from ..ranges import Positive, Signed, checked_dataclass
from ..representations import Stored, VoxelGrid
from .ground import assumed_material
from .method import Method, Stage, Task


@checked_dataclass
class Mbir:
    """Options of `svmbir.recon`. snr_db: signal to noise assumed of the lines [dB]; sharpness: higher is sharper; p, T:
    shape and threshold of the qGGMRF prior (p near 1 keeps edges); iterations: all are done, for its own rule may stop
    after a few, far from the solution; threads: of the processor.
    """

    snr_db: Signed = 30.0
    sharpness: Signed = 1.0
    p: Positive = 1.1
    T: Positive = 0.3
    iterations: int = 20
    threads: int = 2

    def __post_init__(self) -> None:
        at_least(self, 1, "iterations", "threads")


def svmbir_volume(
    lines: Tensor,
    views: Views,
    grid: Grid,
    on_progress: Advance,
    *,
    options: Mbir = Mbir(),
    missing: Tensor | None = None,
    two_sided: bool = False,
) -> Tensor:
    """Occupancy [Z, Y, X] on `grid` from thickness `lines` [V, H, W] in metres; float32; ≥ 0 unless it is `two_sided`.

    qGGMRF prior, multi-resolution coordinate descent (Bouman & Sauer 1996; svmbir). The views must turn about y only
    and share one detector shift, the grid must be cubic, with the detector's rows and its middle on the rotation axis.
    """
    views.parallel("svmbir")
    program, pitch = _svmbir(), views.pixel_size
    views, grid = in_pixels(lines, views, grid)
    _check(views, grid)
    columns, _, rows = grid.shape  # of its image [Y, X, Z]
    on_progress(0.0)
    with tempfile.TemporaryDirectory() as cache:  # its system matrices, which it keeps for ever otherwise
        image = program.recon(
            (lines.float() / pitch).numpy(),
            -np.arctan2(views.rotations[:, 0, 2], views.rotations[:, 0, 0]),
            num_rows=rows,
            num_cols=columns,
            roi_radius=float(np.hypot(rows, columns)),  # all of the square, not its inscribed circle
            delta_pixel=grid.voxel_size[0],
            center_offset=float(-views.shifts[0, 0]),
            snr_db=options.snr_db,
            sharpness=options.sharpness,
            p=options.p,
            T=options.T,
            positivity=not two_sided,
            max_iterations=options.iterations,
            stop_threshold=0.0,
            num_threads=options.threads,
            svmbir_lib_path=cache,
            weights=None if missing is None else (~missing).double().numpy(),
            verbose=0,
        )
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))


def _check(views: Views, grid: Grid) -> None:
    """`InputError` unless svmbir's geometry, a parallel fan of slices about their middle, is that of the scan."""
    require(
        views.shares_axis,
        "svmbir needs views that turn about the y axis only, on pixels of one size; take tv, which takes any.",
    )
    alike = bool(np.allclose(views.shifts, views.shifts[0], atol=1e-6))
    require(alike, "svmbir needs one detector shift for all views; align the frames first.")
    require(rows_match(grid, views), "svmbir needs a grid whose rows along y are the detector's rows.")
    square = bool(np.isclose(grid.voxel_size[0], grid.voxel_size[2]))
    require(square, f"svmbir needs square voxels across the axis, but their edges are {grid.voxel_size} pixels.")
    off = float(np.abs(grid.centre[[0, 2]]).max())
    require(off < 1e-6, f"svmbir needs a grid with its middle on the rotation axis, but it is {off:g} pixels off.")


def _svmbir() -> ModuleType:
    try:
        import svmbir  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingError(
            "this method needs the package svmbir, which is not installed; pip install 'holosplat[bench]' has it."
        ) from error
    return svmbir


SVMBIR = "svmbir"
"""Another group's model-based reconstruction, where it is installed."""


@dataclass(frozen=True)
class PerView(Method):
    """Phase retrieval of each view, then tomography, on voxels of one pixel; the occupancy of one material."""

    kind: ClassVar[str] = "per-view"
    cones: ClassVar[bool] = True
    two_sided: ClassVar[bool] = True

    retrieval: str = "tikhonov"
    """Name of the phase retrieval."""
    tomography: str = "tv"
    """Name of the tomography."""
    bounded: bool = True
    """Whether the occupancy is kept below one where the material is known."""

    def __post_init__(self) -> None:
        for name, value, choices in (
            ("retrieval", self.retrieval, tuple(RETRIEVALS)),
            ("tomography", self.tomography, (*TOMOGRAPHIES, SVMBIR)),
        ):
            if value not in choices:
                raise InputError(f"{name} must be one of {', '.join(choices)}, but it is {value!r}.")

    def stages(self) -> tuple[Stage, ...]:
        """One, without a fit."""
        return (PerViewStage(self),)


@dataclass(frozen=True)
class PerViewStage:
    """Retrieval and tomography."""

    options: PerView
    name: str = "tomography"

    def start(self, task: Task, before: Stored | None) -> VoxelGrid:
        """Occupancies of the known material, or of the one that the frames suggest."""
        scan, how = task.scan, self.options
        material = assumed_material(scan, task.prior, task.on_progress)
        retrieve = RETRIEVALS[how.retrieval]
        frames = torch.from_numpy(scan.frames)
        report = task.report("phase retrieval")
        known = {"missing": scan.gaps, "two_sided": task.prior.two_sided}
        thickness = retrieve(frames, scan.exposures, *material, on_progress=report, **known)
        grid, report = Grid.of_views(scan.views), task.report(self.name)
        if how.tomography == SVMBIR:
            values = svmbir_volume(thickness, scan.views, grid, report, **known)
        else:
            upper = (task.bound(1.0) or None) if how.bounded else None
            tomography = TOMOGRAPHIES[how.tomography]
            values = tomography(thickness, scan.views, grid, upper, report, **known)
        return VoxelGrid(values[None], grid, Matter.one(*material))

    def fit(self, task: Task, start: Stored) -> None:
        """Nothing is fitted."""
