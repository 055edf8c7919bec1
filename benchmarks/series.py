"""What a series costs: rows of docs/data/series.csv.

    python benchmarks/series.py --csv docs/data/series.csv                 # all of it, an hour of two idle cores
    python benchmarks/series.py --cases warm --pixels 64 --times 3         # a part, and smaller

Cases, on cells of haemoglobin that drift by 0.3 pixels from one time to the next, at 1000 photons a pixel in 4 beams:

- warm: a window of times at 128 × 128 pixels: seconds of a time that begins by itself, and of those that go on from it,
  and the Dice of the last one beside that of the same time by itself.
- volume: the same of continuous matter (a stirred blob), fitted as a smooth volume.
- processes: windows of one time (--windows), and as many of eight, by one process and by two of one thread
  each; and plain Python, which shares nothing, by one process and by two: more than that the two cores do not give.
- kills: a run that is killed (kill -9) at random moments, how many times it loses, and whether the rerun is bitwise
  equal.
- overhead: what a task takes beside its fits, and what a process takes before its first one.

Processes run at the same time as whatever else the machine does: the load average before and after stands in each row.
CPU seconds are those of the processes alone, user and system.
"""

from __future__ import annotations

import argparse
import os
import platform
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from rows import merge

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # of processes begun here: from the second run on, users have bytecode
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")

import numpy as np
import torch
from forked import run as forked
from machine import commit

import holosplat as hs
from holosplat.geometry import Grid
from holosplat.io.nxtomo import write_scan
from holosplat.io.objects import read_object
from holosplat.io.reading import Reading
from holosplat.mesh import TriangleMesh
from holosplat.methods import Method
from holosplat.methods.presets import preset
from holosplat.metrics import volume_scores
from holosplat.series.folder import Row, SeriesFolder
from holosplat.series.plan import Cut, Settings, Warm, plan_series
from holosplat.series.run import PROGRAM, states
from holosplat.series.task import run_task
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshSeries

PIXEL, CELL_PX, PHOTONS, STEP_PX = 0.5e-6, 16.0, 1000.0, 0.3
ANGLES = (0.0, 45.0, 90.0, 135.0)
SEED = 101
"""Settings were chosen on scenes of seeds below 100."""
LONGER = 8
"""Times of the longer windows; `series plan` makes windows of 16."""
COLUMNS = ("case", "measure", "value", "pixels", "count", "seed", "load_before", "load_after", "machine", "commit")


@dataclass(frozen=True)
class Options:
    """Sizes: pixels along an edge (0: those of each case), times of a window, windows, kills."""

    pixels: int
    times: int
    windows: int
    kills: int


def drifting(pixels: int, cells: int, times: int) -> tuple[MeshSeries, hs.Scan]:
    """Cells that drift, each its own way and back after sixteen times, and their frames."""
    material = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
    still = random_cells(cells, (pixels * PIXEL,) * 3, SEED, CELL_PX * PIXEL)
    ways = np.random.default_rng(SEED).normal(size=(cells, 3))
    ways *= STEP_PX * PIXEL / np.linalg.norm(ways, axis=1, keepdims=True)
    steps = [min(k % 32, 32 - k % 32) for k in range(times)]
    at = [[TriangleMesh(c.vertices + k * w, c.faces, c.name) for c, w in zip(still, ways)] for k in steps]
    truth = MeshSeries(tuple(hs.MeshScene.of_one_material(m, material) for m in at), 1e-3 * np.arange(times))
    views = hs.Views.from_angles(np.array(ANGLES), (pixels, pixels), PIXEL)
    exposures = hs.Exposures.of(views, 20.0, 0.1).repeated(truth.times)
    none = np.zeros(len(exposures), dtype=bool)
    return truth, hs.simulate(truth, exposures, photons_per_pixel=PHOTONS, seed=SEED, is_test=none)


def known(energy_kev: float) -> hs.MaterialPrior:
    """Haemoglobin."""
    return hs.MaterialPrior.known(hs.materials.HAEMOGLOBIN.delta_beta(energy_kev))


def planned(folder: Path, scan: Path, settings: Settings, window: int, unknown: bool = False) -> SeriesFolder:
    """A new series."""
    made = SeriesFolder(folder)
    prior = (lambda energy: hs.MaterialPrior.of_ratio(1000.0)) if unknown else known
    made.create(plan_series([scan], settings, prior, Reading(), Cut(window)))
    return made


def used() -> float:
    """CPU seconds of this process and of those that it has waited for."""
    parts = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(part.ru_utime + part.ru_stime for part in parts)


