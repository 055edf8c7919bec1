"""`holosplat reconstruct --motion each`: every time by itself, begun with what the one before ended with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..checks import require
from ..io.formats import read_frames
from ..io.reading import Reading
from ..matter import MaterialPrior
from ..series.collect import collect
from ..series.folder import SeriesFolder, line_of
from ..series.plan import Cut, Settings, plan_series
from ..series.run import run_left
from .progress import INTERRUPTED
from .room import tell_each_time
from .sentence import say
from .series import UNFINISHED


def reconstruct_each(
    scan: Path,
    out: Path,
    settings: Settings,
    prior: Callable[[float], MaterialPrior],
    reading: Reading,
    resume: bool,
) -> None:
    """Make the series of all times of `scan` in the folder `out`, in this process, and its table and page.

    It is what `series plan`, `run` and `collect` make of it, as one task. resume: go on with a folder that was begun.
    Errors: `InputError` for a folder that is not of this, and what `plan_series` refuses.
    """
    reading = replace(reading, part=replace(reading.part, time_frame=None))
    every = plan_series([scan], settings, prior, reading, Cut())
    planned = replace(every, cut=Cut(window=len(every.moments())))
    seen, method, matter = read_frames(scan, reading), settings.method, settings.matter
    tell_each_time(seen.exposures[~seen.is_test], out, method, matter)
    folder = SeriesFolder(out)
    if resume and out.exists():
        require(
            folder.plan() == planned,
            f"{out} must be of the same scan and options to go on, but is not; leave --resume, choose another --out.",
        )
    else:
        folder.create(planned)
    try:
        counts = run_left(folder, retry=True, on_row=lambda row: say(line_of(row)))
    except KeyboardInterrupt:
        say(f"interrupted; go on with --out {out} --resume")
        raise SystemExit(INTERRUPTED) from None
    collect(folder)
    say(f"wrote {folder.table}, {folder.page}; each time is a run folder in {folder.task(0)}")
    if counts.failed or counts.left:
        raise SystemExit(UNFINISHED)
