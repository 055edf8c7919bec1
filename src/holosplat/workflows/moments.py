"""Runs of matter in motion: which times they know, and how they are at one of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from ..checks import as_written, require
from ..io.json import read_json
from ..representations import InMotion
from ..scan import Scan
from .reconstruction import Reconstruction
from .run_folder import RunFolder


def instants_of(folder: RunFolder) -> list[float]:
    """The times [s] of the frames that a run in motion was fitted to; empty for one that stands still."""
    with as_written(folder.summary, "what track wrote"):
        return [float(time) for time in read_json(folder.summary).get("times_s", ())]


def chosen_frames(time_frame: int | Literal["all"] | None, times: list[float]) -> list[int]:
    """Numbers of the instants that `time_frame` names; without one, the first. Errors: `InputError` for others."""
    if time_frame == "all":
        return list(range(len(times)))
    frame = 0 if time_frame is None else time_frame
    last = len(times) - 1
    require(0 <= frame <= last, f"the run's instants are counted from 0 to {last}, but {frame} is asked for.")
    return [frame]


def moment(done: Reconstruction, times: list[float], frame: int) -> Reconstruction:
    """`done` as it is at the instant `frame` (0 is the first) of `times` [s]: matter that stands still.

    Errors: `InputError` for an instant that there is not.
    """
    chosen_frames(frame, times)
    assert isinstance(done.object, InMotion)
    return replace(done, object=done.object.at(times[frame]))


def timed(scan: Scan, times: list[float], frame: int) -> Scan:
    """A scan of one time, which says 0 of it, as of the instant `frame` of `times` [s]."""
    exposures = replace(scan.exposures, time=[times[frame]] * len(scan))
    return Scan.of(scan.source, exposures, scan.is_test, scan.provenance)
