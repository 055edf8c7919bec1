"""The rows of a benchmark as results: means over seeds, the best, and who beats whom."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from holosplat.report.style import scientific

from ..folder import BenchFolder, Row

OURS = "gaussians"
"""The method that the others are compared with in the summary."""


@dataclass(frozen=True)
class Measure:
    """A number of a row: its name in tables, whether a good one is high, low or near zero, and how it is written.

    digits: behind the point of a number like this; factor, unit: what is shown is factor × value with its unit, and
    with its sign if it is `signed`; at_limit: whether the number is only known to be at or below what it says.
    """

    name: str
    better: Literal["high", "low", "zero"]
    value: Callable[[Row], float | None]
    digits: Callable[[float], int]
    factor: float = 1.0
    unit: str = ""
    signed: bool = False
    at_limit: Callable[[Row], bool] = lambda row: False

    def penalty(self, value: float) -> float:
        """Smaller is better."""
        return {"high": -value, "low": value, "zero": abs(value)}[self.better]

    def text(self, value: float, spread: float = 0.0) -> str:
        """The number for people, and ± its spread unless that is 0."""
        value, spread = self.factor * value, self.factor * spread
        if not math.isfinite(value):
            return scientific(value)
        digits = self.digits(abs(value))
        said = f"{value:{'+' * self.signed},.{digits}f}".replace("-", "−")
        return said + (f" ± {spread:,.{digits}f}" if spread > 0 else "") + self.unit


def _fixed(digits: int) -> Callable[[float], int]:
    return lambda value: digits


def _three(value: float) -> int:
    """Digits behind the point of a number of three significant ones, at most two."""
    return 0 if value >= 99.5 else 1 if value >= 9.95 else 2


def _resolution(row: Row) -> float | None:
    """Resolution [m]; the sampling limit where the correlation never falls below its threshold."""
    length, pitch = row.volume.get("resolution_half"), row.volume.get("pitch")
    return length if length is not None or pitch is None else 2 * pitch


def _limited(row: Row) -> bool:
    return row.volume.get("resolution_half") is None


SSIM = Measure("SSIM", "high", lambda row: row.test.get("ssim"), _fixed(3))
FRCM = Measure("FRCM", "high", lambda row: row.test.get("frcm"), _fixed(3))
DICE = Measure("Dice", "high", lambda row: row.volume.get("dice"), _fixed(3))
ERROR = Measure("relative error of δ", "low", lambda row: row.volume.get("relative_error_delta"), _fixed(3))
SECONDS = Measure("time (s)", "low", lambda row: None if row.is_reference else row.seconds, _three)
BYTES = Measure("stored (kB)", "low", lambda row: None if row.is_reference else row.stored_bytes, _three, 1e-3)
HEADLINE = (SSIM, FRCM, DICE, ERROR)
"""What decides who is best."""
MEASURES = (
    SSIM,
    FRCM,
    Measure("PSNR (dB)", "high", lambda row: row.test.get("psnr"), _fixed(1)),
    DICE,
    ERROR,
    Measure("mean δ deviation", "zero", lambda row: row.volume.get("delta_deviation"), _fixed(1), 100, " %", True),
    Measure("resolution (µm)", "low", _resolution, _three, 1e6, at_limit=_limited),
    SECONDS,
    BYTES,
)
"""The columns of a case's table."""


@dataclass(frozen=True)
class MethodResult:
    """One method on one case: its rows by seed."""

    name: str
    rows: dict[int, Row]

    @property
    def first(self) -> Row:
        """Any of its rows, for what all have in common."""
        return next(iter(self.rows.values()))

    @property
    def family(self) -> str:
        """The method's group."""
        return self.first.family

    @property
    def done(self) -> dict[int, Row]:
        """The rows that have a result."""
        return {seed: row for seed, row in self.rows.items() if row.done}

    @property
    def reasons(self) -> dict[str, list[int]]:
        """Why it failed: reason → seeds."""
        found: dict[str, list[int]] = {}
        for seed, row in self.rows.items():
            if not row.done:
                found.setdefault(row.reason, []).append(seed)
        return found

    def values(self, measure: Measure) -> dict[int, float]:
        """The measure by seed, as far as it is known."""
        found = {seed: measure.value(row) for seed, row in self.done.items()}
        return {seed: value for seed, value in found.items() if value is not None and not math.isnan(value)}

    def mean(self, measure: Measure) -> float | None:
        """The mean over seeds."""
        values = self.values(measure).values()
        return sum(values) / len(values) if values else None

    def text(self, measure: Measure) -> str:
        """The mean over seeds, and ± the standard deviation where there are several."""
        values = list(self.values(measure).values())
        if not values:
            return "–"
        mean, several = sum(values) / len(values), len(values) > 1 and all(map(math.isfinite, values))
        if all(measure.at_limit(row) for row in self.done.values()):
            return f"≤ {measure.text(mean)}"
        return measure.text(mean, statistics.stdev(values) if several else 0.0)


