"""Settings for every time of a series, as a table in its folder, and its options on the command line."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from ..checks import as_written, require
from ..matter import DeltaBeta, MaterialPrior, MatterKind
from ..methods import Auto, Method
from ..methods.continued import Continued, Effort
from ..methods.presets import method_of
from ..motion.track import TrackOptions
from ..optics.background import LightOptions
from ..ranges import Natural, Positive, Seed, ranged
from ..tables import from_table, to_table

Act = Literal["reconstruct", "track"]


@dataclass(frozen=True)
@ranged
class Warm:
    """How a time begins with what the time before ended with."""

    on: bool = True
    """Whether it does; else each time begins with phase retrieval and tomography."""
    worse: Positive = 1.25
    """Factor of the matter left unexplained, over that of the last time that began by itself, beyond which a time whose
    frames are not explained begins anew, by itself."""
    effort: Effort = field(default_factory=Effort)
    """How long its fit takes."""


@dataclass(frozen=True)
@ranged
class Settings:
    """What is done with every time. act: `reconstruct` each by itself, or `track` bodies through all times of a task;
    method, matter, warm: of reconstruct; motion: of track; reports: whether each run gets a report.html, which takes
    seconds."""

    act: Act = "reconstruct"
    method: Method = field(default_factory=Auto)
    matter: MatterKind | None = None
    warm: Warm = field(default_factory=Warm)
    motion: TrackOptions = field(default_factory=TrackOptions)
    light: LightOptions = field(default_factory=LightOptions)
    seed: Seed = 0
    reports: bool = False

    def __post_init__(self) -> None:
        if self.act == "reconstruct" and self.warm.on:
            Continued.of(self.method, Path())  # which says what cannot

    def as_table(self) -> dict[str, Any]:
        """Plain values, ready for JSON; `from_table` reads them."""
        own = {"method": to_table(self.method), "matter": self.matter, "warm": to_table(self.warm)}
        own = own if self.act == "reconstruct" else {"motion": to_table(self.motion)}
        return {"act": self.act, **own, "light": to_table(self.light), "seed": self.seed, "reports": self.reports}

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Settings:
        """The settings that `as_table` described; `InputError` for anything else."""
        values = dict(table)
        plain = from_table(_Plain, {f.name: values.pop(f.name) for f in fields(_Plain) if f.name in values})
        read: dict[str, Callable[[Any], Any]] = {
            "method": lambda value: method_of(value, "method"),
            "warm": lambda value: from_table(Warm, value, "warm"),
            "motion": lambda value: from_table(TrackOptions, value, "motion"),
            "light": lambda value: from_table(LightOptions, value, "light"),
        }
        unknown = [name for name in values if name not in read]
        require(not unknown, f"{', '.join(unknown)} is not known; remove it.")
        return cls(**vars(plain), **{name: read[name](value) for name, value in values.items()})


@dataclass(frozen=True)
@ranged
class _Plain:
    """The settings that are plain values."""

    act: Act = "reconstruct"
    matter: MatterKind | None = None
    seed: Seed = 0
    reports: bool = False


def prior_of(table: Mapping[str, Any]) -> MaterialPrior:
    """The prior that `MaterialPrior.as_dict` described; `InputError` for anything else."""
    with as_written("", "a prior"):
        kind, first = table["kind"], DeltaBeta(float(table["delta"]), float(table["beta"]))
        sign, medium = table.get("sign", 0), str(table.get("medium", ""))
        require(sign in (-1, 0, 1), f"sign must be -1, 0 or 1, but it is {sign!r}.")
        if kind == "free":
            return MaterialPrior.unknown(sign)
        if kind == "ratio":
            return MaterialPrior.of_ratio(float(table["ratio"]), sign)
        require(kind == "known", f"kind must be known, ratio or free, but it is {kind!r}.")
        others = [DeltaBeta(float(delta), float(beta)) for delta, beta in table.get("others", ())]
        if "second_delta" in table:  # of version 0.2
            others.append(DeltaBeta(float(table["second_delta"]), float(table.get("second_beta", 0.0))))
        return MaterialPrior.known(first, *others, medium=medium)


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
        require(self.overlap >= 0, f"overlap must not be negative, but it is {self.overlap}.")
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
        require(bool(self.time), "time must be a limit such as 01:00:00, but it is empty; give one.")
        require(self.limit >= 0, f"limit must be 0 (none) or more, but it is {self.limit}.")
