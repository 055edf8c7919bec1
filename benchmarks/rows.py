"""Rows of benchmarks: written line by line, so that an end before time loses nothing, and what each took."""

from __future__ import annotations

import csv
import platform
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def written(path: Path | None, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """A CSV file of `rows`, each written and printed as soon as it is there; without a path they are printed as one."""
    with path.open("w", newline="") if path else nullcontext(sys.stdout) as file:
        table = csv.DictWriter(file, columns, lineterminator="\n")
        table.writeheader()
        for row in rows:
            table.writerow(row)
            file.flush()
            if path:
                print(row, flush=True)


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of a CSV file; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(rows: Sequence[Mapping[str, Any]], path: Path, columns: Sequence[str] = ()) -> None:
    """A CSV file of all rows; columns: those of the first row unless they are given, empty where a row has none."""
    from holosplat.io.atomic import atomic_path

    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, columns or list(rows[0]), restval="", lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def merge(rows: Sequence[Mapping[str, Any]], path: Path, *key: str, columns: Sequence[str] = ()) -> None:
    """The CSV file with `rows` after those of it that have other values of `key`; after all of it without a key."""
    new = {tuple(str(row[name]) for name in key) for row in rows}
    kept = [row for row in read(path) if not key or tuple(row[name] for name in key) not in new]
    write([*kept, *rows], path, columns)


def replaced(path: Path, *rows: DataclassInstance, key: int, digits: int = 4) -> None:
    """The CSV file of such rows with `rows` in place of those whose first `key` fields are the same, in order."""
    names = [field.name for field in fields(rows[0])]
    cells = [[f"{v:.{digits}g}" if isinstance(v, float) else str(v) for v in astuple(row)] for row in rows]
    kept = [one for old in read(path) if (one := list(old.values()))[:key] not in [new[:key] for new in cells]]
    write([dict(zip(names, one)) for one in sorted([*kept, *cells], key=_order)], path, names)


def _order(cells: Sequence[str]) -> list[tuple[float, str]]:
    """By what rows are sorted: numbers by their values."""
    return [(float(cell), "") if cell.replace(".", "", 1).isdigit() else (-1.0, cell) for cell in cells]


def shown(row: DataclassInstance) -> None:
    """Print every field with its name."""
    print(*(f"{field.name} {getattr(row, field.name)}" for field in fields(row)), sep="; ", flush=True)


@dataclass
class Spent:
    """What something took: seconds, those of the processor, and the most MB of the process."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    memory_mb: float = 0.0

    def told(self) -> tuple[float, float, float]:
        """All three."""
        return self.seconds, self.cpu_seconds, self.memory_mb


@contextmanager
def spent() -> Iterator[Spent]:
    """What is done inside takes; what the process held before counts as memory, too."""
    from machine import memory_megabytes

    with suppress(OSError):  # the most that is counted begins anew
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    found, began = Spent(), (time.perf_counter(), time.process_time())
    yield found
    found.seconds, found.cpu_seconds = time.perf_counter() - began[0], time.process_time() - began[1]
    found.memory_mb = memory_megabytes("VmHWM")


def machine() -> str:
    """The processor, in the words of rows."""
    import torch

    return f"{platform.machine()}, {torch.get_num_threads()} of 2 cores, shared"
