"""The tables of notebook/thesis_study.md, from docs/data/thesis_study, by `python benchmarks/thesis_runs.py`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from holosplat.report.style import scientific
from holosplat_bench.suite.case import FOLDER, read_declaration
from holosplat_bench.thesis.configurations import EVERY, PACES, THESIS_TABLE
from holosplat_bench.thesis.findings import findings
from holosplat_bench.thesis.folder import CURVES, Study

from .benchmark import TABLES, Table, markdown, read
from .runs import script

THESIS = "python benchmarks/thesis_runs.py run RUNS --snapshots DIR, then collect RUNS"

DATA = Path(__file__).resolve().parents[1] / "data" / "thesis_study"
SCHEDULES = {"short": "3 000 steps", "third": "10 000 steps", "full": "30 000 steps"}
PLAIN, MAIN = ("thesis16", "declared"), "8k-v4"
HEAD = ("configuration", "seeds", "SSIM", "FRCM", "best FRCM (at)", "PSNR (dB)", "Dice")
HEAD += ("δ/β in cells", "own: mean", "own: median", "Gaussians at the end", "ms a step")
Row = dict[str, str]


def read_rows() -> list[Row]:
    """runs.csv, a row a run."""
    return read("thesis_study/runs.csv")


def where(row: Row) -> tuple[str, str, str]:
    """Schedule, case and physics."""
    return row["schedule"], row["case"], row["physics"]


def number(row: Row, key: str) -> float:
    """A column; infinite where JSON had no number for it."""
    return float(row[key]) if row[key] else float("inf")


def declared_pixel(case: str) -> float:
    """The pixel size [m] of a case of the study, whose voxels are as large."""
    return read_declaration(FOLDER / "thesis.toml", case).exposures()[0].views.pixel_size


def study_of(rows: Sequence[Row]) -> Study:
    """The study that `rows`, of one schedule, case, physics and seed, are of."""
    first = rows[0]
    pace = PACES[first["schedule"]]
    table = {row["name"]: row for row in rows}
    names = [c.name for c in EVERY if c.name in table]
    delta, beta = (float(first[f"true_{name}"]) for name in ("delta", "beta"))
    about: dict[str, Any] = {"true_delta": delta, "true_beta": beta}
    about["pixel_size_m"] = declared_pixel(first["case"])
    about["warmup_steps"] = pace.recipe(THESIS_TABLE[0], 1, 1.0).fit.schedule.warmup_steps
    curves = {name: read_curves(table[name]) for name in names}
    looks = {name: {when: look(table[name], when) for when in ("last", "best")} for name in names}
    facts = {name: {"status": table[name]["status"]} for name in names}
    return Study(about, {name: facts[name] | looks[name] for name in names}, curves, read_maps(first))


def look(row: Row, when: str) -> dict[str, float | None]:
    """The last or the best look."""
    return {key: float(text) if (text := row[f"{when}_{key}"]) else None for key in CURVES}


def read_curves(row: Row) -> dict[str, np.ndarray]:
    """The curves of a run."""
    name = "_".join((*where(row), row["seed"], row["name"]))
    table = read(f"thesis_study/{name}.csv")
    return {key: np.array([float(line[key]) for line in table]) for key in CURVES}


def read_maps(row: Row) -> dict[str, dict[str, np.ndarray]]:
    """The maps of each configuration of a study; empty where none are kept."""
    path = DATA / f"maps_{'_'.join((*where(row), row['seed']))}.npz"
    maps: dict[str, dict[str, np.ndarray]] = {}
    if path.is_file():
        with np.load(path) as found:
            for key in found.files:
                name, _, kind = key.partition("/")
                maps.setdefault(name, {})[kind] = found[key]
    return maps


def spread(values: Iterable[float], form: str) -> str:
    """Mean and half the range of finite values: "0.912 ± 0.004"."""
    found = np.array(list(values))
    if not np.isfinite(found).all():
        return "∞"
    text = format(found.mean(), form)
    return text if len(found) == 1 else f"{text} ± {format(np.ptp(found) / 2, form)}"


def ratio(values: Iterable[float]) -> str:
    """The geometric mean of ratios, which spread over decades."""
    found = np.array(list(values))
    return scientific(float(np.exp(np.log(found).mean())) if np.isfinite(found).all() else float("inf"), 3)


def line(name: str, rows: Sequence[Row]) -> tuple[str, ...]:
    """A line of a table: `rows` are the seeds of one configuration."""

    def of(key: str) -> list[float]:
        return [number(row, key) for row in rows]

    ended = [f" (diverged at {row['diverged_at']})" for row in rows if row["status"] != "done"]
    steps = " ".join(f"{step:.0f}" for step in of("best_step"))
    return (
        name + "".join(ended),
        " ".join(row["seed"] for row in rows),
        *(spread(of(f"last_{key}"), ".3f") for key in ("test_ssim", "test_frcm")),
        f"{spread(of('best_test_frcm'), '.3f')} ({steps})",
        spread(of("last_test_psnr"), ".1f"),
        spread(of("last_dice"), ".3f"),
        *(ratio(of(f"last_{key}")) for key in ("ratio", "own_ratio", "median_own_ratio")),
        " ".join(f"{count:,.0f}" for count in of("last_count")),
        spread([1e3 * number(row, "seconds") / number(row, "steps") for row in rows], ".0f"),
    )


def table(rows: Sequence[Row]) -> str:
    """A table with a line for each configuration, seeds taken together."""
    order = [c.name for c in EVERY]
    ordered = sorted(rows, key=lambda row: (order.index(row["name"]), row["case"], row["physics"], int(row["seed"])))
    groups = [(key, list(group)) for key, group in groupby(ordered, key=lambda row: row["name"])]
    return markdown(HEAD, [line(key, group) for key, group in groups])


def verdicts() -> str:
    """A line for each finding, schedule and seed."""
    found = {name: findings(study) for name, study in studies(read_rows()).items()}
    lines = [(f.claim, name, f.verdict, f.evidence) for name, each in found.items() for f in each]
    order = [f.claim for f in next(iter(found.values()))]
    ordered = sorted(lines, key=lambda made: order.index(made[0]))
    return markdown(("finding", "schedule, seed", "verdict", "evidence"), ordered)


def configurations(schedule: str) -> str:
    """The configurations under one schedule, on the case as declared."""
    return table([row for row in read_rows() if where(row) == (schedule, *PLAIN)])


def others(schedule: str) -> str:
    """`8k-v4` of the other case and in other physics, beside itself."""
    main = [row for row in read_rows() if (row["schedule"], row["name"]) == (schedule, MAIN)]
    lines = []
    for (case, physics), _ in groupby(sorted(main, key=_setting), key=_setting):
        lines += [line(f"{case}, {physics}", [row for row in main if _setting(row) == (case, physics)])]
    return markdown(("case, physics", *HEAD[1:]), lines)


def _setting(row: Row) -> tuple[str, str]:
    return row["case"], row["physics"]


def studies(rows: Sequence[Row]) -> dict[str, Study]:
    """The studies of the case as declared, by schedule and seed."""
    found = {}
    for schedule in SCHEDULES:
        plain = [row for row in rows if where(row) == (schedule, *PLAIN)]
        for seed in sorted({int(row["seed"]) for row in plain}):
            found[f"{SCHEDULES[schedule]}, {seed}"] = study_of([row for row in plain if int(row["seed"]) == seed])
    return found


def left() -> str:
    """What was not run, with a command for each study."""
    runs = script("thesis_runs")
    had = {tuple(row[key] for key in runs.IDENTITY) for row in read_rows()}
    missing = [task for task in runs.tasks() if runs.known(task) not in had]
    studies_left: dict[str, list[Any]] = {}
    for task in missing:
        studies_left.setdefault(task.study, []).append(task)
    lines = []
    for tasks in studies_left.values():
        first = tasks[0].command(Path("RUNS"), "DIR")
        at = first.index(tasks[0].name)
        command = " ".join([*first[:at], *(task.name for task in tasks), *first[at + 1 :]])
        lines.append((SCHEDULES[tasks[0].schedule], str(len(tasks)), f"`{command}`"))
    return markdown((f"{len(missing)} runs are left: steps", "runs", "command"), lines)


TABLES |= {
    f"thesis-{name}": Table(make, ("thesis_study/runs.csv",), THESIS, "a day")
    for name, make in (
        *((schedule, partial(configurations, schedule)) for schedule in SCHEDULES),
        ("others", partial(others, "short")),
        ("others-third", partial(others, "third")),
        ("others-full", partial(others, "full")),
        ("findings", verdicts),
        ("left", left),
    )
}
