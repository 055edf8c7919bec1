"""Settings for every time of a series, as a table in its folder."""

from __future__ import annotations

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
from ..ranges import Positive, Seed, ranged
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
        if "second_delta" not in table:
            return MaterialPrior.known(first, medium=medium)
        second = DeltaBeta(float(table["second_delta"]), float(table.get("second_beta", 0.0)))
        return MaterialPrior.known(first, second, medium)
