"""The folder of a series: its plan, a folder for each task, the state of each, and a row for each time; and a folder in
which scans appear."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal

from ..checks import as_written, require
from ..io.atomic import atomic_folder, read_json, require_new, write_json
from ..io.lock import Writer, is_hidden, writer_of
from ..tables import from_table
from ..workflows.run_folder import SERIES
from ..workflows.verdict import said_of_times
from .plan import SeriesPlan, Window, natural

ROW = "row.json"
Begun = Literal["", "cold", "warm", "anew", "back", "conserved"]
Body = tuple[float, float, float, float]


@dataclass(frozen=True)
class Row:
    """One time. number: of the series; scan, frame, time_s: where it comes from.

    - status: `done`, or `failed` for the `reason` given
    - begun: `cold`, by itself; `warm`, with what the time before ended with; `anew`, by itself, which was no worse than
      warm; `back`, with what the time after ended with, which was no worse than that; `conserved`, with the total of
      all other times; decided: by what evidence
    - kind, size: of the object; unexplained: share of the matter that training frames leave; good: whether frames are
      explained; words: that in a sentence
    - test, train: means over held-out and training frames: ssim, frcm, psnr [dB], l1; empty where there are none
    - quantity, total, total_error: the total of δ or β and its standard error [m³]
    - bodies: centre x, y, z [m] and volume [m³] of each closed body
    - seconds: of wall time
    """

    number: int
    scan: str
    frame: int
    time_s: float
    status: Literal["done", "failed"]
    reason: str = ""
    begun: Begun = ""
    decided: str = ""
    kind: str = ""
    size: str = ""
    unexplained: float | None = None
    good: bool | None = None
    words: str = ""
    test: Mapping[str, Any] = field(default_factory=dict)
    train: Mapping[str, Any] = field(default_factory=dict)
    quantity: str = ""
    total: float | None = None
    total_error: float | None = None
    bodies: tuple[Body, ...] = ()
    seconds: float = 0.0

    @property
    def done(self) -> bool:
        """Whether there is a result."""
        return self.status == "done"


def write_row(path: Path, row: Row) -> None:
    """Write a row, whole or not at all."""
    write_json(path, asdict(row))


def read_row(path: Path) -> Row:
    """The row that `write_row` wrote; `InputError` for anything else."""
    values = read_json(path)
    with as_written(path, "a row of a series"):
        odd = sorted({f.name for f in fields(Row)} ^ set(values))
        require(not odd, f"it differs in {', '.join(odd)} from this version's.")
        return from_table(Row, values)


LONGEST = 160
"""Characters of a reason in a table."""


def plain(text: str) -> str:
    """`text` on one line without control characters, cut where it is long."""
    line = "".join(c if c.isprintable() else " " for c in text)
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 1]}…"


def duration(seconds: float) -> str:
    """Seconds for people: 75 s, 12 min, 3.4 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def line_of(row: Row) -> str:
    """How a time went, in a line."""
    return f"time {row.number}: {outcome_of(row)}"


def outcome_of(row: Row) -> str:
    """How a time went: how it was begun, what it is, whether its frames are explained, and how long it took."""
    if not row.done:
        return f"failed: {plain(row.reason)}"
    explained = {True: "explained", False: "NOT explained", None: "not judged"}[row.good]
    decided = f"; {row.decided}" if row.decided else ""
    return f"{row.begun}, {row.size}, {explained}, {row.seconds:.1f} s{decided}"


def verdict_of(rows: Sequence[Row]) -> list[str]:
    """Which times are not explained, and why; how many are, where all are."""
    judged = [(row.number, row.good, row.words) for row in rows if row.done and row.good is not None]
    return said_of_times(judged, len(rows))


PLAN, TASKS, DONE, FAILED = SERIES, "tasks", "done.json", "failed.json"
State = Literal["done", "running", "failed", "left"]


@dataclass(frozen=True)
class TaskState:
    """How far a task is. reason: why it failed; writer: who runs it; times: done of all; seconds: what it took."""

    number: int
    state: State
    times: tuple[int, int]
    reason: str = ""
    writer: Writer | None = None
    seconds: float = 0.0


