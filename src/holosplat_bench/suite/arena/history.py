"""The arena's time line: an entry a commit and machine, and what became worse from one to the next."""

from __future__ import annotations

import re
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from holosplat.checks import require
from holosplat.io.atomic import read_json, write_json
from holosplat.io.lock import RECORD
from holosplat.metrics.images import json_number

from ..folder import Row

FORMAT = "holosplat arena entry 1"
WORSE = 1.03
"""Factor from which on an error or a time is worse than in the entry before: 3 %."""
HIGHER = ("dice", "ssim")
"""Numbers of which more is better; of all others less."""

Numbers = Mapping[str, float | None]
"""Of a row: those of its track, and `seconds`."""


@dataclass(frozen=True)
class Entry:
    """commit, when (UTC), machine, versions: of the run; seed, size: of its cases; absent: what was not installed;
    rows: a dictionary of track, case, contestant, status, reason, numbers, seconds,
    memory_bytes and commit each."""

    commit: str
    when: str
    machine: dict[str, str]
    versions: dict[str, str]
    seed: int
    size: int
    absent: list[str]
    rows: list[dict[str, Any]]

    @classmethod
    def of(cls, rows: Sequence[Row], size: int, absent: Sequence[str], versions: Mapping[str, str]) -> Entry:
        """The entry of a run's rows, of the commit and machine of the last; versions: of the contestants' packages."""
        require(len(rows) > 0, "an entry of the arena needs rows, but there are none; run the arena first.")
        last = max(rows, key=lambda row: row.when)
        kept = [
            {
                "track": row.family,
                "case": row.case,
                "contestant": row.method.partition("+")[2],
                "summary": row.summary,
                "status": row.status,
                "reason": row.reason,
                "numbers": {name: json_number(value) for name, value in row.test.items()},
                "seconds": row.seconds,
                "memory_bytes": row.memory_bytes,
                "commit": row.commit,
            }
            for row in rows
        ]
        machine = {name: last.machine.get(name, "") for name in ("processor", "threads")}
        found = last.versions | dict(versions)
        return cls(last.commit, last.when, machine, found, last.seed, size, list(absent), kept)

    @property
    def file(self) -> str:
        """The name of its file: commit and machine."""
        return f"{slug(self.commit) or 'unknown'}_{slug(self.machine['processor'])}.json"

    @property
    def kind(self) -> tuple[object, ...]:
        """What entries have in common that can be compared."""
        return (self.machine["processor"], self.seed, self.size)

    def write(self, path: Path) -> None:
        """As JSON, whole or not at all."""
        write_json(path, {"format": FORMAT, **vars(self)})

    @classmethod
    def read(cls, path: Path) -> Entry:
        """What `write` wrote; `InputError` naming the file if it is none."""
        values = read_json(path)
        right = values.pop("format", None) == FORMAT and set(values) == set(cls.__dataclass_fields__)
        require(right, f"{path} must be an entry of the arena's time line, but it is not; remove it.")
        return cls(**values)

    def results(self) -> dict[tuple[str, str, str], Numbers]:
        """(track, contestant, case) → numbers, of rows that are done."""
        return {
            (row["track"], row["contestant"], row["case"]): row["numbers"] | {"seconds": row["seconds"]}
            for row in self.rows
            if row["status"] == "done"
        }


def slug(text: str) -> str:
    """Letters, digits and dashes alone, for names of files."""
    return re.sub(r"[^A-Za-z0-9]+", "-", text).strip("-").lower()


def read_history(folder: Path) -> list[Entry]:
    """The entries of a folder, the oldest first; none without a folder. Beside entries lie records of provenance."""
    entries = [path for path in sorted(folder.glob("*.json")) if not path.name.endswith(RECORD)]
    return sorted((Entry.read(path) for path in entries), key=lambda entry: entry.when)


@dataclass(frozen=True)
class Change:
    """A number of a contestant, mean over the cases that both entries have, and its factor to the entry before: above 1
    is worse; None: no entry before."""

    track: str
    contestant: str
    number: str
    value: float
    factor: float | None

    @property
    def worse(self) -> bool:
        """By 3 % or more."""
        return self.factor is not None and self.factor >= WORSE


def changes(entry: Entry, before: Entry | None) -> list[Change]:
    """The error, Dice, SSIM and seconds of every contestant, against the entry before on the same machine."""
    now, then = entry.results(), {} if before is None else before.results()
    found = []
    for track, contestant in dict.fromkeys(key[:2] for key in now):
        own = {key: numbers for key, numbers in now.items() if key[:2] == (track, contestant)}
        both = {key: numbers for key, numbers in own.items() if key in then} or own
        for number in dict.fromkeys(name for numbers in both.values() for name in numbers if name != "adjoint"):
            value = mean([numbers.get(number) for numbers in both.values()], number)
            earlier = mean([then[key].get(number) for key in both if key in then], number)
            if value is not None:
                found.append(Change(track, contestant, number, value, factor(number, value, earlier)))
    return found


def mean(values: Sequence[float | None], number: str) -> float | None:
    """Over cases: geometric for errors and times, which differ by factors from case to case, else arithmetic."""
    there = [float(value) for value in values if value is not None]
    if not there:
        return None
    if number in HIGHER:
        return statistics.fmean(there)
    return statistics.geometric_mean([max(value, 1e-12) for value in there])


def factor(number: str, value: float, earlier: float | None) -> float | None:
    """How many times worse than earlier, below 1 where it is better; None without an earlier number."""
    if earlier is None:
        return None
    good, bad = (value, earlier) if number in HIGHER else (earlier, value)
    return bad / good if good > 0 else float("inf")


def previous(entry: Entry, history: Sequence[Entry]) -> Entry | None:
    """The last of `history` before an entry on the same machine, with cases of the same seed and size."""
    earlier = [one for one in history if one.kind == entry.kind and one.when < entry.when]
    return max(earlier, key=lambda one: one.when, default=None)
