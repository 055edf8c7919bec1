"""The frames of a scan that a run, which knows one time, can be compared with."""

from __future__ import annotations

from pathlib import Path

from ..io.formats import read_as
from ..io.reading import Reading, at_time
from ..io.run_scan import run_reading
from ..scan import Scan
from ..workflows.reconstruct import require_one_time
from ..workflows.refine import where_found
from ..workflows.run_folder import RunFolder


def scan_for(folder: RunFolder, scan: Path | None, reading: Reading) -> Scan:
    """A scan to compare a run with: of a time-resolved one, the frames of the time that the run is of.

    scan: None is the run's own, read as the run did, but for what `reading` says otherwise. Where the run refined the
    geometry, its own frames are where it found them.
    """
    own = run_reading(folder.path) if folder.source.is_file() else Reading()
    if scan is None:
        found = read_as(folder.source_scan(), reading.over(own))
    else:
        found = read_as(scan, reading)
        if found.is_series:
            found = at_time(found, own.part.time_frame)
    if found.is_series:
        require_one_time(found)
    return where_found(folder, found.in_memory())
