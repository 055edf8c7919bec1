"""svmbir, another group's model-based reconstruction, after phase retrieval of each view, where it is installed."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from holosplat.baselines import Tomography
from holosplat.baselines.rays import bounded, in_pixels
from holosplat.checks import MissingError, require
from holosplat.geometry import Grid, Views
from holosplat.methods import PerView
from holosplat.progress import Advance
from holosplat.projectors.voxels import rows_match
from holosplat.ranges import Natural, Positive, Signed, checked_dataclass
from holosplat.rotations import angles_about_y


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
    iterations: Natural = 20
    threads: Natural = 2


def svmbir_volume(
    lines: Tensor,
    views: Views,
    grid: Grid,
    upper: float | None,
    on_progress: Advance,
    *,
    options: Mbir = Mbir(),
    missing: Tensor | None = None,
    two_sided: bool = False,
) -> Tensor:
    """Occupancy [Z, Y, X] on `grid` from thickness `lines` [V, H, W] in metres; float32; ≥ 0 unless `two_sided`.

    qGGMRF prior, multi-resolution coordinate descent (Bouman & Sauer 1996; svmbir). The views must turn about y only
    and share one pixel size and one detector shift; the grid must be cubic, with the detector's rows and its middle on
    the rotation axis. Errors: `InputError` for others, `MissingError` where svmbir is not installed.
    """
    views.parallel("svmbir")
    program, pitch = _svmbir(), views.pixel_size
    views, grid = in_pixels(lines, views, grid)
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
    columns, _, rows = grid.shape  # of its image [Y, X, Z]
    on_progress(0.0)
    with tempfile.TemporaryDirectory() as cache:  # its system matrices, which it keeps for ever otherwise
        image = program.recon(
            (lines.float() / pitch).numpy(),
            -angles_about_y(views.rotations),
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
    return bounded(torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))), None, upper)


def _svmbir() -> ModuleType:
    try:
        import svmbir  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingError(
            "this method needs the package svmbir, which is not installed; pip install 'holosplat[bench]' has it."
        ) from error
    return svmbir


@dataclass(frozen=True)
class MbirPerView(PerView):
    """Phase retrieval of each view, then `svmbir_volume` with its usual options."""

    tomographies: ClassVar[Mapping[str, Tomography]] = {"svmbir": svmbir_volume}

    tomography: str = "svmbir"
