"""`holosplat export`: what runs hold, as files of other programs and in few bytes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from tyro.conf import Positional

from ..checks import InputError, as_written, in_range, require
from ..ranges import Pixels, checked_dataclass
from .places import Output
from .sentence import say

if TYPE_CHECKING:
    from ..geometry import Grid
    from ..io.volumes import Contents
    from ..scan import Exposures
    from ..workflows.reconstruct import Reconstruction
    from ..workflows.run_folder import RunFolder
    from .scans import Moment

MOST_VOXELS = 2**31
"""The largest volume that `export` writes: 16 GB for δ and β."""
STL, GLB, VTU = ".stl", ".glb", ".vtu"
"""Suffixes of files that hold all bodies."""
SERIES = {".h5": ".xdmf", ".hdf5": ".xdmf", ".vti": ".pvd", VTU: ".pvd"}
"""Suffixes of files of single times, and that of the file beside them which opens all of them in ParaView."""


@checked_dataclass
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
    """PLY file of splat viewers (µm), of a run of Gaussians; their opacity is no phase (docs/export.md)."""


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
        run: Run folder, or the folder of a series of single times.
        volume: Volume to write, by its suffix: .h5 or .hdf5, HDF5; .vti, for ParaView and PyVista; .nrrd, for 3D Slicer
            and ITK; .mrc, for ChimeraX; .tif or .tiff, an OME-TIFF; .zarr, a folder of OME-Zarr (extra zarr). NRRD and
            MRC hold δ alone, and β in NAME.beta.nrrd or NAME.beta.mrc. Of absorption alone µ [1/m] stands in δ's place.
            HDF5 also holds /views, the number of training views that show each voxel, if the run's scan is there; and
            of a rehearsed run /matter, the probability that a voxel is matter.
        shape: Voxels along z, y, x (default: the scan's field of view, Z = X = W, Y = H).
        voxel_size: Edge of a voxel [m] (default: the pixel size).
        bodies: Of a run of surfaces: a folder to make, with one VTK file a body (µm), the largest first, or of a run
            of track the same body under the same name at all times; or by its suffix one file of all bodies, .vtu
            (VTK, µm), .stl (µm) or .glb (glTF, m).
        time_frame: Of a series, and of a run of track: the time, counted from 0 (default: the first), or all, to files
            and folders whose names end with _t0000 and so on, or of track to one .glb in which the bodies move. Beside
            HDF5 a .xdmf, beside .vti and .vtu a .pvd opens all times in ParaView.
    """
    from ..io.formats import of_time
    from ..io.volumes import REFRACTION
    from ..workflows.reconstruction import instants_of
    from ..workflows.run_folder import RunFolder
    from .scans import moments_of, runs_of

    require(
        any((volume, bodies, objects.compact, objects.splats)),
        "export needs --volume, --bodies, --compact or --splats; name what to write.",
    )
    require(objects.compact is not None or not objects.together, "--together needs --compact; name its file.")
    folder = RunFolder(run)
    _require_suffixes(volume, bodies, objects)
    single = runs_of(run)
    every = range(len(single or instants_of(folder))) if time_frame == "all" else ()
    moving = not single and bodies is not None and time_frame == "all" and bodies.suffix.lower() == GLB
    moving = moving and _moves(folder)
    timed = [path for path in (volume, None if moving else bodies, objects.splats) if path is not None]
    _require_free(timed, every)
    if objects.compact is not None:
        _export_compact(folder, objects.compact, objects.step_px, objects.together)
    if bodies is not None and moving:
        _export_motion(folder, bodies)
    steps: dict[Path, list[tuple[float, Path]]] = {path: [] for path in timed}
    grid, contents = None, REFRACTION
    for one in moments_of(folder, time_frame) if timed else ():
        contents = one.result.contents
        for path in timed:
            out = path if one.frame is None else of_time(path, one.frame)
            steps[path].append((one.time, out))
            if path is bodies:
                _export_bodies(one, out)
            elif path is volume:
                grid = _export_volume(one.result, one.folder, out, (shape, voxel_size), None if single else one.frame)
            else:
                _export_splats(one.result, out)
    for path in timed if every else ():
        _export_series(path, steps[path], grid, contents)
    if contents.mu_per_beta is not None:
        say("δ is not told, for the frames show absorption alone: the attenuation coefficient µ stands in its place")


