"""The folder of a series: its plan, a folder for each task, and the state of each in words."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..checks import require
from ..io.folder import atomic_folder, require_new
from ..io.json import read_json, write_json
from ..io.lock import Writer, writer_of
from .plan import SeriesPlan, Window
from .rows import ROW, Row, duration, plain, read_row

PLAN, TASKS, DONE, FAILED = "series.json", "tasks", "done.json", "failed.json"
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
    """`series.json` (the plan), tasks/0000 … (one folder a task), series.csv, bodies.csv and series.html."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.file = self.path / PLAN
        self.table = self.path / "series.csv"
        self.bodies = self.path / "bodies.csv"
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
    counts = ", ".join(f"{names.count(name)} {name}" for name in ("done", "running", "failed", "left"))
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
