"""The plan of a series: its scans, the times in them, and the windows of times that are its tasks."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import as_written, require
from ..io.formats import read_frames
from ..io.reading import Reading
from ..matter import MaterialPrior
from ..scan import Scan
from .settings import Cut, Settings, prior_of

FORMAT = "holosplat series 1"
MOST_TIMES = 100_000
"""Times of a series, at most: each is a folder."""


@dataclass(frozen=True)
class Source:
    """A scan of the series. times: of its frames [s]; fingerprint: of the frames of its first time; prior: at its
    energy."""

    path: Path
    times: tuple[float, ...]
    fingerprint: str
    prior: MaterialPrior


@dataclass(frozen=True)
class Moment:
    """A time of the series. number: of all, from 0; source: the number of its scan; frame: the number of the time in
    that; time: of the frames [s]."""

    number: int
    source: int
    frame: int
    time: float


@dataclass(frozen=True)
class Window:
    """A task. moments: its times in order, of which the first `early` are another task's own."""

    number: int
    moments: tuple[Moment, ...]
    early: int

    @property
    def own(self) -> tuple[Moment, ...]:
        """The times whose results are those of this task."""
        return self.moments[self.early :]


@dataclass(frozen=True)
class SeriesPlan:
    """What is done: `settings` with every time of `sources`, read as `reading` says, in tasks that `cut` makes."""

    sources: tuple[Source, ...]
    settings: Settings
    reading: Reading
    cut: Cut

    def moments(self) -> list[Moment]:
        """All times in order: scan by scan, as they were named."""
        pairs = [(s, k, time) for s, source in enumerate(self.sources) for k, time in enumerate(source.times)]
        return [Moment(n, *pair) for n, pair in enumerate(pairs)]

    def windows(self) -> list[Window]:
        """The tasks. Bodies are followed within one scan, so windows of `track` end with it."""
        moments, found = self.moments(), list[Window]()
        parts = [moments]
        if self.settings.act == "track":
            parts = [[m for m in moments if m.source == s] for s in range(len(self.sources))]
        for part in parts:
            for first in range(0, len(part), self.cut.window):
                begin = max(0, first - self.cut.overlap)
                window = tuple(part[begin : first + self.cut.window])
                found.append(Window(len(found), window, first - begin))
        return found

    def require_few(self) -> None:
        """`InputError` for too many times."""
        count = sum(len(source.times) for source in self.sources)
        require(
            count <= MOST_TIMES, f"a series has at most {MOST_TIMES} times, but these are {count}; plan parts of it."
        )

    def as_table(self) -> dict[str, Any]:
        """Plain values, ready for JSON; `from_table` reads them."""
        scans = [
            {
                "path": str(source.path),
                "times_s": list(source.times),
                "fingerprint": source.fingerprint,
                "prior": source.prior.as_dict(),
            }
            for source in self.sources
        ]
        cut = {"window": self.cut.window, "overlap": self.cut.overlap}
        said = {"settings": self.settings.as_table(), "reading": self.reading.as_table()}
        return {"format": FORMAT, **cut, **said, "scans": scans}

    @classmethod
    def from_table(cls, table: Mapping[str, Any], where: Path) -> SeriesPlan:
        """The plan that `as_table` described, in the file `where`; `InputError` for anything else."""
        with as_written(where, "the plan of a series"):
            require(table["format"] == FORMAT, f"its format is {str(table['format'])[:40]!r}, not {FORMAT!r}.")
            sources = tuple(
                Source(
                    Path(each["path"]),
                    tuple(float(time) for time in each["times_s"]),
                    str(each["fingerprint"]),
                    prior_of(each["prior"]),
                )
                for each in table["scans"]
            )
            reading = Reading.from_table(table["reading"], f"{where}: reading")
            cut = Cut(int(table["window"]), int(table["overlap"]))
            plan = cls(sources, Settings.from_table(table["settings"]), reading, cut)
            plan.require_few()
            return plan


def plan_series(
    scans: Sequence[Path],
    settings: Settings,
    prior: Callable[[float], MaterialPrior],
    reading: Reading,
    cut: Cut,
) -> SeriesPlan:
    """The plan for the `scans`, each of one time or many; of each, only the first time is read.

    prior: of the matter, at a photon energy [keV]. Errors: `InputError` for scans that cannot be read, without times,
    and for too many tasks.
    """
    require(reading.part.time_frame is None, "a series takes all times; choose some with --time-frames.")
    require(
        settings.act != "track" or reading.part.time_frames is None,
        "windows of --track go through all times of a scan; leave --time-frames.",
    )
    require(len(scans) > 0, "a series needs a scan at least; name one.")
    sources = tuple(_source(path, settings, prior, reading) for path in scans)
    plan = SeriesPlan(sources, settings, reading, cut)
    plan.require_few()
    return plan


def _source(path: Path, settings: Settings, prior: Callable[[float], MaterialPrior], reading: Reading) -> Source:
    scan = read_frames(path, reading)
    times = times_of(scan)
    fewest = 3 if settings.act == "track" else 1
    require(
        len(times) >= fewest,
        f"bodies are followed through several times, but {path} has {len(times)}; leave --track.",
    )
    known = prior(scan.exposures.reference_energy)
    return Source(path.resolve(), tuple(times), fingerprint(scan), known)


def times_of(scan: Scan) -> list[float]:
    """The times [s] that a scan is reconstructed at: all of a time-resolved one, else one."""
    return scan.instants.tolist() if scan.is_series else [float(scan.instants[0])]


def at(scan: Scan, frame: int) -> Scan:
    """The frames of the time `frame` (0 is the first) of those of `times_of`, in memory."""
    return (scan.at_instant(frame) if scan.is_series else scan.as_static()).in_memory()


def fingerprint(scan: Scan) -> str:
    """Of the frames of the first time (SHA-256), so that a scan that was replaced is noticed."""
    first = at(scan, 0)
    digest = hashlib.sha256(np.ascontiguousarray(first.frames).tobytes())
    digest.update(np.ascontiguousarray(scan.exposures.time).tobytes())
    return digest.hexdigest()[:16]