@dataclass(frozen=True)
class CaseResult:
    """All methods and references on one case; facts: what case.json says of it."""

    name: str
    seeds: list[int]
    methods: list[MethodResult]
    references: list[MethodResult]
    facts: dict[str, Any]

    def method(self, name: str) -> MethodResult | None:
        """The method `name`, if it was run on this case."""
        return next((method for method in self.methods if method.name == name), None)

    def ranked(self, measure: Measure) -> list[MethodResult]:
        """The methods with a result for every seed, best first: a mean over fewer scenes could not be compared."""
        whole = [m for m in self.methods if set(m.values(measure)) == set(self.seeds)]
        return sorted(whole, key=lambda m: measure.penalty(m.mean(measure) or 0.0))

    def best(self, measure: Measure) -> list[MethodResult]:
        """The best method, and those that cannot be told from it in the digits shown."""
        ranked = self.ranked(measure)
        return [m for m in ranked if _shown(measure, m) == _shown(measure, ranked[0])]


def _shown(measure: Measure, method: MethodResult) -> str:
    return measure.text(method.mean(measure) or 0.0).lstrip("+−")


@dataclass(frozen=True)
class Beaten:
    """A method that is better than ours on a case: by `margin`, the difference of the means over their common
    seeds, and in `won` of these `seeds` scenes."""

    case: str
    measure: Measure
    method: str
    theirs: float
    ours: float
    won: int
    seeds: int

    @property
    def margin(self) -> float:
        """How much better, in units of the measure; positive."""
        return self.measure.penalty(self.ours) - self.measure.penalty(self.theirs)


def read_results(folder: BenchFolder) -> list[CaseResult]:
    """The results in the folder of a benchmark, case by case."""
    rows = folder.read_rows()
    names = dict.fromkeys(row.case for row in rows)
    return [_case_result(folder, name, [row for row in rows if row.case == name]) for name in names]


def _case_result(folder: BenchFolder, name: str, rows: Sequence[Row]) -> CaseResult:
    seeds = sorted({row.seed for row in rows})
    results = [
        MethodResult(method, {row.seed: row for row in rows if row.method == method})
        for method in dict.fromkeys(row.method for row in sorted(rows, key=lambda row: row.place))
    ]
    references = [result for result in results if result.first.is_reference]
    methods = [result for result in results if not result.first.is_reference]
    return CaseResult(name, seeds, methods, references, folder.describe_case(name, seeds[0]))


def beaten(case: CaseResult, measure: Measure, ours: str = OURS) -> list[Beaten]:
    """The methods better than ours on the seeds that both have, best first; empty where ours has no result."""
    own = case.method(ours)
    if own is None:
        return []
    mine = {seed: value for seed, value in own.values(measure).items() if math.isfinite(value)}
    found = []
    for method in case.methods:
        pairs = [(value, mine[seed]) for seed, value in method.values(measure).items() if seed in mine]
        if method is own or not pairs:
            continue
        theirs, own_mean = (sum(column) / len(column) for column in zip(*pairs))
        won = sum(measure.penalty(a) < measure.penalty(b) for a, b in pairs)
        if measure.penalty(theirs) < measure.penalty(own_mean):
            found.append(Beaten(case.name, measure, method.name, theirs, own_mean, won, len(pairs)))
    return sorted(found, key=lambda b: measure.penalty(b.theirs))
