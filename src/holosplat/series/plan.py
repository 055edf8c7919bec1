"""The plan of a series: its scans in order, times and windows of times, and the settings of their reconstruction."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..checks import InputError, as_written, require
from ..io.formats import loader_of, read_frames
from ..io.lock import is_hidden
from ..io.reading import Reading
from ..matter import DeltaBeta, MaterialPrior, MatterKind
from ..methods import Auto, Method, require_possible
from ..methods.continued import Continued, Effort
from ..methods.presets import method_of
from ..motion.track import TrackOptions
from ..optics.background import LightOptions
from ..ranges import Natural, Seed, ranged
from ..scan import Scan
from ..tables import from_table, to_table
from ..workflows.motion_choice import Motion

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
        """The tasks. What is found in several times is of one scan, so windows end with it."""
        moments, found = self.moments(), list[Window]()
        parts = [moments]
        if self.settings.act != "reconstruct":
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
        settings.act == "reconstruct" or reading.part.time_frames is None,
        "only --motion each takes some times of a scan; leave --time-frames.",
    )
    require(len(scans) > 0, "a series needs a scan at least; name one.")
    sources = tuple(_source(path, settings, prior, reading) for path in scans)
    plan = SeriesPlan(sources, settings, reading, cut)
    plan.require_few()
    return plan


def _source(path: Path, settings: Settings, prior: Callable[[float], MaterialPrior], reading: Reading) -> Source:
    scan = read_frames(path, reading)
    times = times_of(scan)
    fewest = {"track": 3, "flow": 3}.get(settings.act, 1)
    require(
        len(times) >= fewest,
        f"motion is found in {fewest} times or more, but {path} has {len(times)}; leave --motion.",
    )
    known = prior(scan.exposures.reference_energy)
    require_possible(settings.method, known, settings.matter)
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


Act = Literal["reconstruct", "still", "flow", "track", "auto"]
AskedMotion = Literal[Motion, "auto"]
ACTS: dict[AskedMotion, Act] = {
    "each": "reconstruct",
    "still": "still",
    "flow": "flow",
    "bodies": "track",
    "auto": "auto",
}
"""What is done, by the motion that is asked for."""


@dataclass(frozen=True)
@ranged
class Warm:
    """How a time begins with what the time before ended with."""

    on: bool = True
    """Whether it does; else each time begins with phase retrieval and tomography."""
    effort: Effort = field(default_factory=Effort)
    """How long its fit takes."""


@dataclass(frozen=True)
@ranged
class Settings:
    """What is done with the times of a task. act: `reconstruct` each by itself, take all as `still`, let a `flow` carry
    the matter, `track` bodies, or as frames choose (`auto`); method, matter: of all but flow and bodies; warm: of each
    time by itself; motion: of bodies; reports: whether each run gets a report.html, which takes seconds."""

    act: Act = "reconstruct"
    method: Method = field(default_factory=Auto)
    matter: MatterKind | None = None
    warm: Warm = field(default_factory=Warm)
    motion: TrackOptions = field(default_factory=TrackOptions)
    light: LightOptions = field(default_factory=LightOptions)
    seed: Seed = 0
    reports: bool = False

    def __post_init__(self) -> None:
        if self.act in ("reconstruct", "auto") and self.warm.on:
            Continued.of(self.method, Path())  # which says what cannot

    @property
    def asked(self) -> AskedMotion:
        """The motion that is asked for."""
        return next(name for name, act in ACTS.items() if act == self.act)

    def as_table(self) -> dict[str, Any]:
        """Plain values, ready for JSON; `from_table` reads them."""
        own = {"method": to_table(self.method), "matter": self.matter, "warm": to_table(self.warm)}
        own = {} if self.act == "track" else own
        own |= {"motion": to_table(self.motion)} if self.act in ("track", "auto") else {}
        return {"act": self.act, **own, "light": to_table(self.light), "seed": self.seed, "reports": self.reports}

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Settings:
        """The settings that `as_table` described; `InputError` for anything else."""
        values = dict(table)
        told = {"method": method_of(values.pop("method"), "method")} if "method" in values else {}
        return replace(from_table(cls, values), **told)


def prior_of(table: Mapping[str, Any]) -> MaterialPrior:
    """The prior that `MaterialPrior.as_dict` described; `InputError` for anything else."""
    with as_written("", "a prior"):
        kind, first = table["kind"], DeltaBeta(float(table["delta"]), float(table["beta"]))
        sign, medium = table.get("sign", 0), str(table.get("medium", ""))
        require(sign in (-1, 0, 1), f"sign must be -1, 0 or 1, but it is {sign!r}.")
        if kind in ("free", "ratio"):
            found = (
                MaterialPrior.unknown(sign) if kind == "free" else MaterialPrior.of_ratio(float(table["ratio"]), sign)
            )
            return _on_sides(found, table)
        require(kind == "known", f"kind must be known, ratio or free, but it is {kind!r}.")
        others = [DeltaBeta(float(delta), float(beta)) for delta, beta in table.get("others", ())]
        if "second_delta" in table:  # of version 0.2
            others.append(DeltaBeta(float(table["second_delta"]), float(table.get("second_beta", 0.0))))
        known = MaterialPrior.known(first, *others, medium=medium)
        return _on_sides(known, table)


def _on_sides(prior: MaterialPrior, table: Mapping[str, Any]) -> MaterialPrior:
    prior = prior.about_a_point() if table.get("spherical", False) else prior
    return prior.on_both_sides() if table.get("two_sided", False) else prior


WORD = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.,:+-]*")
"""What partitions, accounts, memory and times may be: nothing that a shell or sbatch would read otherwise."""


@dataclass(frozen=True)
@ranged
class Cut:
    """How times are cut into tasks."""

    window: Natural = 16
    """Times of a task. With --warm the first of them takes as long as ten others, which go on from the one before."""
    overlap: int = 0
    """Times before its own that a task also does: a run-in, and what says how well tasks agree."""

    def __post_init__(self) -> None:
        require(self.overlap <= self.window, f"overlap must be at most the window, {self.window}, but is larger.")


@dataclass(frozen=True)
@ranged
class Slurm:
    """Resources of an array script of Slurm; empty ones are left to the cluster."""

    partition: str = ""
    """Partition (default: the cluster's)."""
    time: str = "01:00:00"
    """Time limit of a job; a minute before, its task is saved."""
    memory: str = ""
    """Memory of a job, such as 8G (default: the cluster's; some refuse to be asked)."""
    cpus: Natural = 4
    """Cores of a job, and its threads."""
    block: Natural = 1
    """Tasks of a job, one after another: they share its start, which takes some seconds, and its time limit."""
    limit: int = 0
    """Jobs that run at the same time, at most (0: as many as there is room for)."""
    account: str = ""
    """Account that is charged."""
    gres: str = ""
    """Generic resources, such as gpu:1."""

    def __post_init__(self) -> None:
        for name in ("partition", "time", "memory", "account", "gres"):
            value = getattr(self, name)
            fits = not value or WORD.fullmatch(value) is not None
            require(fits, f"{name} must be a word of letters, digits and -_.,:+, but it is {value!r}; correct it.")


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


def _is_scan(path: Path) -> bool:
    try:
        loader_of(path)
    except InputError:
        return False
    return True


def in_order(folder: Path) -> list[Path]:
    """The regular files of a folder by name, numbers as numbers; hidden ones and links are passed over."""
    files = [path for path in folder.iterdir() if not is_hidden(path) and not path.is_symlink() and path.is_file()]
    return sorted(files, key=natural)


def natural(path: Path) -> list[tuple[int, int | str]]:
    """A key that sorts scan2 before scan10."""
    words = re.split(r"([0-9]+)", path.name)
    return [(0, int(word)) if word.isascii() and word.isdigit() else (1, word) for word in words]
