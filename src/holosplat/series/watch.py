"""Scans reconstructed as they appear in a folder, each begun with what the last one gave, and a page of them."""

from __future__ import annotations

import json
import os
import re
import socket
import stat
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from ..checks import InputError, as_written, require
from ..io.atomic import is_taken, require_parent, write_rows
from ..io.formats import loader_of, read_frames, run_source
from ..io.json import read_json, write_json
from ..io.leftovers import is_hidden
from ..io.lock import sole_writer
from ..io.reading import Reading
from ..matter import MaterialPrior
from ..ranges import Positive, Seconds, ranged
from ..scan import Scan
from ..workflows.run_folder import RunFolder
from .folder import ROW, Row, outcome_of, plain, read_row, write_row
from .one_time import PHASE, Before, Shot, reconstruct_time
from .plan import Settings, at, times_of
from .task import attempted

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
        wanted = json.loads(json.dumps({"format": FORMAT, **said}))  # as it is read again: lists for tuples
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


COLUMNS = (
    *("number", "scan", "frame", "time_s", "status", "begun", "explained", "unexplained", "total_m3", "total_error_m3"),
    *("seconds", "run", "reason"),
)
HEARTBEAT_SECONDS = 30.0
"""How often the page says that somebody looks, where nothing happens."""


@dataclass(frozen=True)
@ranged
class Watching:
    """How a folder is watched."""

    pattern: str = "*"
    """Names of the files that are looked at, such as '*.nxs'."""
    poll: Positive = 1.0
    """How often they are looked at [s]."""
    settle: Seconds = 2.0
    """How long a file must have stayed as it is before it counts as complete [s]."""
    retry: Positive = 30.0
    """After how long what could not be read is read again [s]; sooner where it has changed."""
    stop_after: int = 0
    """End after so many scans (0: never)."""
    idle: Seconds = 0.0
    """End when nothing has come for so long [s] (0: never)."""
    refresh: Positive = 5.0
    """How often a browser reads the page again [s]."""


@dataclass
class _Failure:
    reason: str
    again: float


