"""The folder of a benchmark: its rows, the pictures that go with them, the cases' scans, and the report."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from holosplat.checks import InputError, require
from holosplat.io.atomic import atomic_path, is_taken, read_json, require_parent, write_json
from holosplat.io.guard import read_archive
from holosplat.io.lock import is_hidden
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


NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+-]*")
"""Names of cases and methods, which become names of files."""


class BenchFolder:
    """`bench.json` (marks the folder), rows/, pictures/, cases/, report.html, report.md, report/ (its pictures).

    Every file is written whole or not at all, so that an interrupted benchmark can go on.
    """

    FORMAT = "holosplat bench 1"

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.marker = self.path / "bench.json"
        self.rows = self.path / "rows"
        self.pictures = self.path / "pictures"
        self.cases = self.path / "cases"
        self.html = self.path / "report.html"
        self.markdown = self.path / "report.md"
        self.images = self.path / "report"

    def require_usable(self) -> None:
        """`InputError` unless the folder can be made, is empty, or holds a benchmark already."""
        require_parent(self.path)
        if is_taken(self.path):
            self._require_marked(f"the benchmark's folder (--out) must be new, or hold a benchmark, but {self.path}")

    def require_bench(self) -> None:
        """`InputError` unless the folder holds a benchmark."""
        require(self.path.is_dir(), f"the benchmark's folder {self.path} does not exist; check the path.")
        self._require_marked(f"a report needs the folder of a benchmark, but {self.path}")

    def create(self) -> None:
        """Make the folder, as far as it is not there."""
        self.require_usable()
        for folder in (self.path, self.rows, self.pictures, self.cases):
            folder.mkdir(exist_ok=True)
        if not self.marker.is_file():
            write_json(self.marker, {"format": self.FORMAT})

    def case(self, case: str, seed: int) -> Path:
        """The folder of a case with a seed."""
        return self.cases / f"{good_name(case)}.{seed}"

    def has_row(self, case: str, seed: int, method: str, retry: bool = False) -> bool:
        """Whether a row is there; with `retry`, a failed one does not count."""
        path = self._row(case, seed, method)
        return path.is_file() and (not retry or read_row(path).done)

    def write_row(self, row: Row) -> None:
        """Add or replace a row."""
        write_row(self._row(row.case, row.seed, row.method), row)

    def read_rows(self) -> list[Row]:
        """All rows: by case and seed, in the methods' order."""
        rows = [read_row(path) for path in sorted(self.rows.glob("*.json")) if not is_hidden(path)]
        return sorted(rows, key=lambda row: (row.case, row.seed, not row.is_reference, row.place, row.method))

    def write_picture(self, case: str, seed: int, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Add or replace the arrays of a picture; name: the method, or `truth`."""
        with atomic_path(self._picture(case, seed, name)) as temporary:
            np.savez_compressed(temporary, allow_pickle=False, **dict(arrays))

    def read_picture(self, case: str, seed: int, name: str) -> dict[str, np.ndarray] | None:
        """The arrays of a picture, or None if there is none; `InputError` if the file is damaged."""
        path = self._picture(case, seed, name)
        if not path.is_file():
            return None
        return read_archive(path, what="a picture of the benchmark")

    def describe_case(self, case: str, seed: int) -> dict[str, Any]:
        """What case.json says of a case; empty where its folder is gone."""
        path = self.case(case, seed) / "case.json"
        return read_json(path) if path.is_file() else {}

    def _row(self, case: str, seed: int, method: str) -> Path:
        return self.rows / f"{good_name(case)}.{seed}.{good_name(method)}.json"

    def _picture(self, case: str, seed: int, name: str) -> Path:
        return self.pictures / f"{good_name(case)}.{seed}.{good_name(name)}.npz"

    def _require_marked(self, sentence: str) -> None:
        marked = self.marker.is_file() and read_json(self.marker).get("format") == self.FORMAT
        require(marked, f"{sentence} holds other files; choose another.")


def good_name(name: str) -> str:
    """`name`, if it can be a part of a file's name."""
    good = NAME.fullmatch(name) is not None
    require(good, f"names of cases and methods must be of letters, digits, '-', '_' and '+', but one is {name!r}.")
    return name
