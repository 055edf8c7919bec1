"""From snapshots of moving bodies to a time-resolved scan (`holosplat simulate --frame-rate`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from ..checks import require
from ..io.paraview import find_snapshots
from ..progress import Advance
from ..ranges import Seconds, Signed, Weight, Within, checked_dataclass
from ..specimens.scene import ROUNDING, MeshSeries
from ..units import LENGTH_UNITS, unit_factor
from .simulate import Filling, Shutter, field_centre, filled_scene

FRAME_RATE_RANGE = (1e-6, 1e12)
MOST_TIMES = 1_000_000


@checked_dataclass
class Timing:
    """Times of the frames of a series.

    Errors: `InputError` for a rate or count out of range, or a start below 0.
    """

    frame_rate: Annotated[float, Within(*FRAME_RATE_RANGE, unit="Hz")]
    """Frames a second [Hz]."""
    frames: Annotated[int, Within(1, MOST_TIMES)] | None = None
    """Number of times (default: as many as the snapshots cover)."""
    start: Seconds | None = None
    """Time of the first frame after the first snapshot [s] (default: the earliest whose pulses all fit)."""
    shutter: Shutter = field(default_factory=Shutter)
    """Motion blur about each time (default: none)."""

    def times(self, length: float) -> np.ndarray:
        """Times [T] of the frames [s] after the first of snapshots that last `length` [s]; `InputError` if too few."""
        before = after = float(self.shutter.offsets[-1])
        start = before if self.start is None else self.start
        slack = ROUNDING * length
        require(
            start >= before - slack, f"start must be at least {before:g} s, half the pulses, but it is {start:g} s."
        )
        room = int(np.floor((length - after - start + slack) * self.frame_rate)) + 1
        room = min(max(room, 0), MOST_TIMES)
        count = room if self.frames is None else self.frames
        require(
            1 <= count <= room,
            f"the snapshots last {length:g} s, in which there is room for {room} frames at {self.frame_rate:g} Hz from "
            f"{start:g} s on, but {count} are asked for; ask for fewer, or a higher rate.",
        )
        return start + np.arange(count) / self.frame_rate


@checked_dataclass
class SeriesFiles:
    """How files of snapshots are read."""

    length_unit: str = "um"
    """Unit of the files' coordinates."""
    origin: tuple[Signed, Signed, Signed] | None = None
    """Point on the rotation axis at the field's centre, in `length_unit` (default: the middle of the swept box)."""
    interval: Seconds | None = None
    """Time from one snapshot to the next [s] (default: from the files)."""
    time_unit: str | None = None
    """Unit of a collection's time steps (default: seconds)."""
    period: tuple[Weight, Weight, Weight] | None = None
    """Edges of the periodic box that bodies are folded into, in `length_unit`, 0: open (default: no box)."""


def read_series(
    paths: Sequence[Path],
    filling: Filling,
    energy_kev: float,
    timing: Timing,
    files: SeriesFiles = SeriesFiles(),
    on_progress: Advance = lambda fraction: None,
) -> tuple[MeshSeries, np.ndarray]:
    """The moving bodies, filled and centred, and the times [T] of the frames [s], of which the first is 0.

    Only the snapshots that the frames need are read (`io.paraview.find_snapshots` says how files are named). Errors:
    `InputError` for files that cannot be read, bodies that change their triangles or jump (`MeshSeries`), and times
    beyond the snapshots. `on_progress(fraction)` is called after each snapshot.
    """
    snapshots = find_snapshots(paths, files.interval, files.time_unit)
    taken = np.array([snapshot.time - snapshots[0].time for snapshot in snapshots])
    times = timing.times(float(taken[-1]))
    slack = ROUNDING * taken[-1]
    start = max(int(np.searchsorted(taken, (times[0] + timing.shutter.offsets[0]) + slack, side="right")) - 1, 0)
    needed = slice(
        start, int(np.searchsorted(taken, (times[-1] + timing.shutter.offsets[-1]) - slack, side="left")) + 1
    )
    scenes = []
    for n, snapshot in enumerate(snapshots[needed]):
        scenes.append(filled_scene(snapshot.files, filling, energy_kev, files.length_unit))
        on_progress((n + 1) / len(snapshots[needed]))
    series = MeshSeries(tuple(scenes), taken[needed])
    if files.period is None:
        series.require_continuous()
    else:
        series = series.unfolded(unit_factor("length unit", files.length_unit, LENGTH_UNITS) * np.array(files.period))
    series = series.moved(-field_centre(series.bounds, files.origin, files.length_unit))
    return series.delayed(-float(times[0])), times - times[0]


def held_out(split: np.ndarray, views: int, times: int, what: Literal["views", "times"]) -> np.ndarray:
    """[times · views] bool: `split` of the views, the same at all times, or of the times, all their views."""
    return np.tile(split, times) if what == "views" else np.repeat(split, views)
