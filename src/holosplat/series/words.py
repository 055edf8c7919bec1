"""How far a series is, in words."""

from __future__ import annotations

from collections.abc import Sequence

from .folder import TaskState
from .rows import Row

LONGEST = 160
"""Characters of a reason in a table."""


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


def plain(text: str) -> str:
    """`text` on one line without control characters, cut where it is long."""
    line = "".join(c if c.isprintable() else " " for c in text)
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 1]}…"


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


def duration(seconds: float) -> str:
    """Seconds for people: 75 s, 12 min, 3.4 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def line_of(row: Row) -> str:
    """How a time went, in a line."""
    said = f"{row.begun}, {row.size}, {row.seconds:.1f} s" if row.done else f"failed: {row.reason}"
    return f"time {row.number}: {said}"


def some(numbers: Sequence[int], most: int = 12) -> str:
    """The first of some numbers."""
    shown = ", ".join(str(number) for number in numbers[:most])
    return shown if len(numbers) <= most else f"{shown} …"