def _require_suffixes(volume: Path | None, bodies: Path | None, objects: ObjectFiles) -> None:
    """`InputError` for a name of a file whose suffix is of no format, before anything is written."""
    from ..io.formats import HDF5_SUFFIXES, volume_format

    if volume is not None:
        volume_format(volume, "--volume")
    for path, called, suffixes in (
        (bodies, "--bodies must be a folder without a suffix, or a file", ("", VTU, STL, GLB)),
        (objects.compact, "--compact must be a file", HDF5_SUFFIXES),
        (objects.splats, "--splats must be a file", (".ply",)),
    ):
        require(
            path is None or path.suffix.lower() in suffixes,
            f"{called} whose name ends with {', '.join(filter(None, suffixes))}, but it is {path}; name another one.",
        )


def _require_free(timed: Sequence[Path], every: Sequence[int]) -> None:
    """`InputError` where a file beside those that options name is there already: `timed` ones of `every` time."""
    from ..io.formats import FORMATS, of_time
    from ..io.provenance import require_free

    for path in timed:
        for out in [of_time(path, frame) for frame in every] or [path]:
            form = FORMATS.get(path.suffix.lower())
            for file in form.files(out) if form else ():
                require_free(file)
    series = [path.with_suffix(SERIES[path.suffix.lower()]) for path in timed if path.suffix.lower() in SERIES]
    for number, path in enumerate(series if every else ()):
        require(path not in series[:number], f"--volume and --bodies would share {path}; give them different names.")
        require_free(path)


def _export_series(path: Path, steps: Sequence[tuple[float, Path]], grid: Grid | None, of: Contents) -> None:
    """Write what opens files of all times, if their format has such."""
    from ..io.paraview import TimeStep, write_pvd
    from ..io.plain_values import write_xdmf

    suffix = SERIES.get(path.suffix.lower())
    if suffix is None:
        return
    out = path.with_suffix(suffix)
    if suffix == ".pvd":
        write_pvd(out, [TimeStep(time, (file,)) for time, file in steps])
    else:
        assert grid is not None
        write_xdmf(out, grid, steps, of)
    say(f"wrote {out}: {len(steps)} times, for ParaView")


def _export_compact(folder: RunFolder, out: Path, step_px: float, together: tuple[Path, ...]) -> None:
    from ..io.compact import steps_of
    from ..io.objects import names_of, write_compact, write_series
    from ..workflows.reconstruct import load_reconstruction
    from ..workflows.run_folder import RunFolder

    steps, folders = steps_of(step_px), [folder, *map(RunFolder, together)]
    for each in folders:
        require(
            load_reconstruction(each).delta_told,
            f"--compact stores δ, which {each.path} does not know: its frames show absorption alone; use --volume.",
        )
    if together:
        names = names_of([each.path for each in folders])
        write_series(out, {name: each.read_result() for name, each in zip(names, folders)}, steps)
    else:
        write_compact(out, folder.read_result(), steps)
    before, after = sum(each.result().stat().st_size for each in folders), out.stat().st_size
    of = f"{len(folders)} runs" if together else folder.result().name
    say(f"wrote {out}: {after / 1e6:.3g} MB, {before / after:.1f} times smaller than {of}")


def _moves(folder: RunFolder) -> bool:
    """Whether a run holds bodies in motion."""
    from ..representations import MovingSurfaces
    from ..workflows.reconstruct import load_reconstruction

    return isinstance(load_reconstruction(folder).object, MovingSurfaces)


