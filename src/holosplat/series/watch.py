"""Scans reconstructed as they appear in a folder, or come from a socket, each begun with what the last one gave, and a
page of them."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..checks import as_written, require
from ..io.atomic import is_taken, read_json, require_parent, write_json, write_rows
from ..io.formats import read_frames
from ..io.lock import sole_writer
from ..io.reading import Reading
from ..matter import MaterialPrior
from ..progress import PICTURE, FitState
from ..ranges import Positive, Seconds, ranged
from ..representations import Stored
from ..scan import Scan
from ..units import number_of
from ..workflows.run_folder import RunFolder
from .folder import ROW, Folder, Found, Row, outcome_of, plain, read_row, write_row
from .one_time import PHASE, Before, Shot, quiet, reconstruct_time, write_phase
from .plan import Settings, at, times_of
from .stream import Stream
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
    people what happens, a line each time; stream: writes what comes from a socket into `source`.

    Of a stream the latest time is done first, and the others when nothing newer is there.
    """

    source: Path
    folder: WatchFolder
    settings: Settings
    prior: Callable[[float], MaterialPrior]
    reading: Reading
    how: Watching
    say: Callable[[str], None] = lambda text: None
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    stream: Stream | None = None
    _failures: dict[tuple[str, int, int], _Failure] = field(default_factory=dict)
    _times: list[tuple[Row, Path]] = field(default_factory=list)
    _before: Before | None = None
    _done: set[tuple[str, int, int]] = field(default_factory=set)
    _said: float = 0.0
    _seen: list[Seen] = field(default_factory=list)
    _stale: bool = False
    _begun_time: tuple[Row, Path] | None = None
    _lag: str = ""

    def run(self, said: dict[str, object]) -> int:
        """Watch until the end that is asked for, or Ctrl-C, which is passed on; how many scans were done.

        said: what the folder keeps of the options, which must be the same when a watch goes on. What a watch that was
        cut off has begun is finished first. Errors: `InputError` for folders that do not fit.
        """
        there = self.stream is not None or self.source.is_dir()
        require(there, f"{self.source} must be a folder to watch, but it is none; check the path.")
        self.folder.require_usable()
        with sole_writer(self.folder.path):
            self.folder.begin(dict(said))
            self._seen = self.folder.seen()
            for seen in self._seen:
                rows = [(run, row) for run, row in self.folder.rows(seen) if row.done]  # others are tried again
                for run, row in rows:
                    self._remember(run.path, row)
                if len(rows) == seen.times:
                    self._done.add(seen.key)
            running = f"Process {os.getpid()} on {socket.gethostname()} looks for scans."
            try:
                if self.stream is not None:
                    self.source.mkdir(exist_ok=True)
                    self.stream.start()
                return self._loop(running)
            finally:
                if self.stream is not None:
                    self.stream.stop()
                self._show("The watch has ended; the same command goes on.", 0.0)

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
            if self.stream is not None:
                self.stream.waiting, came = len(came), came[-1:]
            for found in came:
                if self._do(found, running):
                    count += 1
                    last = self.clock()
                if self.how.stop_after and count >= self.how.stop_after:
                    return count
            if self.how.idle and self.clock() - last >= self.how.idle:
                return count
            if (
                (came and self.stream is None)
                or self.clock() - self._said >= HEARTBEAT_SECONDS
                or (self._stale and self._is_due)
            ):
                self._show(running, self.how.refresh)
            if not came:
                self.sleep(self.how.poll)

    @property
    def _is_due(self) -> bool:
        """Whether a browser reads the page before it is written again; of a stream it is not written more often."""
        return self.stream is None or self.clock() - self._said >= self.how.refresh

    def _wanted(self, found: Found) -> bool:
        if found.key in self._done:
            return False
        failure = self._failures.get(found.key)
        return failure is None or self.clock() >= failure.again

    def _do(self, found: Found, running: str) -> bool:
        """Reconstruct a scan; False where it cannot be read (yet), which is said once."""

        def read() -> Scan:
            scan = read_frames(found.path, self.reading)
            at(scan, 0)  # the first frames can be read, and their values are numbers
            return scan

        scan, reason = attempted(read)
        if scan is None:
            name = found.path.name
            if not any(key[0] == name and one.reason == reason for key, one in self._failures.items()):
                self.say(f"cannot read {plain(found.path.name)} (it is tried again): {plain(reason)}")
            self._forget(name)
            self._failures[found.key] = _Failure(reason, self.clock() + self.how.retry)
            return False
        self._forget(found.path.name)
        seen = self._begun(found, scan)
        done = {row.frame for _, row in self.folder.rows(seen) if row.done}
        for frame in range(seen.times):
            if frame not in done:
                self._time(found, scan, seen, frame, running)
                self._stale = True
                if self._is_due:
                    self._show(running, self.how.refresh)
        self._done.add(found.key)
        return True

    def _forget(self, name: str) -> None:
        self._failures = {key: one for key, one in self._failures.items() if key[0] != name}

    def _begun(self, found: Found, scan: Scan) -> Seen:
        """The number of a scan, which it keeps when a watch was cut off in it."""
        for seen in reversed(self._seen):
            if seen.key == found.key:
                return seen
        last = self._seen[-1] if self._seen else None
        seen = Seen(len(self._seen), found.key, last.first + last.times if last else 0, len(times_of(scan)))
        self.folder.add(seen)
        self._seen.append(seen)
        return seen

    def _time(self, found: Found, scan: Scan, seen: Seen, frame: int, running: str) -> None:
        path, run, times = found.path, self.folder.run(seen.number, frame), times_of(scan)
        row = Row(seen.first + frame, str(path.resolve()), frame, times[frame], "failed")

        def work() -> Row:
            shot = Shot.of(scan, path, self.prior(scan.exposures.reference_energy), self.reading, row)
            look = self._look(row, self.folder.scan(seen.number) / f"t{frame:04d}.{PHASE}", shot.scan, running)
            return reconstruct_time(shot, self.settings, run, self._before, quiet, look)

        done, reason = attempted(work)
        if self._begun_time is not None:
            self._begun_time[1].unlink(missing_ok=True)
            self._begun_time = None
        row = done or replace(row, reason=reason)
        write_row(self.folder.row(seen.number, frame), row)
        self._remember(run.path, row)
        name = plain(path.name) if len(times) == 1 else f"{plain(path.name)}, time {frame}"
        if self.stream is not None:
            wait = max(self.stream.waiting - 1, 0)
            self._lag = f"{time.time() - 1e-9 * found.changed:.1f} s after it came, {wait} wait"
        self.say(f"{name}: {outcome_of(row) if row.done else plain(reason)}" + (self._lag and f"; {self._lag}"))

    def _look(self, row: Row, path: Path, scan: Scan, running: str) -> FitState:
        """What brings a time that is in work to the page: at once, coarse, and then as often as a browser reads it. A
        time of a stream that is done sooner than that is not shown before."""

        def look(stage: str, fraction: float, record: dict[str, float], state: Callable[[], Stored]) -> None:
            first = self._begun_time is None
            if stage == PICTURE:
                due = first and self._is_due
            else:
                due = self.clock() - self._said >= self.how.refresh
            if not due:
                return
            write_phase(path, state(), scan)
            self._begun_time = row, path
            self._show(running, self.how.refresh)

        return look

    def _show(self, state: str, refresh: float) -> None:
        """Bring the page and the table up to date."""
        from .page import Frame, SeriesPage, headline, write_page  # which need matplotlib

        self._said, self._stale = self.clock(), False
        write_rows(self.folder.table, COLUMNS, (self._line(row, run) for row, run in self._times))
        frames = tuple(Frame(row, row.time_s, run / PHASE, self._relative(run)) for row, run in self._times if row.done)
        bad = [row for row, _ in self._times if not row.done]
        failed = {f"{plain(Path(row.scan).name)}, time {row.frame}": plain(row.reason) for row in bad}
        failed |= {plain(key[0]): plain(one.reason) for key, one in self._failures.items()}
        when = time.strftime("%Y-%m-%d %H:%M:%S")
        verdict = f"Done: {number_of(len(frames), 'time')}." if frames else "No scan has come yet."
        title = f"Scans of {plain(self.source.resolve().name)}"
        said = f"{state} {when}" + (self._lag and f"; the last time was done {self._lag}")
        begun = self._begun_time and Frame(self._begun_time[0], self._begun_time[0].time_s, self._begun_time[1], "")
        page = SeriesPage(title, headline(verdict, frames), said, frames, failed, (), refresh, begun=begun)
        write_page(self.folder.page, page)

    def _relative(self, run: Path) -> str:
        return run.relative_to(self.folder.path).as_posix()

    def _line(self, row: Row, run: Path) -> list[object]:
        numbers = ["" if v is None else f"{v:.6g}" for v in (row.unexplained, row.total, row.total_error)]
        explained = "" if row.good is None else int(row.good)
        where = [row.number, row.scan, row.frame, f"{row.time_s:.9g}", row.status, row.begun, explained]
        return [*where, *numbers, f"{row.seconds:.3f}", self._relative(run), row.reason]
