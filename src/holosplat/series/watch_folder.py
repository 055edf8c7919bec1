"""The folder of a watch: what it is of, and a folder for each scan that has appeared."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..checks import as_written, require
from ..io.folder import is_taken, require_parent
from ..io.json import read_json, write_json
from ..workflows.run_folder import RunFolder
from .rows import ROW, Row, read_row

FORMAT = "holosplat watch 1"
MARKER, SCAN, SCANS = "watch.json", "scan.json", "scans"


@dataclass(frozen=True)
class Seen:
    """A scan that was begun. number: in the order of appearance; first: number of its first time; times: how many."""

    number: int
    key: tuple[str, int, int]
    first: int
    times: int


class WatchFolder:
    """`watch.json` (what is done with scans), scans/0000 … (one folder a scan), series.csv and live.html."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.marker = self.path / MARKER
        self.table = self.path / "series.csv"
        self.page = self.path / "live.html"

    def require_usable(self) -> None:
        """`InputError` unless the folder can be made, is empty, or holds a watch already."""
        require_parent(self.path)
        marked = self.marker.is_file() and read_json(self.marker).get("format") == FORMAT
        require(marked or not is_taken(self.path), f"{self.path} must be new, or hold a watch; choose another --out.")

    def begin(self, said: dict[str, Any]) -> None:
        """Begin with what is `said` of the watch, or go on; `InputError` where it was begun otherwise."""
        wanted = {"format": FORMAT, **said}
        if not self.marker.is_file():
            write_json(self.marker, wanted)
            (self.path / SCANS).mkdir(exist_ok=True)
        old = read_json(self.marker)
        other = sorted(name for name in wanted.keys() | old.keys() if old.get(name) != wanted.get(name))
        require(
            not other,
            f"{self.path} was begun with another {' and '.join(other)}; use the same options, or another --out.",
        )

    def scan(self, number: int) -> Path:
        """The folder of a scan."""
        return self.path / SCANS / f"{number:04d}"

    def run(self, scan: int, frame: int) -> RunFolder:
        """The run of a time of a scan."""
        return RunFolder(self.scan(scan) / f"t{frame:04d}")

    def row(self, scan: int, frame: int) -> Path:
        """The file of its row."""
        return self.scan(scan) / f"t{frame:04d}.{ROW}"

    def add(self, seen: Seen) -> None:
        """Note a scan whose work has started."""
        self.scan(seen.number).mkdir(exist_ok=True)
        name, size, changed = seen.key
        values = {"name": name, "bytes": size, "changed_ns": changed, "first": seen.first, "times": seen.times}
        write_json(self.scan(seen.number) / SCAN, values)

    def seen(self) -> list[Seen]:
        """The scans that were begun, in order."""
        found = []
        for path in sorted((self.path / SCANS).glob(f"[0-9]*/{SCAN}")):
            with as_written(path, "a scan of a watch"):
                table = read_json(path)
                key = str(table["name"]), int(table["bytes"]), int(table["changed_ns"])
                found.append(Seen(int(path.parent.name), key, int(table["first"]), int(table["times"])))
        return found

    def rows(self, seen: Seen) -> list[tuple[RunFolder, Row]]:
        """The times of a scan that have a row."""
        paths = [(self.run(seen.number, k), self.row(seen.number, k)) for k in range(seen.times)]
        return [(run, read_row(path)) for run, path in paths if path.is_file()]
