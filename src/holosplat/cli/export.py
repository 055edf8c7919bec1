"""`holosplat export`: what runs hold, as files of other programs and in few bytes."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from ..checks import InputError, as_written, in_range, require
from ..ranges import Pixels, ranged
from .places import Output

if TYPE_CHECKING:
    from ..workflows.reconstruct import Reconstruction
    from ..workflows.run_folder import RunFolder
    from .scans import Moment

MOST_VOXELS = 2**31
"""The largest volume that `export` writes: 16 GB for δ and β."""
STL, GLB = ".stl", ".glb"
"""Endings of files that hold all bodies."""


@dataclass(frozen=True)
@ranged
class ObjectFiles:
    """The object of a run as it is, not its volume."""

    compact: Output | None = None
    """File several times smaller than the run's, its numbers rounded to steps (HDF5); of a run of track it holds all
    times."""
    step_px: Pixels = 1 / 32
    """Step of places in it [pixels]; those of sizes, orientations and amplitudes go with it."""
    together: tuple[Path, ...] = ()
    """More runs of a series, in order, for the same file of --compact, which stores once what they have in common."""
    splats: Output | None = None
    """PLY file of splat viewers (µm), of a run of Gaussians; their opacity is no phase (docs/formats.md)."""


def export(
    run: Positional[Path],
    volume: Output | None = None,
    shape: tuple[int, int, int] | None = None,
    voxel_size: float | None = None,
    bodies: Output | None = None,
    time_frame: int | Literal["all"] | None = None,
    objects: ObjectFiles = ObjectFiles(),
) -> None:
    """Write δ and β of a run as a volume, its bodies as meshes, or its object in few bytes or as splats.

    Args:
        run: Run folder.
        volume: Volume to write, by its ending: .h5 or .hdf5, a file of HDF5; .ome.tif, .ome.tiff, .tif or .tiff, an
            OME-TIFF; .ome.zarr or .zarr, a folder of OME-Zarr (extra zarr); each with the channels δ and β.
        shape: Voxels along z, y, x (default: the scan's field of view, Z = X = W, Y = H).
        voxel_size: Edge of a voxel [m] (default: the pixel size).
        bodies: Of a run of surfaces: a folder to make, with one VTK file a body (µm), the largest first, or of a run
            of track the same body under the same name at all times; or by its ending one file of all bodies, .stl (µm)
            or .glb (glTF, m).
        time_frame: Of a run of track: the time, counted from 0 (default: the first), or all, to files and folders whose
            names end with _t0000 and so on, or to one .glb in which the bodies move.
    """
    from ..workflows.run_folder import RunFolder
    from .scans import moments_of

    require(
        any((volume, bodies, objects.compact, objects.splats)),
        "export needs --volume, --bodies, --compact or --splats; name what to write.",
    )
    require(objects.compact is not None or not objects.together, "--together needs --compact; name its file.")
    folder = RunFolder(run)
    if objects.compact is not None:
        _export_compact(folder, objects.compact, objects.step_px, objects.together)
    if bodies is not None and time_frame == "all" and bodies.suffix.lower() == GLB and _export_motion(folder, bodies):
        bodies = None
    if not any((volume, bodies, objects.splats)):
        return
    for one in moments_of(folder, time_frame):
        if bodies is not None:
            _export_bodies(one, bodies.with_stem(bodies.stem + one.ending))
        if objects.splats is not None:
            _export_splats(one.result, objects.splats.with_stem(objects.splats.stem + one.ending))
        if volume is not None:
            _export_volume(one.result, folder, _ending(volume, one.ending), shape, voxel_size)


def _ending(path: Path, ending: str) -> Path:
    """The path with `ending` before its suffixes, of which .ome.zarr and .ome.tif are two."""
    stem, ome, _ = path.stem.partition(".ome")
    return path.with_name(f"{stem}{ending}{ome}{path.suffix}")


def _export_compact(folder: RunFolder, out: Path, step_px: float, together: tuple[Path, ...]) -> None:
    from ..io.compact import steps_of
    from ..io.objects import write_compact
    from ..io.series import names_of, write_series
    from ..workflows.run_folder import RunFolder

    steps, folders = steps_of(step_px), [folder, *map(RunFolder, together)]
    for each in folders:
        each.require_run()
    if together:
        names = names_of([each.path for each in folders])
        write_series(out, {name: each.read_result() for name, each in zip(names, folders)}, steps)
    else:
        write_compact(out, folder.read_result(), steps)
    before, after = sum(each.result().stat().st_size for each in folders), out.stat().st_size
    of = f"{len(folders)} runs" if together else folder.result().name
    _say(f"wrote {out}: {after / 1e6:.3g} MB, {before / after:.1f} times smaller than {of}")


def _export_motion(folder: RunFolder, out: Path) -> bool:
    """Write a run of track as bodies that move; False, and nothing written, of any other."""
    from ..io.solids import write_moving_glb
    from ..representations import MovingSurfaces
    from ..workflows.moments import instants_of
    from ..workflows.reconstruct import load_reconstruction

    found, times = load_reconstruction(folder).object, instants_of(folder)
    if not isinstance(found, MovingSurfaces):
        return False
    write_moving_glb(out, found, times)
    _say(f"wrote {out}: {found.count} bodies in motion")
    return True


def _export_splats(result: Reconstruction, out: Path) -> None:
    from ..io.splats import write_splats
    from ..representations import GaussianCloud

    found = result.object
    if not isinstance(found, GaussianCloud):
        raise InputError(f"--splats needs a run of Gaussians, but this one holds {found.described}; use --bodies.")
    write_splats(out, found)
    _say(f"wrote {out}: {found.described}, whose opacity stands for thickness")


def _export_bodies(one: Moment, out: Path) -> None:
    from ..io.solids import write_glb, write_stl
    from .surface import write_bodies

    found = one.result.object
    if one.bodies is None:
        raise InputError(
            f"--bodies needs a run of surfaces, but this one holds {found.described}; use holosplat surface."
        )
    if out.suffix.lower() in (STL, GLB):
        write_stl(out, one.bodies) if out.suffix.lower() == STL else write_glb(out, one.bodies, found.matter)
    else:
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
    from ..io.json import read_json
    from ..io.ome_zarr import ZARR_SUFFIX, require_zarr, write_ome_zarr
    from ..io.volume_files import TIFF_SUFFIXES, VOLUME_SUFFIXES, write_ome_tiff
    from ..io.volumes import write_voxels
    from ..planning.acts import of_export
    from ..scan import PIXEL_RANGE_M
    from .room import tell

    known = (*VOLUME_SUFFIXES, ZARR_SUFFIX)
    require(
        volume.suffix.lower() in known,
        f"--volume must be a file whose name ends with {', '.join(known)}, by which its format is chosen, but it is "
        f"{volume}; name it so.",
    )
    if volume.suffix.lower() == ZARR_SUFFIX:
        require_zarr()
    with as_written(folder.summary, "what reconstruct wrote"):
        detector = read_json(folder.summary)["detector"]
        rows, columns = int(detector["rows"]), int(detector["columns"])
        edge = float(detector["pixel_size_m"]) if voxel_size is None else voxel_size
        x, y, z = (float(c) for c in detector.get("centre_m", (0.0, 0.0, 0.0)))
    edge = in_range("voxel size", edge, *PIXEL_RANGE_M, unit="metres")
    grid = Grid.centred(shape or (columns, rows, columns), edge, (x, y, z))
    count = math.prod(grid.shape)
    require(count <= MOST_VOXELS, f"shape must have at most {MOST_VOXELS:.0e} voxels, but it has {count:.0e}.")
    slabs = ((f"an HDF5 file{how}", of_export(shape, ".h5")) for how, shape in _smaller(grid.shape))
    tell("the volume", of_export(grid.shape, volume.suffix.lower()), volume, slabs)
    if volume.suffix.lower() in TIFF_SUFFIXES:
        write_ome_tiff(volume, result.object.voxelise(grid))
    elif volume.suffix.lower() == ZARR_SUFFIX:
        write_ome_zarr(volume, result.object, grid)
    else:
        write_voxels(volume, result.object, grid)
    _say(f"wrote {volume}: {' × '.join(map(str, grid.shape))} voxels of {1e6 * grid.voxel_size[0]:.4g} µm")


def _smaller(shape: tuple[int, int, int]) -> Iterator[tuple[str, tuple[int, int, int]]]:
    """A shape, and halves of it, with the words for these."""
    yield "", shape
    while max(shape) > 1:
        z, y, x = (max(1, n // 2) for n in shape)
        shape = z, y, x
        yield f" with --shape {z} {y} {x} of larger voxels", shape


def _say(text: str) -> None:
    print(text, file=sys.stderr)