class SeriesFolder:
    """`series.json` (the plan), tasks/0000 … (one folder a task), tables of times, bodies, events and tracks, and
    series.html."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.file = self.path / PLAN
        self.table = self.path / "series.csv"
        self.bodies = self.path / "bodies.csv"
        self.events = self.path / "events.csv"
        self.tracks = self.path / "tracks.csv"
        self.fronts = self.path / "fronts.csv"
        self.page = self.path / "series.html"
        self.script = self.path / "slurm.sh"
        self.logs = self.path / "logs"

    def create(self, plan: SeriesPlan) -> None:
        """Make the folder with its plan; `InputError` where something is."""
        require_new(self.path, "choose another --out, or go on with holosplat series run")
        with atomic_folder(self.path) as temporary:
            write_json(temporary / PLAN, plan.as_table())
            (temporary / TASKS).mkdir()

    def plan(self) -> SeriesPlan:
        """The plan; `InputError` where the folder holds none."""
        require(self.path.is_dir(), f"the folder {self.path} of a series does not exist; check the path.")
        found = self.file.is_file()
        require(found, f"{self.path} must hold a series ({PLAN}), but it does not; make one by holosplat series plan.")
        return SeriesPlan.from_table(read_json(self.file), self.file)

    def task(self, number: int) -> Path:
        """The folder of a task."""
        return self.path / TASKS / f"{number:04d}"

    def run(self, task: int, moment: int) -> Path:
        """The run folder of a time of a task."""
        return self.task(task) / f"t{moment:04d}"

    def whole(self, task: int) -> Path:
        """The run folder of all times of a task together, where these are not taken by themselves."""
        return self.task(task) / "run"

    def run_of(self, task: int, moment: int) -> Path:
        """The run folder that has a time of a task, its own or that of all."""
        whole = self.whole(task)
        return whole if whole.is_dir() else self.run(task, moment)

    def row(self, task: int, moment: int) -> Path:
        """The file of a time's row."""
        return self.task(task) / f"t{moment:04d}.{ROW}"

    def rows(self, window: Window) -> list[Row]:
        """The rows of a task that are there, in order."""
        paths = [self.row(window.number, moment.number) for moment in window.moments]
        return [read_row(path) for path in paths if path.is_file()]

    def state(self, window: Window) -> TaskState:
        """How far a task is: what is written there says it, and nothing else."""
        folder = self.task(window.number)
        rows = self.rows(window)
        done = sum(row.done for row in rows), len(window.moments)
        seconds = sum(row.seconds for row in rows)
        if (folder / DONE).is_file():
            return TaskState(window.number, "done", done, seconds=seconds)
        writer = writer_of(folder)
        if writer is not None and not writer.gone:
            return TaskState(window.number, "running", done, writer=writer, seconds=seconds)
        if (folder / FAILED).is_file():
            return TaskState(window.number, "failed", done, str(read_json(folder / FAILED).get("reason", "")))
        return TaskState(window.number, "left", done, seconds=seconds)


def cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def table_of(states: Sequence[TaskState]) -> list[str]:
    """A line for each task."""
    return [
        f"{s.number:5d}  {s.state:8s} {s.times[0]:4d} of {s.times[1]:4d} times  {_detail(s)}".rstrip() for s in states
    ]


def _detail(state: TaskState) -> str:
    if state.writer is not None:
        writer = state.writer
        return f"by process {writer.process} on {writer.host} since {writer.since}"
    return plain(state.reason) or (f"{state.seconds:.1f} s" if state.state == "done" else "")


def time_left(states: Sequence[TaskState]) -> str:
    """How many tasks are in each state, and how long the rest takes at the pace so far."""
    names = [state.state for state in states]
    counts = "tasks: " + ", ".join(f"{names.count(name)} {name}" for name in ("done", "running", "failed", "left"))
    times, done = sum(s.times[1] for s in states), sum(s.times[0] for s in states)
    seconds, open_ = sum(s.seconds for s in states), sum(s.times[1] - s.times[0] for s in states if s.state != "failed")
    if not open_:
        return f"{counts}; {done} of {times} times are done"
    running = names.count("running")
    if not done or not seconds:
        return f"{counts}; {done} of {times} times are done, and none says yet how long the rest takes"
    left = open_ * seconds / done / max(1, running)
    by = f"by the {running} processes that run" if running > 1 else "by one process"
    return f"{counts}; {done} of {times} times are done; the rest takes about {duration(left)} {by}"


@dataclass(frozen=True)
class Found:
    """A file as it was when it was looked at: its size, and when it was changed [ns]."""

    path: Path
    size: int
    changed: int

    @property
    def key(self) -> tuple[str, int, int]:
        """What makes it another one: name, size and time of the change."""
        return self.path.name, self.size, self.changed


@dataclass
class Folder:
    """Regular files in `path` whose names fit `pattern`, links and hidden names apart; a file is complete once it has
    stayed as it is for `settle` seconds: a copy that is under way grows, and a rename brings a whole file."""

    path: Path
    pattern: str = "*"
    settle: float = 2.0
    _since: dict[tuple[str, int, int], float] = field(default_factory=dict)

    def complete(self, now: float) -> list[Found]:
        """The complete files by name, at the time `now` [s] of any clock that goes on."""
        there = {found.key: found for found in self._look()}
        self._since = {key: self._since.get(key, now) for key in there}
        ready = [there[key] for key, since in self._since.items() if now - since >= self.settle]
        return sorted(ready, key=lambda found: natural(found.path))

    def _look(self) -> list[Found]:
        found = []
        with os.scandir(self.path) as entries:
            for entry in entries:
                path = Path(entry.path)
                if is_hidden(path) or not fnmatch(entry.name, self.pattern):
                    continue
                try:
                    seen = entry.stat(follow_symlinks=False)
                except OSError:  # gone since
                    continue
                if stat.S_ISREG(seen.st_mode):
                    found.append(Found(path, seen.st_size, seen.st_mtime_ns))
        return found
