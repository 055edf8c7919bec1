"""What the program decides, on families of scenes, against the null and hindsight: docs/data/decision_families.csv.

    python benchmarks/families.py --data FOLDER                     # all families, seed 1: about an hour on one core
    python benchmarks/families.py --family "red cells" --seeds 101
    python benchmarks/families.py --summary                         # the tables of what is there

A scene (`family_scenes`) is reconstructed by `auto` as it decides; with light even, no pattern, noise white and levels;
and again with one decision changed: to each hypothesis about light and noise that was looked at, and to the other kind
of matter where that was looked at. What is changed is told as a run that goes on is told what it decided before. The
regret of a scene is the default's error over the least of these, less 1; against the null it is the error over the
null's, less 1.

Seeds below 100 are for development: look at them, and mend rules by them. Rows of seeds from 101 on are for reporting
alone. Rows of a scene that are there already are not made again: delete them, or the file, after a change. A file named
by --out is made in the place of the table. Families on which the present rules were made are told by --made-on.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from changes import changed
from family_scenes import MEASURED_FAMILIES, SIMULATED, Scene, scene
from machine import commit
from rows import machine, read, replaced, shown

import holosplat as hs
from holosplat.matter import MatterKind
from holosplat.methods import Auto
from holosplat.methods.illumination import STAGE, prepared
from holosplat.methods.levels import CONTINUOUS, NAME
from holosplat.methods.trials import NULL

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "decision_families.csv"
FIRST_OF_REPORTS = 101
MADE_ON = (
    "red cells",
    "soft cells",
    "round cell",
    "soft spheres, few photons",
    "uneven light",
    "fixed pattern",
    "grain",
    "HL60, near",
    "HL60",
    "HL60, far",
    "HL60, photons",
    "HL60, few views",
)
"""Families like the scenes on which the present rules were made (tests/methods/test_illumination.py and test_levels.py,
benchmarks/round_cell.py, and the measured cell)."""
USUAL = Auto().with_effort(0.2)
METHOD = replace(
    USUAL,
    gaussians=changed(USUAL.gaussians, {"turns": 0, "start_per_pixel": 0.3}),
    volume=replace(USUAL.volume, rounds=1),
)
"""The default with a fifth of the steps and Gaussians, no turns; it decides as usual."""
WANTED = {"median regret": 0.05, "worst regret": 0.5, "worst against null": 0.1}


@dataclass(frozen=True)
class Row:
    """use: development or reporting; light, matter: what was decided, or told where `told` says so; decisions: each
    with its evidence and seconds; others: of light, those that were looked at, and of matter; result: the kind of
    Object, or why there is none; seconds: of the processor, decision_seconds: by the clock."""

    family: str
    seed: int
    light: str
    matter: str
    use: str
    told: str
    error: float
    result: str
    others: str
    decisions: str
    frames: str
    facts: str
    decision_seconds: float
    seconds: float
    machine: str
    commit: str


Choice = tuple[str, str]
"""Light and noise, and the kind of matter."""
NULLS: Choice = (NULL, "levels")
REFUSED = "refused"


def run(name: str, seed: int, made: Scene, told: Choice | None) -> Row:
    """The default, or what is told in its place."""
    began, done, result = time.process_time(), None, ""
    try:
        done = _told(made, *told) if told else hs.reconstruct(made.scan, made.prior, METHOD)
        error, result = made.error(done), done.object.kind
    except hs.InputError as refusal:
        error, result = math.inf, str(refusal)
    decisions = () if done is None else done.choice.decisions
    light, matter = told or (NULLS if done else (REFUSED, REFUSED))
    for each in decisions:
        if each.name == STAGE:
            light = each.choice
        elif each.name == NAME:
            matter = "continuous" if each.choice == CONTINUOUS else "levels"
    looked = [one.name for each in decisions if each.name == STAGE for one in each.compared]
    looked += [CONTINUOUS for each in decisions if each.name == NAME and each.compared]
    count, (rows, columns) = int((~made.scan.is_test).sum()), made.scan.views.shape
    return Row(
        *(name, seed, light, matter, "reporting" if seed >= FIRST_OF_REPORTS else "development"),
        *("yes" if told else "no", float(error), result, "; ".join(looked)),
        " | ".join(f"{each.line} in {each.seconds:.1f} s" for each in decisions),
        *(f"{count} × {rows} × {columns}", made.facts),
        0.0 if done is None else round(done.timing.get("decision", 0.0), 1),
        *(round(time.process_time() - began, 1), machine(), commit()),
    )


def _told(made: Scene, light: str, matter: MatterKind) -> hs.workflows.Reconstruction:
    """The reconstruction with the decisions of `workflows.preconditions.decided_before`: also of a fixed pattern.

    The command line cannot tell that there is one.
    """
    before = (() if light == NULL else tuple(light.split(" and ")), ())
    place = importlib.import_module("holosplat.workflows.reconstruct")
    with patch.object(place, "prepared", lambda task, method, *_: prepared(task, method, before)):
        return hs.reconstruct(made.scan, made.prior, METHOD, matter=matter)


def others(default: Row) -> list[Choice]:
    """What else is tried: the null, and one decision changed; beside a refusal, the null alone."""
    if default.light == REFUSED:
        return [NULLS]
    looked = [one for one in default.others.split("; ") if one]
    lights = [one for one in (NULL, *looked) if one not in (CONTINUOUS, default.light)]
    found = [NULLS, *((light, default.matter) for light in lights)]
    if CONTINUOUS in looked or default.matter == "continuous":
        found.append((default.light, "levels" if default.matter == "continuous" else "continuous"))
    return [one for one in dict.fromkeys(found) if one != (default.light, default.matter)]


def _tried(default: Row, alone: bool) -> list[Choice]:
    return [one for one in others(default) if one == NULLS or not alone]


def rows_of(path: Path) -> list[Row]:
    """The rows that are there."""
    kinds = {field.name: {"int": int, "float": float}.get(str(field.type), str) for field in fields(Row)}
    return [Row(**{name: kinds[name](value) for name, value in each.items()}) for each in read(path)]


def make(name: str, seed: int, data: Path | None, path: Path, alone: bool) -> None:
    """Rows of a scene that are not there yet, each written as soon as it is made; alone: default and null alone."""

    def there() -> Iterator[Row]:
        return (row for row in rows_of(path) if (row.family, row.seed) == (name, seed))

    default = next((row for row in there() if row.told == "no"), None)
    known = {(row.light, row.matter) for row in there()}
    if default is not None and known.issuperset(_tried(default, alone)):
        return
    made = scene(name, seed, data)
    if isinstance(made, str):
        print(made, flush=True)
        return
    if default is None:
        default = run(name, seed, made, None)
        replaced(path, default, key=4)
        shown(default)
    for choice in _tried(default, alone):
        if choice not in known:
            row = run(name, seed, made, choice)
            replaced(path, row, key=4)
            shown(row)


@dataclass(frozen=True)
class Regret:
    """Of a scene: errors of the default and the null, the least and what it was told, and the default's row; made,
    wanted: how many runs there are, and with hindsight complete."""

    default: Row
    null: float
    best: Row
    made: int
    wanted: int

    @property
    def regret(self) -> float:
        """The default's error over the least, less 1."""
        return _over(self.default.error, self.best.error)

    @property
    def against_null(self) -> float:
        """The default's error over the null's, less 1."""
        return _over(self.default.error, self.null)


