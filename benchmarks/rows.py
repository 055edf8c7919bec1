"""Rows of benchmarks: written line by line, so that an end before time loses nothing, and what each took."""

from __future__ import annotations

import csv
import platform
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def written(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, str]]) -> None:
    """A CSV file of `rows`, each written and printed as soon as it is there."""
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, columns, lineterminator="\n")
        table.writeheader()
        for row in rows:
            table.writerow(row)
            print(row, flush=True)
            file.flush()


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of a CSV file; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(rows: Sequence[Mapping[str, Any]], path: Path, columns: Sequence[str] = ()) -> None:
    """A CSV file of all rows; columns: those of the first row unless they are given."""
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, columns or list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def replaced(path: Path, row: DataclassInstance, key: int, digits: int = 4) -> None:
    """The CSV file of such rows with `row` in place of that whose first `key` fields are the same, in order."""
    from holosplat.io.atomic import atomic_path

    new = [f"{value:.{digits}g}" if isinstance(value, float) else str(value) for value in astuple(row)]
    old = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))[1:] if path.is_file() else []
    kept = [one for one in old if one[:key] != new[:key]]
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerows([[field.name for field in fields(row)], *sorted([*kept, new])])


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