Measured = Iterator[tuple[str, float]]


def warm(work: Path, options: Options) -> Measured:
    """A slow series of bodies."""
    pixels, times = options.pixels or 128, options.times
    truth, scan = drifting(pixels, max(2, round(8 * (pixels / 128) ** 2)), times)
    write_scan(work / "scan.nxs", scan)
    folder = planned(work / "warm", work / "scan.nxs", Settings(), times)
    yield from in_one_window(folder)
    alone = planned(work / "alone", work / "scan.nxs", Settings(warm=Warm(on=False)), 1)
    run_task(alone, times - 1)
    for name, path in (("warm", folder.run(0, times - 1)), ("by itself", alone.run(times - 1, times - 1))):
        grid = Grid.of_views(scan.views)
        true = truth.at(1e-3 * (times - 1)).voxelise(grid)
        yield f"Dice of the last time, {name}", volume_scores(read_object(path / "object.h5").voxelise(grid), true).dice


def in_one_window(folder: SeriesFolder) -> Measured:
    """Seconds and CPU seconds of the times of the one task, which is done."""
    spent, last = list[tuple[str, float, float]](), used()

    def note(row: Row) -> None:
        nonlocal last
        assert row.done, row.reason
        now = used()
        spent.append((row.begun, row.seconds, now - last))
        last = now

    run_task(folder, 0, note)
    for begun in dict.fromkeys(begun for begun, *_ in spent):
        here = np.array([numbers for kind, *numbers in spent if kind == begun])
        yield f"times begun {begun}", float(len(here))
        yield f"median seconds, {begun}", float(np.median(here[:, 0]))
        yield f"median CPU seconds, {begun}", float(np.median(here[:, 1]))
        yield f"most CPU seconds, {begun}", float(here[:, 1].max())


def volume(work: Path, options: Options) -> Measured:
    """A slow series of continuous matter: the blob's middle turns by 2° from one time to the next."""
    pixels, times = options.pixels or 128, options.times
    command = ["simulate", "--specimen", "stirred-blob", "--detector", pixels, pixels, "--pixel-size", PIXEL]
    command += ["--frame-rate", 1000, "--frames", times, "--specimen-motion", 2 * (times - 1), "--test-every", 0]
    command += ["--angles-deg", *ANGLES, "--photons-per-pixel", PHOTONS, "--seed", SEED, "--out", work / "blob.nxs"]
    ended = forked(command, limit=600)
    assert ended.code == 0, ended.said
    settings = Settings(method=hs.methods.SmoothVolume(), matter="continuous")
    yield from in_one_window(planned(work / "blobs", work / "blob.nxs", settings, times, unknown=True))


def quick() -> Method:
    """Gaussians of few steps, so that a task takes seconds."""
    found = preset("fast")
    return replace(found, fit=replace(found.fit, schedule=replace(found.fit.schedule, steps=20)))


def small(work: Path, times: int, pixels: int) -> Path:
    """The scan of small windows."""
    work.mkdir(exist_ok=True)
    path = work / "small.nxs"
    write_scan(path, drifting(pixels, 3, times)[1])
    return path


def processes(work: Path, options: Options) -> Measured:
    """Windows of one time, and of `LONGER` times, by one process and by two; all find Python's bytecode written."""
    settings = Settings(method=quick(), matter="levels")
    scan = small(work, LONGER * options.windows, options.pixels or 48)
    short = small(work / "short", options.windows, options.pixels or 48)
    working(planned(work / "first", small(work / "one", 1, 32), settings, 1), 1)
    for about, path, times in (("", short, 1), (f", windows of {LONGER} times", scan, LONGER)):
        seconds = dict[int, float]()
        for jobs in (1, 2):
            before = used()
            folder = planned(work / f"by_{jobs}_in_{times}", path, settings, times)
            seconds[jobs] = working(folder, jobs)
            name = f"{'one process' if jobs == 1 else 'two processes'}{about}"
            yield f"seconds, {name}", seconds[jobs]
            yield f"CPU seconds, {name}", used() - before
        yield f"times faster, two processes than one{about}", seconds[1] / seconds[2]
    alone, two = looped(1), looped(2)
    yield "times faster, two processes of plain Python than one", 2 * alone / two


def working(folder: SeriesFolder, jobs: int) -> float:
    """Seconds that `jobs` processes of one thread take for all tasks."""
    command = [sys.executable, *PROGRAM, "series", "run", str(folder.path)]
    began = time.perf_counter()
    workers = [subprocess.Popen(command, stderr=subprocess.DEVNULL) for _ in range(jobs)]
    assert [worker.wait() for worker in workers].count(0) > 0
    assert {state.state for state in states(folder)} == {"done"}
    return time.perf_counter() - began


