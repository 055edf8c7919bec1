"""The scan that a run folder was made from: `source.json` there names it, and the time that was chosen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..checks import require
from ..scan import Scan
from .loader import Loader, folder_with
from .table import Table

SOURCE = "source.json"


def read_run_scan(path: str | Path, read: Callable[[Path], Scan]) -> Scan:
    """The scan of the run folder `path`: its frames of the time that the run is of.

    `read` opens scans of any format. Errors: `InputError` when the scan is no longer there or cannot be read.
    """
    table = Table.read(Path(path) / SOURCE)
    scan = Path(table.text("scan"))
    there = scan.exists() and scan.resolve() != Path(path).resolve()
    require(there, f"{table.label('scan')} must name the run's scan, but {scan} is not there or none; name another.")
    time_frame = table.values.get("time_frame")
    known = time_frame is None or time_frame == "all" or isinstance(time_frame, int)
    require(known, f"{table.label('time_frame')} must be a number, 'all' or null, but it is {time_frame!r}.")
    return at_time(read(scan), time_frame)


def at_time(scan: Scan, time_frame: int | str | None) -> Scan:
    """The frames of the instant `time_frame`, of "all" as if nothing moved, or (None) the scan as it is."""
    if time_frame is None:
        return scan
    return scan.at_instant(time_frame) if isinstance(time_frame, int) else scan.as_static()


def loader(read: Callable[[Path], Scan]) -> Loader:
    """The loader of run folders, whose scans `read` opens."""
    mark = f"a run folder, with config.json and {SOURCE}"
    return Loader("run", mark, folder_with("config.json", SOURCE), lambda path, given: read_run_scan(path, read))
