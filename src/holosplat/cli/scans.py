"""The frames of a scan that a run, which knows one time, can be compared with."""

from __future__ import annotations

from pathlib import Path

from ..io.formats import read
from ..io.json import read_json
from ..io.run_scan import at_time
from ..scan import Scan
from ..workflows.reconstruct import require_one_time
from ..workflows.run_folder import RunFolder


def scan_for(folder: RunFolder, scan: Path) -> Scan:
    """A scan to compare a run with: of a time-resolved one, the frames of the time that the run is of."""
    found = read(scan)
    if found.is_series:
        found = at_time(found, read_json(folder.source).get("time_frame") if folder.source.is_file() else None)
        require_one_time(found)
    return found.in_memory()
