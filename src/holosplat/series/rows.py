"""The result of one time of a series as a small JSON file, and as a line of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from ..checks import as_written, require
from ..io.json import read_json, write_json
from ..tables import from_table

ROW = "row.json"
Begun = Literal["", "cold", "warm", "anew"]
Body = tuple[float, float, float, float]


@dataclass(frozen=True)
class Row:
    """One time. number: of the series; scan, frame, time_s: where it comes from.

    - status: `done`, or `failed` for the `reason` given
    - begun: `cold`, by itself; `warm`, with what the time before ended with; `anew`, by itself, for warm was not enough
    - kind, size: of the object; unexplained: share of the matter that training frames leave; reference: the same of the
      last time that began by itself; good: whether frames are explained; words: that in a sentence
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
    kind: str = ""
    size: str = ""
    unexplained: float | None = None
    reference: float | None = None
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
    said = f"{row.begun}, {row.size}, {row.seconds:.1f} s" if row.done else f"failed: {row.reason}"
    return f"time {row.number}: {said}"


def some(numbers: Sequence[int], most: int = 12) -> str:
    """The first of some numbers."""
    shown = ", ".join(str(number) for number in numbers[:most])
    return shown if len(numbers) <= most else f"{shown} …"
