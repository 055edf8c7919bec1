"""All runs of docs/notebook/thesis_study.md, two at a time, and what they leave: docs/data/thesis_study.

    python benchmarks/thesis_runs.py run RUNS --snapshots DIR [--jobs 2] [--minutes 600]
    python benchmarks/thesis_runs.py list RUNS
    python benchmarks/thesis_runs.py collect RUNS

DIR holds the snapshots of an ESPResSo run, as for espresso_flow.py. A run is one configuration on one thread, a
subprocess `holosplat bench thesis`; RUNS gets a folder of a study for each schedule, case, physics and seed. What is
finished, there or by its row in runs.csv, is skipped, and what was cut off goes on from its checkpoint, so that the
same command can be given again. `list` says what is left, with its command. `collect` adds to runs.csv (a row a run:
schedule, case, physics, seed, hash of the scan, commit, scores at the end and at the best held-out FRCM), writes the
curves of each run, and for the pictures the maps of the studies of seed 0.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from rows import read, write

from holosplat.io.atomic import atomic_path
from holosplat_bench.thesis.configurations import BESIDE, DECLARED, EVERY, EXTRA, PACES, PHYSICS, THESIS_TABLE
from holosplat_bench.thesis.folder import CURVES, StudyFolder

DATA = Path(__file__).resolve().parents[1] / "docs" / "data" / "thesis_study"
SMALL = [c.name for c in THESIS_TABLE if c.count == THESIS_TABLE[0].count]
LARGE = [c.name for c in THESIS_TABLE if c.name not in SMALL]
OURS = [c.name for c in (*BESIDE, *DECLARED, *EXTRA)]
MAIN = "8k-v4"
SEEDS = (0, 1, 2)
IDENTITY = ("schedule", "case", "physics", "seed", "name")


@dataclass(frozen=True)
class Task:
    """One configuration under one schedule, of one case in one physics, with one seed."""

    schedule: str
    name: str
    case: str = "thesis16"
    physics: str = "declared"
    seed: int = 0

    @property
    def study(self) -> str:
        """The name of its study's folder."""
        return f"{self.schedule}_{self.case}_{self.physics}_{self.seed}"

    def command(self, runs: Path, snapshots: Path | str) -> list[str]:
        """What runs it."""
        shown = [f"--{key}={getattr(self, key)}" for key in ("schedule", "case", "physics", "seed")]
        made = ["holosplat", "bench", "thesis", "--out", str(runs / self.study), "--configurations", self.name]
        return [*made, *shown, "--snapshots", str(snapshots)]


def tasks() -> list[Task]:
    """All of them, the most telling first."""
    at_once = [Task("third", name) for name in (*SMALL, *OURS)]
    long = [Task("full", name) for name in (MAIN, *(name for name in (*SMALL, *OURS) if name != MAIN))]
    others = [Task("third", MAIN, "thesis8")]
    others += [Task("third", MAIN, physics=physics) for physics in PHYSICS if physics != "declared"]
    short = [replace(task, schedule="short") for task in (*at_once, *others)]
    again = [replace(task, seed=seed) for seed in SEEDS[1:] for task in (*at_once[: len(SMALL)], *others)]
    again += [replace(task, seed=seed) for seed in SEEDS[1:] for task in at_once[len(SMALL) :]]
    large = [Task(schedule, name) for schedule, name in product(("short", "third", "full"), LARGE)]
    first = [*at_once[:3], long[0], *short, *at_once[3 : len(SMALL)], *others, large[0], *at_once[len(SMALL) :]]
    slow = [replace(task, schedule="full") for task in others]
    return [*first, *again, *long[1:], *large[1:], *slow]


def finished(runs: Path, task: Task) -> bool:
    """Whether it is done in `runs`."""
    return StudyFolder(runs / task.study).finished(task.name)


def collected() -> dict[tuple[str, ...], dict[str, str]]:
    """The rows of runs.csv, by what names their runs."""
    return {tuple(row[key] for key in IDENTITY): row for row in read(DATA / "runs.csv")}


def known(task: Task) -> tuple[str, ...]:
    """What names its row in runs.csv."""
    return tuple(str(getattr(task, key)) for key in IDENTITY)