@dataclass
class Watch:
    """A watch of `source` into `folder`; `run` does it. prior: of the matter, at a photon energy [keV]; say: tells
    people what happens, a line each time."""

    source: Path
    folder: WatchFolder
    settings: Settings
    prior: Callable[[float], MaterialPrior]
    reading: Reading
    how: Watching
    say: Callable[[str], None] = lambda text: None
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    _failures: dict[tuple[str, int, int], _Failure] = field(default_factory=dict)
    _times: list[tuple[Row, Path]] = field(default_factory=list)
    _before: Before | None = None
    _done: set[tuple[str, int, int]] = field(default_factory=set)
    _said: float = 0.0

    def run(self, said: dict[str, object]) -> int:
        """Watch until the end that is asked for, or Ctrl-C, which is passed on; how many scans were done.

        said: what the folder keeps of the options, which must be the same when a watch goes on. What a watch that was
        cut off has begun is finished first. Errors: `InputError` for folders that do not fit.
        """
        require(self.source.is_dir(), f"{self.source} must be a folder to watch, but it is none; check the path.")
        self.folder.require_usable()
        with sole_writer(self.folder.path):
            self.folder.begin(dict(said))
            self._take_up()
            running = f"Process {os.getpid()} on {socket.gethostname()} looks for scans."
            try:
                return self._loop(running)
            finally:
                self._show("The watch has ended; the same command goes on.", 0.0)

    def _take_up(self) -> None:
        """What was done before."""
        for seen in self.folder.seen():
            rows = [(run, row) for run, row in self.folder.rows(seen) if row.done]  # others are tried again
            for run, row in rows:
                self._remember(run.path, row)
            if len(rows) == seen.times:
                self._done.add(seen.key)

    def _remember(self, run: Path, row: Row) -> None:
        self._times.append((row, run))
        if row.done:
            self._before = Before(self.folder.run(int(run.parent.name), row.frame), row)

    def _loop(self, running: str) -> int:
        files = Folder(self.source, self.how.pattern, self.how.settle)
        count, last = 0, self.clock()
        self._show(running, self.how.refresh)
        while True:
            came = [found for found in files.complete(self.clock()) if self._wanted(found)]
            for found in came:
                if self._do(found, running):
                    count += 1
                    last = self.clock()
                if self.how.stop_after and count >= self.how.stop_after:
                    return count
            if self.how.idle and self.clock() - last >= self.how.idle:
                return count
            if came or self.clock() - self._said >= HEARTBEAT_SECONDS:
                self._show(running, self.how.refresh)
            if not came:
                self.sleep(self.how.poll)

    def _wanted(self, found: Found) -> bool:
        if found.key in self._done:
            return False
        failure = self._failures.get(found.key)
        return failure is None or self.clock() >= failure.again

    def _do(self, found: Found, running: str) -> bool:
        """Reconstruct a scan; False where it cannot be read (yet), which is said once."""
        scans = list[Scan]()

        def read() -> str:
            scan = read_frames(found.path, self.reading)
            at(scan, 0)  # the first frames can be read, and their values are numbers
            scans.append(scan)
            return ""

        reason = attempted(read)
        if reason:
            name = found.path.name
            if not any(key[0] == name and one.reason == reason for key, one in self._failures.items()):
                self.say(f"cannot read {plain(found.path.name)} (it is tried again): {plain(reason)}")
            self._forget(name)
            self._failures[found.key] = _Failure(reason, self.clock() + self.how.retry)
            return False
        self._forget(found.path.name)
        seen = self._begun(found, scans[0])
        done = {row.frame for _, row in self.folder.rows(seen) if row.done}
        for frame in range(seen.times):
            if frame not in done:
                self._time(found.path, scans[0], seen, frame)
                self._show(running, self.how.refresh)
        self._done.add(found.key)
        return True

    def _forget(self, name: str) -> None:
        self._failures = {key: one for key, one in self._failures.items() if key[0] != name}

    def _begun(self, found: Found, scan: Scan) -> Seen:
        """The number of a scan, which it keeps when a watch was cut off in it."""
        before = self.folder.seen()
        for seen in before:
            if seen.key == found.key:
                return seen
        first = before[-1].first + before[-1].times if before else 0
        seen = Seen(len(before), found.key, first, len(times_of(scan)))
        self.folder.add(seen)
        return seen

    def _time(self, path: Path, scan: Scan, seen: Seen, frame: int) -> None:
        run, times = self.folder.run(seen.number, frame), times_of(scan)
        row = Row(seen.first + frame, str(path.resolve()), frame, times[frame], "failed")

        def work() -> str:
            nonlocal row
            shown, part = at(scan, frame), self.reading.part
            reading = replace(self.reading, part=replace(part, time_frame=frame if len(times) > 1 else None))
            prior = self.prior(scan.exposures.reference_energy)
            row = reconstruct_time(Shot(shown, prior, run_source(path, reading), row), self.settings, run, self._before)
            return ""

        reason = attempted(work)
        if reason:
            row = replace(row, status="failed", reason=reason)
        write_row(self.folder.row(seen.number, frame), row)
        self._remember(run.path, row)
        name = plain(path.name) if len(times) == 1 else f"{plain(path.name)}, time {frame}"
        self.say(f"{name}: {outcome_of(row) if row.done else plain(reason)}")

    def _show(self, state: str, refresh: float) -> None:
        """Bring the page and the table up to date."""
        from .page import Frame, SeriesPage, headline, write_page  # which need matplotlib

        self._said = self.clock()
        write_rows(self.folder.table, COLUMNS, (self._line(row, run) for row, run in self._times))
        frames = tuple(Frame(row, row.time_s, run / PHASE, self._relative(run)) for row, run in self._times if row.done)
        bad = [row for row, _ in self._times if not row.done]
        failed = {f"{plain(Path(row.scan).name)}, time {row.frame}": plain(row.reason) for row in bad}
        failed |= {plain(key[0]): plain(one.reason) for key, one in self._failures.items()}
        when = time.strftime("%Y-%m-%d %H:%M:%S")
        verdict = f"{len(frames)} times are done." if frames else "No scan has come yet."
        title = f"Scans of {plain(self.source.resolve().name)}"
        write_page(
            self.folder.page,
            SeriesPage(title, headline(verdict, frames), f"{state} {when}", frames, failed, (), refresh),
        )

    def _relative(self, run: Path) -> str:
        return run.relative_to(self.folder.path).as_posix()

    def _line(self, row: Row, run: Path) -> list[object]:
        numbers = ["" if v is None else f"{v:.6g}" for v in (row.unexplained, row.total, row.total_error)]
        explained = "" if row.good is None else int(row.good)
        where = [row.number, row.scan, row.frame, f"{row.time_s:.9g}", row.status, row.begun, explained]
        return [*where, *numbers, f"{row.seconds:.3f}", self._relative(run), row.reason]


def listed(paths: Sequence[Path]) -> list[Path]:
    """The scans that `paths` name, in order: scans themselves, or folders of scan files, in the order of their names.

    Errors: `InputError` for a folder that is neither a scan nor holds scan files.
    """
    found = list[Path]()
    for path in paths:
        require(path.exists(), f"{path} must be a scan, or a folder of scans, but there is no such path; check it.")
        if path.is_file() or _is_scan(path):
            found.append(path)
            continue
        inside = [each for each in in_order(path) if _is_scan(each)]
        require(bool(inside), f"{path} must be a scan, or a folder of scan files, but it holds none; name another.")
        found += inside
    return found


def in_order(folder: Path) -> list[Path]:
    """The regular files of a folder by name, numbers as numbers; hidden ones and links are passed over."""
    files = [path for path in folder.iterdir() if not is_hidden(path) and not path.is_symlink() and path.is_file()]
    return sorted(files, key=natural)


def natural(path: Path) -> list[tuple[int, int | str]]:
    """A key that sorts scan2 before scan10."""
    words = re.split(r"([0-9]+)", path.name)
    return [(0, int(word)) if word.isascii() and word.isdigit() else (1, word) for word in words]


def _is_scan(path: Path) -> bool:
    try:
        loader_of(path)
    except InputError:
        return False
    return True


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
