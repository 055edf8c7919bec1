"""A row of the benchmark: what came of one method on one case with one seed, as a small JSON file."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Literal

from holosplat.checks import InputError, require
from holosplat.io.json import read_json, write_json
from holosplat.metrics.images import json_number

REFERENCE = "reference"
"""The family of rows that no method could have made: they were given the truth."""

Numbers = dict[str, float | None]


@dataclass(frozen=True)
class Row:
    """One method on one case with one seed.

    - family, summary, place: of the method: its group, one line of what it does, its position in the table
    - status: `done`, or `failed` for the `reason` given
    - seconds: time of the method alone, without simulation and scores [s]
    - stored_bytes: size of its result; memory_bytes: growth of the process's memory to its peak; None: not known
    - test, train: means over held-out and training frames: ssim, frcm, psnr [dB], l1; empty where it failed
    - volume: the numbers of `VolumeScores`, and `resolution_half`, where the shell correlation falls below ½ [m]
    - scan_hash: of the frames; commit, versions, machine, when: what computed it, and the end of it (UTC)
    """

    case: str
    seed: int
    method: str
    family: str
    summary: str
    place: int
    status: Literal["done", "failed"]
    reason: str
    scan_hash: str
    commit: str
    when: str
    seconds: float | None = None
    stored_bytes: int | None = None
    memory_bytes: int | None = None
    test: Numbers = field(default_factory=dict)
    train: Numbers = field(default_factory=dict)
    volume: Numbers = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    machine: dict[str, str] = field(default_factory=dict)

    @property
    def done(self) -> bool:
        """Whether there is a result."""
        return self.status == "done"

    @property
    def is_reference(self) -> bool:
        """Whether the row was given the truth."""
        return self.family == REFERENCE


def write_row(path: Path, row: Row) -> None:
    """Write `row` as JSON, whole or not at all; infinite numbers become texts that float() reads."""
    values = asdict(row)
    for name in ("test", "train", "volume"):
        values[name] = {key: json_number(number) for key, number in values[name].items()}
    write_json(path, values)


def read_row(path: Path) -> Row:
    """The row that `write_row` wrote; `InputError` naming the file if it is none."""
    values = read_json(path)
    remedy = "remove the file, and the next `holosplat bench run` makes it again"
    names = {f.name for f in fields(Row)}
    odd = ", ".join(sorted(names ^ set(values)))
    require(not odd, f"{path} must be a row of this version's benchmark, but it differs in {odd}; {remedy}.")
    try:
        for name in ("test", "train", "volume"):
            values[name] = {key: None if n is None else float(n) for key, n in values[name].items()}
        row = Row(**values)
        good = row.status in ("done", "failed") and isinstance(row.seed, int) and (row.test or not row.done)
    except (AttributeError, TypeError, ValueError):
        good = False
    if not good:
        raise InputError(f"{path} must be a row of the benchmark, but its entries are not what they must be; {remedy}.")
    return row