class Queue:
    """Hands out what is left; two tasks of one study never at a time, for one process writes to a folder."""

    def __init__(self, runs: Path, until: float) -> None:
        self._runs, self._until = runs, until
        had = collected()
        self._lock, self._busy = threading.Lock(), set[str]()
        self._tried = {task for task in tasks() if known(task) in had}

    def next(self) -> Task | None:
        """The next task; None when there is none, or time is over."""
        with self._lock:
            for task in tasks():
                free = task.study not in self._busy and task not in self._tried
                if free and time.monotonic() < self._until and not finished(self._runs, task):
                    self._busy.add(task.study)
                    self._tried.add(task)
                    return task
        return None

    def done(self, task: Task) -> None:
        """Its folder is free again."""
        with self._lock:
            self._busy.discard(task.study)


def work(queue: Queue, runs: Path, snapshots: Path) -> None:
    """Run tasks until there are none, or time is over."""
    while (task := queue.next()) is not None:
        began = time.monotonic()
        environment = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        command = [str(Path(sys.executable).with_name("holosplat")), *task.command(runs, snapshots)[1:]]
        ended = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        queue.done(task)
        said = "done" if ended.returncode == 0 else f"exit {ended.returncode}: {ended.stderr[-300:]}"
        print(f"{task.study} {task.name}: {said}, {time.monotonic() - began:.0f} s", flush=True)


def run(runs: Path, snapshots: Path, jobs: int, minutes: float) -> None:
    """Run what is left, `jobs` at a time, and begin none after `minutes`."""
    runs.mkdir(exist_ok=True)
    queue = Queue(runs, time.monotonic() + 60 * minutes)
    threads = [threading.Thread(target=work, args=(queue, runs, snapshots)) for _ in range(jobs)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def rows(runs: Path) -> Iterator[dict[str, object]]:
    """A row of runs.csv for each task that is done, here or by its row there."""
    had = collected()
    for task in tasks():
        if not finished(runs, task):
            if known(task) in had:
                yield dict(had[known(task)])
            continue
        folder = StudyFolder(runs / task.study)
        about, row = json.loads(folder.about.read_text()), folder.row(task.name)
        looks = {f"{when}_{key}": value for when in ("last", "best") for key, value in row[when].items()}
        kept = {key: row[key] for key in ("status", "diverged_at", "steps", "seconds", "commit")}
        about = {key: about[key] for key in ("scan_hash", "true_delta", "true_beta")}
        yield {key: getattr(task, key) for key in IDENTITY} | kept | about | looks


def collect(runs: Path) -> None:
    """Write runs.csv, the curves, and the maps for the pictures."""
    found = list(rows(runs))
    write(found, DATA / "runs.csv")
    for task in tasks():
        if not finished(runs, task):
            continue
        source = runs / task.study / f"{task.name}.curves.csv"
        (DATA / f"{task.study}_{task.name}.csv").write_bytes(source.read_bytes())
    for study in (f"{schedule}_thesis16_declared_0" for schedule in PACES):
        if (runs / study).is_dir():
            collect_maps(runs / study, DATA / f"maps_{study}.npz")
    print(f"{len(found)} of {len(tasks())} runs, {len(CURVES)} columns of curves each, in {DATA}")


def collect_maps(study: Path, out: Path) -> None:
    """One file of what pictures show: the middle slice of each configuration, line integrals of one, the truth."""
    found, folder = {}, StudyFolder(study)
    for name in (c.name for c in EVERY if folder.finished(c.name)):
        maps = folder.maps(name)
        found[f"{name}/slice"] = maps["slice"]
        if name == MAIN:
            found |= {f"{name}/{key}": maps[key] for key in ("true_slice", "steps", "lines", "true_lines")}
    if out.exists():
        with np.load(out) as had:
            found = dict(had) | found
    with atomic_path(out) as path, path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **found)


def main() -> None:
    """Run, list or collect."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("act", choices=("run", "list", "collect"))
    parser.add_argument("runs", type=Path)
    parser.add_argument("--snapshots", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=600.0)
    given = parser.parse_args()
    if given.act == "run":
        run(given.runs, given.snapshots, given.jobs, given.minutes)
    elif given.act == "collect":
        collect(given.runs)
    else:
        had = collected()
        for task in tasks():
            done = known(task) in had or finished(given.runs, task)
            print("done" if done else "left", *task.command(given.runs, "DIR"))


if __name__ == "__main__":
    main()
