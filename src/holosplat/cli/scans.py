"""The frames of a scan that a run, which knows one time, can be compared with."""

from __future__ import annotations

from pathlib import Path

from ..io.json import read_json
from ..io.nxtomo import read_scan
from ..scan import Scan
from ..workflows.reconstruct import require_one_time
from ..workflows.run_folder import RunFolder


def at_time(scan: Scan, time_frame: int | str | None) -> Scan:
    """The frames of one time, of all as if nothing moved, or the scan as it is."""
    if time_frame is None:
        return scan
    return scan.at_instant(time_frame) if isinstance(time_frame, int) else scan.as_static()


def scan_for(folder: RunFolder, scan: Path) -> Scan:
    """A scan to compare a run with: of a time-resolved one, the frames of the time that the run is of."""
    found = read_scan(scan)
    if found.is_series:
        found = at_time(found, read_json(folder.source).get("time_frame") if folder.source.is_file() else None)
        require_one_time(found)
    return found
