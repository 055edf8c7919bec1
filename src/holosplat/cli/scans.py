"""The frames of a scan that a run can be compared with, and the run as it is at their time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from ..checks import require
from ..io.formats import read_frames, run_reading
from ..io.reading import Reading, at_time
from ..mesh import TriangleMesh
from ..representations import InMotion, MovingSurfaces, SurfaceMesh
from ..scan import Scan
from ..series.folder import SeriesFolder
from ..workflows.preconditions import require_one_time
from ..workflows.reconstruct import load_reconstruction
from ..workflows.reconstruction import Reconstruction, chosen_frames, instants_of, reconstruction_at, where_found
from ..workflows.run_folder import RunFolder


def scan_for(folder: RunFolder, scan: Path | None, reading: Reading) -> Scan:
    """A scan to compare a run with: of a time-resolved one, the frames of the time that the run is of.

    scan: None is the run's own, read as the run did, but for what `reading` says otherwise. Where the run refined the
    geometry, its own frames are where it found them.
    """
    own = run_reading(folder.path) if folder.source.is_file() else Reading()
    if scan is None:
        found = read_frames(folder.source_scan(), reading.over(own))
    else:
        found = read_frames(scan, reading)
        if found.is_series:
            found = at_time(found, own.part.time_frame)
    if found.is_series and not instants_of(folder):
        require_one_time(found)
    return where_found(folder, found.in_memory())


def run_and_scan(folder: RunFolder, scan: Path | None, reading: Reading) -> tuple[Reconstruction, Scan]:
    """A run, and the scan to compare it with (see `scan_for`).

    Of a run in motion --time-frame chooses the time of both; without it, frames of all times are compared with the
    bodies at these. Errors: `InputError` for times that the run does not have.
    """
    result, times = load_reconstruction(folder), instants_of(folder)
    if not times:
        return result, scan_for(folder, scan, reading)
    frame = reading.part.time_frame
    if isinstance(frame, int):
        result = reconstruction_at(result, times, frame)
    else:
        reading = replace(reading, part=replace(reading.part, time_frame=None))
    return result, scan_for(folder, scan, reading)


@dataclass(frozen=True)
class Moment:
    """A run as it is at one time. frame: the time's number, which names of its files add, or None; time [s]; bodies:
    closed meshes [m], if it has them, of a run in motion in the order of their identities; folder: of the run."""

    frame: int | None
    time: float
    result: Reconstruction
    bodies: list[TriangleMesh] | None
    folder: RunFolder


def runs_of(path: Path) -> list[tuple[float, RunFolder]]:
    """The times [s] of a series of single times, and their run folders; nothing for what is no such series."""
    series = SeriesFolder(path)
    plan = series.plan() if series.file.is_file() else None
    if plan is None or plan.settings.act == "track":
        return []
    each = [(window.number, moment) for window in plan.windows() for moment in window.own]
    return [(moment.time, RunFolder(series.run(task, moment.number))) for task, moment in each]


def moments_of(folder: RunFolder, time_frame: int | Literal["all"] | None) -> Iterator[Moment]:
    """A run, or a series of single times, at the times that are asked for.

    time_frame: of a series and of a run in motion, the time, counted from 0 (default: the first), or "all". Errors:
    `InputError` for times that they do not have or that are not done, before the first, and for any of a run that
    stands still.
    """
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
        result = load_reconstruction(run)
        bodies = result.object.bodies() if isinstance(result.object, SurfaceMesh) else None
        yield Moment(k if time_frame == "all" else None, time, result, bodies, run)
    if runs:
        return
    result, times = load_reconstruction(folder), instants_of(folder)
    found = result.object
    if not isinstance(found, InMotion):
        require(time_frame is None, f"{folder.path} is of one time; leave --time-frame.")
        yield Moment(None, 0.0, result, found.bodies() if isinstance(found, SurfaceMesh) else None, folder)
        return
    for k in chosen_frames(time_frame, times):
        bodies = found.bodies(times[k]) if isinstance(found, MovingSurfaces) else None
        yield Moment(k if time_frame == "all" else None, times[k], reconstruction_at(result, times, k), bodies, folder)
