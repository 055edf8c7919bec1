"""`holosplat export`: what runs hold, as files of other programs and in few bytes."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from ..checks import InputError, as_written, in_range, require
from ..ranges import Pixels, ranged

if TYPE_CHECKING:
    from ..workflows.reconstruct import Reconstruction
    from ..workflows.run_folder import RunFolder
    from .scans import Moment

MOST_VOXELS = 2**31
"""The largest volume that `export` writes: 16 GB for δ and β."""


@dataclass(frozen=True)
@ranged
class CompactFile:
    """The object of a run, its numbers rounded to steps and compressed."""

    compact: Path | None = None
    """File to write (HDF5); of a run of track it holds all times."""
    step_px: Pixels = 1 / 32
    """Step of places in it [pixels]; those of sizes, orientations and amplitudes go with it."""


def export(
    run: Positional[Path],
    volume: Path | None = None,
    shape: tuple[int, int, int] | None = None,
    voxel_size: float | None = None,
    bodies: Path | None = None,
    time_frame: int | Literal["all"] | None = None,
    few_bytes: CompactFile = CompactFile(),
) -> None:
    """Write δ and β of a run as a volume, its bodies as meshes, or its object in few bytes.

    Args:
        run: Run folder.
        volume: Volume file to write: HDF5, or by its ending .ome.tif, .ome.tiff, .tif or .tiff an OME-TIFF with the
            channels δ and β.
        shape: Voxels along z, y, x (default: the scan's field of view, Z = X = W, Y = H).
        voxel_size: Edge of a voxel [m] (default: the pixel size).
        bodies: Folder to make, of a run of surfaces: one VTK file a body (µm), the largest first, or of a run of track
            the same body under the same name at all times.
        time_frame: Of a run of track: the time, counted from 0 (default: the first), or all, to files and folders whose
            names end with _t0000 and so on.
        few_bytes: The object itself in a file several times smaller than the run's.
    """
    from ..workflows.run_folder import RunFolder
    from .scans import moments_of

    require(
        any((volume, bodies, few_bytes.compact)), "export needs --volume, --bodies or --compact; name what to write."
    )
    folder = RunFolder(run)
    if few_bytes.compact is not None:
        _export_compact(folder, few_bytes.compact, few_bytes.step_px)
    if volume is None and bodies is None:
        return
    for one in moments_of(folder, time_frame):
        if bodies is not None:
            _export_bodies(one, bodies.with_name(bodies.name + one.ending))
        if volume is not None:
            _export_volume(one.result, folder, volume.with_stem(volume.stem + one.ending), shape, voxel_size)


def _export_compact(folder: RunFolder, out: Path, step_px: float) -> None:
    from ..io.atomic import require_writable
    from ..io.compact import steps_of
    from ..io.objects import read_object, write_compact

    steps = steps_of(step_px)
    require_writable(out)
    folder.require_run()
    write_compact(out, read_object(folder.result()), steps)
    before, after = folder.result().stat().st_size, out.stat().st_size
    _say(f"wrote {out}: {after / 1e6:.3g} MB, {before / after:.1f} times smaller than {folder.result().name}")


def _export_bodies(one: Moment, out: Path) -> None:
    from ..io.folder import require_new
    from .surface import write_bodies

    found = one.result.object
    if one.bodies is None:
        raise InputError(
            f"--bodies needs a run of surfaces, but this one holds {found.described}; use holosplat surface."
        )
    require_new(out)
    write_bodies(out, one.bodies, found.matter, {})
    _say(f"wrote {out}: {len(one.bodies)} bodies")


def _export_volume(
    result: Reconstruction,
    folder: RunFolder,
    volume: Path,
    shape: tuple[int, int, int] | None,
    voxel_size: float | None,
) -> None:
    from ..geometry import Grid
    from ..io.atomic import require_writable
    from ..io.json import read_json
    from ..io.volume_files import TIFF_SUFFIXES, write_ome_tiff
    from ..io.volumes import write_voxels
    from ..scan import PIXEL_RANGE_M

    require_writable(volume)
    with as_written(folder.summary, "what reconstruct wrote"):
        detector = read_json(folder.summary)["detector"]
        rows, columns = int(detector["rows"]), int(detector["columns"])
        edge = float(detector["pixel_size_m"]) if voxel_size is None else voxel_size
        x, y, z = (float(c) for c in detector.get("centre_m", (0.0, 0.0, 0.0)))
    edge = in_range("voxel size", edge, *PIXEL_RANGE_M, unit="metres")
    grid = Grid.centred(shape or (columns, rows, columns), edge, (x, y, z))
    count = math.prod(grid.shape)
    require(count <= MOST_VOXELS, f"shape must have at most {MOST_VOXELS:.0e} voxels, but it has {count:.0e}.")
    if volume.suffix.lower() in TIFF_SUFFIXES:
        write_ome_tiff(volume, result.object.voxelise(grid))
    else:
        write_voxels(volume, result.object, grid)
    _say(f"wrote {volume}: {' × '.join(map(str, grid.shape))} voxels of {1e6 * grid.voxel_size[0]:.4g} µm")


def _say(text: str) -> None:
    print(text, file=sys.stderr)
