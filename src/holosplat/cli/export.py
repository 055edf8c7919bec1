"""The files of `holosplat export`: volumes, bodies, splats and objects in few bytes, of one time or of several."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ..checks import InputError, as_written, in_range, require
from ..geometry import Grid
from ..io.atomic import read_json
from ..io.formats import FORMATS, HDF5_SUFFIXES, of_time, read_frames, run_reading, volume_format
from ..io.objects import names_of, steps_of, write_compact, write_series
from ..io.paraview import TimeStep, write_pvd, write_vtu
from ..io.plain_values import write_xdmf
from ..io.provenance import require_free
from ..io.reading import at_time
from ..io.solids import write_glb, write_moving_glb, write_splats, write_stl
from ..io.volumes import REFRACTION, Contents
from ..mesh import TriangleMesh
from ..planning.acts import of_export
from ..representations import GaussianCloud, InMotion, MovingSurfaces, SurfaceMesh
from ..scan import PIXEL_RANGE_M, Exposures
from ..units import number_of
from ..workflows.export import export
from ..workflows.reconstruct import load_reconstruction
from ..workflows.reconstruction import Reconstruction, chosen_frames, instants_of, reconstruction_at, where_found
from ..workflows.rehearsal import matter_of
from ..workflows.run_folder import RunFolder
from .scans import runs_of
from .sentence import say, tell
from .track import write_bodies

MOST_VOXELS = 2**31
"""The largest volume that `export` writes: 16 GB for δ and β."""
STL, GLB, VTU = ".stl", ".glb", ".vtu"
"""Suffixes of files that hold all bodies."""
SERIES = {".h5": ".xdmf", ".hdf5": ".xdmf", ".vti": ".pvd", VTU: ".pvd"}
"""Suffixes of files of single times, and that of the file beside them which opens all of them in ParaView."""


Sampling = tuple[tuple[int, int, int] | None, float | None]
"""Shape (z, y, x) and voxel size [m] of volumes, as they are asked for."""


@dataclass(frozen=True)
class Moment:
    """A run at one time [s]. frame: its number, which file names add, or None; bodies: closed meshes [m], if it has
    them; folder: of the run; own: the number of the time in the run, None where this is of one time."""

    frame: int | None
    time: float
    result: Reconstruction
    bodies: list[TriangleMesh] | None
    folder: RunFolder
    own: int | None = None

    @classmethod
    def of(cls, frame: int | None, time: float, result: Reconstruction, folder: RunFolder) -> Moment:
        """Of a run, at the nearest of its times where its matter moves."""
        found, own, times = result.object, None, instants_of(folder)
        if isinstance(found, InMotion):
            own = int(np.argmin(np.abs(np.array(times) - time)))
            bodies = found.bodies(times[own]) if isinstance(found, MovingSurfaces) else None
            result = reconstruction_at(result, times, own)
        else:
            bodies = found.bodies() if isinstance(found, SurfaceMesh) else None
        return cls(frame, time, result, bodies, folder, own)


def write_files(
    run: Path,
    files: Mapping[str, Path | None],
    sampling: Sampling,
    time_frame: int | Literal["all"] | None,
    step_px: float,
    together: tuple[Path, ...],
) -> None:
    """Write the `files` that options of `export` name. Errors: `InputError` before the first, as far as can be told."""
    folder, volume, bodies = RunFolder(run), files["volume"], files["bodies"]
    _require_suffixes(files)
    single = runs_of(run)
    every = range(len(single or instants_of(folder))) if time_frame == "all" else ()
    moving = None
    if not single and bodies is not None and time_frame == "all" and bodies.suffix.lower() == GLB:
        moving = load_reconstruction(folder)
        moving = moving if isinstance(moving.object, MovingSurfaces) else None
    timed = [path for path in (volume, None if moving else bodies, files["splats"]) if path is not None]
    _require_free(timed, every)
    if (compact := files["compact"]) is not None:
        _export_compact(folder, compact, step_px, together)
    if bodies is not None and moving is not None and isinstance(moving.object, MovingSurfaces):
        write_moving_glb(bodies, moving.object, instants_of(folder), moving.contents)
        say(f"wrote {bodies}: {number_of(moving.object.count, 'body')} in motion")
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
                grid = _export_volume(one, out, sampling)
            else:
                found = one.result.object
                if not isinstance(found, GaussianCloud):
                    kind = found.described
                    raise InputError(f"--splats needs a run of Gaussians, but this one holds {kind}; use --bodies.")
                write_splats(out, found)
                say(f"wrote {out}: {found.described}, whose opacity stands for thickness")
    for path in timed if every else ():
        _export_series(path, steps[path], grid, contents)
    if contents.mu_per_beta is not None:
        say("δ is not told, for the frames show absorption alone: the attenuation coefficient µ stands in its place")


def _require_suffixes(files: Mapping[str, Path | None]) -> None:
    """`InputError` for a name of a file whose suffix is of no format, before anything is written."""
    if (volume := files["volume"]) is not None:
        volume_format(volume, "--volume")
    for name, what, suffixes in (
        ("bodies", "a folder without a suffix, or a file", ("", VTU, STL, GLB)),
        ("compact", "a file", HDF5_SUFFIXES),
        ("splats", "a file", (".ply",)),
    ):
        path, ends = files[name], ", ".join(filter(None, suffixes))
        fits = path is None or path.suffix.lower() in suffixes
        require(fits, f"--{name} must be {what} whose name ends with {ends}, but it is {path}; name another one.")


def _require_free(timed: Sequence[Path], every: Sequence[int]) -> None:
    """`InputError` where a file beside those that options name is there already: `timed` ones of `every` time."""
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
    suffix = SERIES.get(path.suffix.lower())
    if suffix is None:
        return
    out = path.with_suffix(suffix)
    if suffix == ".pvd":
        write_pvd(out, [TimeStep(time, (file,)) for time, file in steps])
    else:
        assert grid is not None
        write_xdmf(out, grid, steps, of)
    say(f"wrote {out}: {number_of(len(steps), 'time')}, for ParaView")


def _export_compact(folder: RunFolder, out: Path, step_px: float, together: tuple[Path, ...]) -> None:
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


def _export_bodies(one: Moment, out: Path) -> None:
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
    say(f"wrote {out}: {number_of(len(one.bodies), 'body')}")


def _exposures_of(folder: RunFolder, volume: Path, frame: int | None) -> Exposures | None:
    """The exposures of the training frames (of time `frame`), for HDF5 volumes; None if the scan cannot be read."""
    if volume.suffix.lower() not in HDF5_SUFFIXES:
        return None
    try:
        scan = read_frames(folder.source_scan(), run_reading(folder.path))
    except InputError as error:
        say(f"{volume} has no /views, for the run's scan cannot be read: {error}")
        return None
    scan = where_found(folder, scan if frame is None else at_time(scan, frame))
    return scan.exposures[np.flatnonzero(~scan.is_test)]


def _export_volume(one: Moment, volume: Path, sampling: Sampling) -> Grid:
    (shape, voxel_size), folder = sampling, one.folder
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
    export(one.result, volume, grid, exposures=_exposures_of(folder, volume, one.own), matter=matter_of(folder))
    say(f"wrote {volume}: {' × '.join(map(str, grid.shape))} voxels of {1e6 * grid.voxel_size[0]:.4g} µm")
    return grid


def _smaller(shape: tuple[int, int, int]) -> Iterator[tuple[str, tuple[int, int, int]]]:
    """A shape, and halves of it, with the words for these."""
    yield "", shape
    while max(shape) > 1:
        z, y, x = (max(1, n // 2) for n in shape)
        shape = z, y, x
        yield f" with --shape {z} {y} {x} of larger voxels", shape


def moments_of(folder: RunFolder, time_frame: int | Literal["all"] | None) -> Iterator[Moment]:
    """A run, or a series, at the time `time_frame` (counted from 0, default: the first) or "all" of
    them. Errors: `InputError`, before the first, for times that are missing or not done, and for any of a run of one
    time."""
    runs = runs_of(folder.path)
    chosen = chosen_frames(time_frame, [time for time, _ in runs]) if runs else []
    for k in chosen:
        require(
            runs[k][1].config.is_file() and runs[k][1].result().is_file(),
            f"time {k} of {folder.path} is not done; finish it with holosplat series run {folder.path}, or name "
            "another --time-frame.",
        )
    for k in chosen:
        time, run = runs[k]
        yield Moment.of(k if time_frame == "all" else None, time, load_reconstruction(run), run)
    if runs:
        return
    result, times = load_reconstruction(folder), instants_of(folder)
    if not isinstance(result.object, InMotion):
        require(time_frame is None, f"{folder.path} is of one time; leave --time-frame.")
        yield Moment.of(None, 0.0, result, folder)
        return
    for k in chosen_frames(time_frame, times):
        yield Moment.of(k if time_frame == "all" else None, times[k], result, folder)