def _over(error: float, other: float) -> float:
    return error / other - 1 if math.isfinite(error) and other > 0 else 0.0 if error == other else math.inf


def regrets(rows: Sequence[Row]) -> list[Regret]:
    """Those of all scenes of which the null is there."""
    scenes: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        scenes.setdefault((row.family, row.seed), []).append(row)
    found = []
    for own in scenes.values():
        default = next((row for row in own if row.told == "no"), None)
        null = next((row for row in own if (row.light, row.matter) == NULLS), None)
        if default is not None and null is not None:
            best, wanted = min(own, key=lambda row: (row.error, row.told)), 1 + len(others(default))
            found.append(Regret(default, null.error, best, len(own), wanted))
    return found


def table_of_scenes(rows: Sequence[Row], made_on: Sequence[str] = MADE_ON) -> list[list[str]]:
    """A line a scene, the worst first: what it is, what was decided, errors, and what would have been best."""
    lines = []
    for one in sorted(regrets(rows), key=lambda one: -max(one.regret, one.against_null)):
        row = one.default
        best = "the same" if one.best is row else f"{one.best.light}, {one.best.matter}"
        errors = [f"{value:.4g}" for value in (row.error, one.null, one.best.error)]
        lines.append(
            [row.family, str(row.seed), "yes" if row.family in made_on else "no", row.frames]
            + [f"{row.light}, {row.matter}", *errors, best, f"{one.made} of {one.wanted}"]
            + [f"{one.regret:+.1%}", f"{one.against_null:+.1%}"]
        )
    return lines