def _export_motion(folder: RunFolder, out: Path) -> None:
    from ..io.solids import write_moving_glb
    from ..representations import MovingSurfaces
    from ..workflows.reconstruct import load_reconstruction
    from ..workflows.reconstruction import instants_of

    result = load_reconstruction(folder)
    found = result.object
    assert isinstance(found, MovingSurfaces)
    write_moving_glb(out, found, instants_of(folder), result.contents)
    say(f"wrote {out}: {found.count} bodies in motion")


def _export_splats(result: Reconstruction, out: Path) -> None:
    from ..io.solids import write_splats
    from ..representations import GaussianCloud

    found = result.object
    if not isinstance(found, GaussianCloud):
        raise InputError(f"--splats needs a run of Gaussians, but this one holds {found.described}; use --bodies.")
    write_splats(out, found)
    say(f"wrote {out}: {found.described}, whose opacity stands for thickness")


def _export_bodies(one: Moment, out: Path) -> None:
    from ..io.paraview import write_vtu
    from ..io.solids import write_glb, write_stl
    from ..representations import SurfaceMesh
    from .track import write_bodies

    found = one.result.object
    if one.bodies is None:
        raise InputError(
            f"--bodies needs a run of surfaces, but this one holds {found.described}; use holosplat surface."
        )
    suffix, of = out.suffix.lower(), one.result.contents
    matter = found.fillings() if isinstance(found, SurfaceMesh) else [found.matter] * len(one.bodies)
    if suffix == STL:
        write_stl(out, one.bodies)
    elif suffix == GLB:
        write_glb(out, one.bodies, matter, of)
    elif suffix == VTU:
        write_vtu(out, one.bodies, matter, of)
    else:
        write_bodies(out, one.bodies, [of.of_matter(each) for each in matter], {})
    say(f"wrote {out}: {len(one.bodies)} bodies")


def _exposures_of(folder: RunFolder, volume: Path, frame: int | None) -> Exposures | None:
    """The exposures of the training frames (of several times those of number `frame`), for what `volume` holds of them;
    None, said, where the scan cannot be read."""
    from ..io.formats import HDF5_SUFFIXES, read_frames, run_reading
    from ..io.reading import at_time
    from ..workflows.reconstruction import where_found

    if volume.suffix.lower() not in HDF5_SUFFIXES:
        return None
    try:
        scan = read_frames(folder.source_scan(), run_reading(folder.path))
    except InputError as error:
        say(f"{volume} has no /views, for the run's scan cannot be read: {error}")
        return None
    scan = where_found(folder, scan if frame is None else at_time(scan, frame))
    return scan.exposures[np.flatnonzero(~scan.is_test)]


def _export_volume(
    result: Reconstruction,
    folder: RunFolder,
    volume: Path,
    sampling: tuple[tuple[int, int, int] | None, float | None],
    frame: int | None = None,
) -> Grid:
    from ..geometry import Grid
    from ..io.atomic import read_json
    from ..planning.acts import of_export
    from ..scan import PIXEL_RANGE_M
    from ..workflows.export import export as write
    from ..workflows.rehearsal import matter_of
    from .sentence import tell

    shape, voxel_size = sampling
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
    write(result, volume, grid, exposures=_exposures_of(folder, volume, frame), matter=matter_of(folder))
    say(f"wrote {volume}: {' × '.join(map(str, grid.shape))} voxels of {1e6 * grid.voxel_size[0]:.4g} µm")
    return grid


def _smaller(shape: tuple[int, int, int]) -> Iterator[tuple[str, tuple[int, int, int]]]:
    """A shape, and halves of it, with the words for these."""
    yield "", shape
    while max(shape) > 1:
        z, y, x = (max(1, n // 2) for n in shape)
        shape = z, y, x
        yield f" with --shape {z} {y} {x} of larger voxels", shape
