"""The scan that a run folder was made from, as `source.json` names it, and the marks of a run's HDF5 files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from ..checks import require
from ..scan import Scan
from .hdf5 import open_hdf5
from .raw_file import Loader, folder_with
from .reading import Reading
from .table import Table

SOURCE, SUMMARY = "source.json", "summary.json"

ReadAs = Callable[[Path, Reading], Scan]
"""Opens a scan of any format, read in a certain way."""


def run_reading(path: str | Path) -> Reading:
    """How the run folder `path` read its scan; `InputError` for a source.json that is damaged.

    Whether the scan may bring values of other files, the folder does not decide: it is as whoever reads it allows
    (`Told.vouch`).
    """
    table = Table.read(Path(path) / SOURCE)
    time_frame = table.values.get("time_frame")
    known = time_frame is None or time_frame in ("all", "still") or isinstance(time_frame, int)
    require(known, f"{table.label('time_frame')} must be a number, 'all' or null, but it is {time_frame!r}.")
    said = Reading.from_table(table.values.get("reading", {}), f"{table.label('reading')}")
    from .hdf5_guard import is_vouched  # needs h5py, which reading an option does not

    told = replace(said.told, allow_external=is_vouched(Path(path)))
    return Reading(told, replace(said.part, time_frame=time_frame))


def run_source(scan: Path, reading: Reading) -> dict[str, object]:
    """What source.json says of a run of `scan`, read in a certain way."""
    return {"scan": str(scan.resolve()), "time_frame": reading.part.time_frame, "reading": reading.as_table()}


def read_run_scan(path: str | Path, read_as: ReadAs) -> Scan:
    """The scan of the run folder `path`, read as the run read it: its frames of the time that the run is of, too.

    Where the run refined the geometry, its frames are where it found them. Errors: `InputError` when the scan is no
    longer there or cannot be read.
    """
    table = Table.read(Path(path) / SOURCE)
    scan = Path(table.text("scan"))
    there = scan.exists() and scan.resolve() != Path(path).resolve()
    require(there, f"{table.label('scan')} must name the run's scan, but {scan} is not there or none; name another.")
    return _where_found(Path(path) / SUMMARY, read_as(scan, run_reading(path)))


def _where_found(summary: Path, scan: Scan) -> Scan:
    """`scan` with the exposures that `summary` has, if the run found any; errors: `InputError` for other frames."""
    found = Table.read(summary).values.get("geometry") if summary.is_file() else None
    if found is None:
        return scan
    table, n = Table(summary, found, "geometry."), len(scan)
    rotations, shifts = table.numbers("rotations", (n, 3, 3)), table.numbers("shifts", (n, 2))
    planned = scan.exposures
    old = "pixel_sizes" not in found
    sizes = planned.views.pixel_sizes if old else table.numbers("pixel_sizes", (n,))
    views = replace(planned.views, rotations=rotations, shifts=shifts, scales=sizes / planned.views.pitch)
    exposures = replace(planned, views=views, distance=table.numbers("distance", (n,)))
    return scan.taken(exposures)


def loader(read_as: ReadAs) -> Loader:
    """The loader of run folders, whose scans `read_as` opens."""
    mark = f"a run folder, with config.json and {SOURCE}"
    return Loader("run", mark, folder_with("config.json", SOURCE), lambda path, given: read_run_scan(path, read_as))


def read_marks(path: Path, names: Sequence[str]) -> dict[str, str]:
    """Those of the attributes `names` that the file has at its top. Errors: `InputError`."""
    with open_hdf5(path) as file:
        return {name: str(file.attrs[name]) for name in names if name in file.attrs}
