"""Tables of the benchmark in the docs, from docs/data alone; `docs/figures.py` puts them into the pages."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path

from holosplat_bench.suite.case import case_names
from holosplat_bench.suite.methods import REFERENCES

BENCH = "holosplat bench run --out bench --snapshots DIR --seeds 101 102, then python docs/figures.py benchmark bench"

DATA = Path(__file__).parents[1] / "data"
Row = dict[str, str]
Means = dict[tuple[str, str], dict[str, float]]
"""(case, method) → numbers, means over the seeds that are done."""

OVERVIEW_CASES = ("main12", "cells8")
OVERVIEW_NUMBERS = ("ssim", "dice", "relative_error_delta", "seconds", "stored")
OVERVIEW_METHODS = {
    "paganin-fbp": "Paganin, FBP",
    "paganin-sirt-nonneg": "Paganin, SIRT ≥ 0",
    "paganin-svmbir": "Paganin, svmbir",
    "paganin-tv": "Paganin, TV in the box",
    "tikhonov-tv": "nonlinear Tikhonov, TV in the box",
    "holographic-tv": "holographic TV",
    "voxels-waves": "voxels through the waves",
    "neural-field": "neural field",
    "alpha-3dgs": "opaque splats, as photographs",
    "nerf": "NeRF, as photographs",
    "pixelnerf": "`pixelnerf`, of this scan alone",
    "onix": "`onix`, of this scan alone",
    "gaussians-random": "Gaussians, random start",
    "gaussians": "Gaussians",
    "surfaces": "surfaces, from Gaussians",
    "learned": "`auto --start learned`",
}
"""What docs/notebook/overview.md shows: cases, numbers, and methods as it calls them."""
OURS = ("gaussians", "surfaces")
STANDING = {"ssim": 1, "frcm": 1, "dice": 1, "relative_error_delta": -1}
"""The scores in which methods are compared, and whether more of it is better."""
CONTINUOUS = ("soft12", "soft12-unknown", "soft12-5000", "light12-5000", "drift", "tissue16", "coated")
ABSORBERS = ("absorber12", "contact91")
MEASURED = ("capsule-dome", "capsule", "tooth")
PHOTOGRAPHED = ("cells12", "cells4")
PHOTOGRAPHS = ("alpha-3dgs", "nerf")
SHARP = ("sharp-even", "sharp-light", "sharp-drift")


@dataclass(frozen=True)
class Table:
    """A table of a page: its text from data files, and the command that makes these, with its length."""

    make: Callable[[], str]
    data: tuple[str, ...]
    command: str
    takes: str


TABLES: dict[str, Table] = {}
"""All tables of the documentation by their names."""


def table(name: str, command: str, takes: str, *data: str) -> Callable[[Callable[[], str]], Callable[[], str]]:
    """Enter the decorated function as the table `name` of the files `data` of docs/data, which `command` makes."""

    def entered(make: Callable[[], str]) -> Callable[[], str]:
        TABLES[name] = Table(make, data, command, takes)
        return make

    return entered


def read(name: str) -> list[Row]:
    """The rows of docs/data/NAME."""
    with (DATA / name).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table of cells."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *lines))


def numbers_of(row: Row) -> dict[str, float]:
    """All columns of a row that hold a number; `stored` in MB."""
    found = {}
    for name, value in row.items():
        try:
            found[name] = float(value)
        except ValueError:
            continue
    if "stored_bytes" in found:
        found["stored"] = found["stored_bytes"] / 1e6
    return found


def means(rows: list[Row]) -> Means:
    """Numbers of every method on every case, means over seeds."""
    several: dict[tuple[str, str], list[dict[str, float]]] = defaultdict(list)
    for row in rows:
        if row["status"] == "done":
            several[row["case"], row["method"]].append(numbers_of(row))
    return {
        key: {name: sum(o[name] for o in own) / len(own) for name in own[0] if all(name in o for o in own)}
        for key, own in several.items()
    }


@table(
    "overview",
    f"{BENCH}; and with --seeds 101 --methods pixelnerf onix learned, to docs/data/families.csv",
    "a day",
    "benchmark.csv",
    "families.csv",
)
def overview() -> str:
    """Methods on the cases `OVERVIEW_CASES`."""
    found = means(read("families.csv")) | means(read("benchmark.csv"))
    lines = []
    for method, label in OVERVIEW_METHODS.items():
        chosen = [found.get((case, method), {}) for case in OVERVIEW_CASES]
        cells = [" / ".join(shown(numbers, name) for numbers in chosen) for name in OVERVIEW_NUMBERS]
        lines.append([label, *cells] if any(chosen) else [label, "not run", *["–"] * (len(cells) - 1)])
    table = markdown(("method", "SSIM", "Dice", "error of δ", "time / s", "stored / MB"), lines)
    return f"*{' / '.join(OVERVIEW_CASES)}*\n\n{table}"


@table("standing", BENCH, "a day", "benchmark.csv")
def standing() -> str:
    """Gaussians and surfaces beside the best other method on every case and score."""
    found = means(read("benchmark.csv"))
    won: dict[str, dict[str, int]] = {name: dict.fromkeys((*OURS, "either"), 0) for name in STANDING}
    cases = [case for case in case_names() if (case, "gaussians") in found]
    lines = []
    for case in cases:
        others = {m: n for (c, m), n in found.items() if c == case and not m.startswith(OURS) and m not in REFERENCES}
        cells = [_compared(case, name, found, others, won[name]) for name in STANDING]
        times = " / ".join(shown(found[case, m], "seconds") if (case, m) in found else "–" for m in OURS)
        lines.append([case, *cells, times])
    for method in (*OURS, "either"):
        counts = [str(count[method]) for count in won.values()]
        lines.append([f"{method}: best on, of {len(cases)}", *counts, ""])
    return markdown(("case", "SSIM", "FRCM", "Dice", "error of δ", "time / s"), lines).replace("|  |", "| |")


def _compared(case: str, name: str, found: Means, others: dict[str, dict[str, float]], won: dict[str, int]) -> str:
    """One cell: ours, bold where no other method is better, and the best other; `won` counts."""
    sign = STANDING[name]
    method, best = max(((m, n[name]) for m, n in others.items()), key=lambda item: sign * item[1])
    cells, ahead = [], False
    for mine in OURS:
        if (case, mine) not in found:  # surfaces of two materials
            cells.append("–")
            continue
        value = found[case, mine][name]
        as_good = sign * value >= sign * best
        won[mine] += as_good
        ahead |= as_good
        cells.append(f"**{value:.3f}**" if as_good else f"{value:.3f}")
    won["either"] += ahead
    return f"{' / '.join(cells)} ({best:.3f}{'' if ahead else ', *' + str(method) + '*'})"


@table(
    "before-noise",
    "git show c7e8d51:docs/data/benchmark.csv, its rows of Gaussians in noise",
    "a second",
    "before_noise.csv",
    "benchmark.csv",
)
def before_noise() -> str:
    """Gaussians in noise before the changes made for it, and as they are."""
    then, now = means(read("before_noise.csv")), means(read("benchmark.csv"))
    order = ("xmpi4", "two_beam", *(f"plasma8-1e{n}" for n in (3, 4, 5)), "noise12-500", "noise12-2000")
    order += ("noise12-10000", "two_materials8", "crowded12", "foam12")
    return markdown(
        ("case", "before", "now"),
        [[f"`{case}`", *(_four(of[case, "gaussians"]) for of in (then, now))] for case in order],
    )


def _four(numbers: dict[str, float]) -> str:
    """SSIM / FRCM, Dice / error of δ."""
    ssim, frcm, dice, error = (numbers[name] for name in STANDING)
    return f"{ssim:.3f} / {frcm:.3f}, {dice:.3f} / {error:.3f}"


def by_method(
    rows: list[Row], cases: Sequence[str], cell: Sequence[str], rest: Sequence[str] = (), call: str = "`{}`"
) -> str:
    """A line for each method of a benchmark's rows, a column for each case, numbers `cell` in it, one after another.

    rest: methods, in their order (default: all that are there, references left out).
    """
    found = means(rows)
    there = list(dict.fromkeys(m for (c, m) in found if c in cases and m not in REFERENCES))
    lines = []
    for method in rest or there:
        numbers = [found.get((case, method)) for case in cases]
        cells = ["–" if n is None else " / ".join(_cell(n, name) for name in cell) for n in numbers]
        lines.append([call.format(method), *cells])
    return markdown(("method", *(f"`{case}`" for case in cases)), lines)


def _cell(numbers: dict[str, float], name: str) -> str:
    if name == "delta_deviation":
        return f"{round(100 * numbers[name]):+d} %".replace("-", "−")
    return f"{numbers[name]:.3f}"


METHODS = ("paganin-fbp", "paganin-sirt-nonneg", "paganin-tv-nonneg", "paganin-tv", "ctf-tv", "tikhonov-tv")
METHODS += ("gerchberg-saxton-tv", "admm-tv", "holographic-tv", "voxels-waves", "neural-field", "gaussians", "volume")
METHODS += ("auto",)


@table("continuous", f"{BENCH} docs/data/benchmark_continuous.csv", "hours", "benchmark_continuous.csv")
def continuous() -> str:
    """Continuous matter under real light."""
    return by_method(
        read("benchmark_continuous.csv"), CONTINUOUS, ("ssim", "relative_error_delta", "delta_deviation"), METHODS
    )


@table("absorbers", f"{BENCH} docs/data/benchmark_continuous.csv", "an hour", "benchmark_continuous.csv")
def absorbers() -> str:
    """A strong absorber, and contact."""
    several = [m for m in METHODS if m not in ("paganin-tv", "ctf-tv", "gerchberg-saxton-tv", "admm-tv", "gaussians")]
    return by_method(read("benchmark_continuous.csv"), ABSORBERS, ("ssim", "relative_error_beta", "dice"), several)


@table(
    "measured",
    f"{BENCH} docs/data/benchmark_continuous.csv (with --data FOLDER)",
    "an hour",
    "benchmark_continuous.csv",
)
def measured() -> str:
    """Measured frames."""
    left_out = ("paganin-tv", "ctf-tv", "gerchberg-saxton-tv", "admm-tv", "gaussians", "neural-field")
    several = [m for m in METHODS if m not in left_out]
    return by_method(read("benchmark_continuous.csv"), MEASURED, ("ssim", "relative_error_beta"), several)


@table("sharp-light", f"{BENCH} docs/data/sharp_light.csv", "an hour", "sharp_light.csv")
def sharp_light() -> str:
    """Sharp cells in uneven light."""
    several = ("holographic-tv", "gaussians", "surfaces", "auto")
    return by_method(read("sharp_light.csv"), SHARP, ("relative_error_delta", "dice"), several)


@table(
    "photographs",
    "holosplat bench run --cases cells12 cells4 --methods alpha-3dgs nerf --seeds 101 --snapshots DIR --out bench, "
    "then python docs/figures.py benchmark-rows bench docs/data/photographs.csv",
    "ten minutes",
    "photographs.csv",
    "benchmark.csv",
)
def photographs() -> str:
    """Methods without waves, beside some with them, on one scene a case."""
    rows = [row for row in read("photographs.csv") + read("benchmark.csv") if row["seed"] == "101"]
    several = (*PHOTOGRAPHS, "paganin-fbp", "paganin-tv", "gaussians-random", "gaussians", "surfaces")
    return by_method(rows, PHOTOGRAPHED, tuple(STANDING), several)


@table("misaligned", f"{BENCH} docs/data/benchmark_misaligned.csv", "hours", "benchmark_misaligned.csv")
def misaligned() -> str:
    """Beams that are not where they say, of each method with 12 and 4 training views."""
    found = means(read("benchmark_misaligned.csv"))
    plain = ("tikhonov-tv", "tikhonov-tv+mass", "tikhonov-tv+reprojection", "gaussians", "auto")
    aligned = ("tikhonov-tv+align", "gaussians+align", "surfaces+align", "auto+align")
    known = ("tv-true-lines", "truth-on-voxels")

    def cells(method: str) -> list[str]:
        return [
            " / ".join(f"{found[case, method][n]:.3f}" for case in ("misaligned12", "misaligned4")) for n in STANDING
        ]

    lines = [[method, *cells(method)] for method in (*plain, *aligned, *known)]
    return markdown(("method, `misaligned12` / `misaligned4`", "SSIM", "FRCM", "Dice", "error of δ"), lines)


@table("round-cell", "python benchmarks/round_cell.py", "minutes", "round_cell.csv")
def round_cell() -> str:
    """A nearly round cell, by views and what is told, of the first seed."""
    rows = [row for row in read("round_cell.csv") if row["seed"] == "1"]
    cells: dict[str, dict[str, str]] = defaultdict(dict)
    for row in rows:
        numbers = " / ".join(rounded(row[n], d) for n, d in (("phase", 3), ("frames", 2), ("mass", 2)))
        cells[row["case"]][row["told"]] = numbers
    lines = [[case, told["ratio"], told["nothing"]] for case, told in cells.items()]
    return markdown(("", "δ/β told (1e5)", "nothing told"), lines).replace("|  |", "| |", 1)


def rounded(value: str, digits: int) -> str:
    """A number of a file, halves of its last digit away from zero; a dash where there is none."""
    if value in ("", "nan"):
        return "–"
    return str(Decimal(value).quantize(Decimal(1).scaleb(-digits), ROUND_HALF_UP))


def shown(numbers: dict[str, float], name: str) -> str:
    """A number as tables have it; a dash where there is none."""
    if name not in numbers:
        return "–"
    return f"{numbers[name]:.{ {'seconds': 0, 'stored': 1}.get(name, 3) }f}"