def table_of_rules(rows: Sequence[Row], made_on: Sequence[str] = MADE_ON) -> list[list[str]]:
    """Families that the rules were made on beside all others: a line a number; regrets of scenes with all runs."""
    sides = [[one for one in regrets(rows) if (one.default.family in made_on) is side] for side in (True, False)]
    numbers: dict[str, list[str]] = {name: [] for name in ("families", "scenes", "whole", *WANTED, "missed")}
    for side in sides:
        regret = [one.regret for one in side if one.made == one.wanted]
        against = [one.against_null for one in side]
        families = {one.default.family for one in side}
        failing = {one.default.family for one in side if one.against_null > WANTED["worst against null"]}
        numbers["families"].append(str(len(families)))
        numbers["scenes"].append(str(len(side)))
        numbers["whole"].append(str(len(regret)))
        numbers["median regret"].append(f"{statistics.median(regret):.1%}" if regret else "–")
        numbers["worst regret"].append(f"{max(regret):.1%}" if regret else "–")
        numbers["worst against null"].append(f"{max(against):+.1%}" if side else "–")
        numbers["missed"].append(str(len(failing)))
    wanted = {name: f"under {value:.0%}" for name, value in WANTED.items()} | {"missed": "0"}
    called = {"missed": "families that lose more than 10 % to the null", "whole": "scenes with all runs"}
    return [[called.get(name, name), *cells, wanted.get(name, "–")] for name, cells in numbers.items()]


RULES = ("", "families it was made on", "all others", "wanted")
SCENES = ("family", "seed", "made on", "frames", "decided", "error", "null", "least", "least by", "runs")
SCENES += ("regret", "to null")


def printed(head: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    """A table in Markdown."""
    for cells in (head, ["---"] * len(head), *lines):
        print(f"| {' | '.join(cells)} |")


def main() -> None:
    """Make the rows that are asked for, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    every: list[Any] = [*SIMULATED, *MEASURED_FAMILIES]
    parser.add_argument("--family", nargs="+", choices=every, default=every, metavar="NAME")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--data", type=Path, help="the folder of measured frames")
    parser.add_argument("--made-on", nargs="*", choices=every, default=MADE_ON, metavar="NAME")
    parser.add_argument("--out", type=Path, default=PAGE)
    parser.add_argument("--summary", action="store_true", help="print the tables, and make no rows")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for seed in () if options.summary else options.seeds:
        for alone in (True, False):  # all families beside the null first, then beside the rest
            for name in options.family:
                make(name, seed, options.data, options.out, alone)
    rows = rows_of(options.out)
    printed(RULES, table_of_rules(rows, options.made_on))
    print()
    printed(SCENES, table_of_scenes(rows, options.made_on))


if __name__ == "__main__":
    main()