def looped(jobs: int) -> float:
    """Seconds that `jobs` processes take, each of which counts to fifty million."""
    command = [sys.executable, "-c", "n = 0\nfor k in range(50_000_000): n += k"]
    began = time.perf_counter()
    assert not any(worker.wait() for worker in [subprocess.Popen(command) for _ in range(jobs)])
    return time.perf_counter() - began


def arrays(folder: SeriesFolder, moments: int, window: int) -> list[torch.Tensor]:
    """The numbers of all results."""
    paths = [folder.run(k // window, k) / "object.h5" for k in range(moments)]
    return [tensor for path in paths for tensor in read_object(path).parameters().values()]


def kills(work: Path, options: Options) -> Measured:
    """Runs that are killed at random moments, and run again."""
    times, window, draw = 6, 3, random.Random(SEED)
    scan = small(work, times, options.pixels or 48)
    settings = Settings(method=quick(), matter="levels")
    whole = planned(work / "whole", scan, settings, window)
    ended = forked(["series", "run", whole.path], limit=600)
    assert ended.code == 0, ended.said
    wanted, lost, unequal, redone = arrays(whole, times, window), 0, 0, 0
    for trial in range(options.kills):
        folder = planned(work / f"killed{trial}", scan, settings, window)
        forked(["series", "run", folder.path], kill_after=draw.uniform(0.02, 0.98) * ended.seconds, limit=600)
        rows = {path: path.read_bytes() for path in folder.path.rglob("*.row.json")}
        begun = len(list(folder.path.rglob("config.json")))
        lost = max(lost, begun - len(rows))
        again = forked(["series", "run", folder.path], limit=600)
        assert again.code == 0, again.said
        redone += sum(path.read_bytes() != text for path, text in rows.items())
        found = arrays(folder, times, window)
        unequal += not all(torch.equal(one, other) for one, other in zip(found, wanted, strict=True))
        shutil.rmtree(folder.path)
    yield "kills", float(options.kills)
    yield "most times lost by a kill", float(lost)
    yield "times that were done, and were done again", float(redone)
    yield "reruns that differ in a bit", float(unequal)


def overhead(work: Path, options: Options) -> Measured:
    """What tasks and processes take beside the fits."""
    count, pixels = 6, options.pixels or 128
    path = work / "some.nxs"
    write_scan(path, drifting(pixels, 8, count)[1])
    folder = planned(work / "some", path, Settings(method=quick(), matter="levels"), 1)
    scan, beside = hs.io.read_scan(path), list[float]()
    for number in range(count):
        before = used()
        run_task(folder, number)
        whole, before = used() - before, used()
        hs.reconstruct(scan.at_instant(number), known(20.0), quick(), matter="levels")
        beside.append(whole - (used() - before))
    yield "median CPU seconds of a task beside the reconstruction itself", float(np.median(beside))
    command = [sys.executable, *PROGRAM, "series", "run", str(folder.path), "0"]
    spent = []
    for _ in range(5):
        before = used()
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
        spent.append(used() - before)
    yield "CPU seconds of a process whose task is done", float(np.median(spent))


CASES = {"warm": warm, "volume": volume, "processes": processes, "kills": kills, "overhead": overhead}


def main() -> None:
    """Measure, print, and keep."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--pixels", type=int, default=0, help="pixels along an edge (default: those of each case)")
    parser.add_argument("--times", type=int, default=8)
    parser.add_argument("--windows", type=int, default=64)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--csv", type=Path)
    given = parser.parse_args()
    options = Options(given.pixels, given.times, given.windows, given.kills)
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    for case in given.cases:
        with tempfile.TemporaryDirectory() as temporary:
            load = os.getloadavg()[0]
            found = list(CASES[case](Path(temporary), options))
        after, count = os.getloadavg()[0], options.windows if case == "processes" else options.times
        machine = f"{platform.machine()}, {os.cpu_count()} cores"
        rows = [
            (
                case,
                name,
                f"{value:.4g}",
                given.pixels or "",
                count,
                SEED,
                f"{load:.1f}",
                f"{after:.1f}",
                machine,
                commit(),
            )
            for name, value in found
        ]
        for row in rows:
            print(*row[:3], sep=": ", flush=True)
        if given.csv:
            merge([dict(zip(COLUMNS, row)) for row in rows], given.csv, "case", columns=COLUMNS)


if __name__ == "__main__":
    main()
