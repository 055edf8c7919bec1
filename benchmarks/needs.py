"""What jobs are said to take beside what they take: the estimates of `holosplat.planning.needs` against the peak memory
of each command in a process of its own.

python benchmarks/needs.py --csv docs/data/needs.csv

Iterations are few, for arrays are as large in the first as in the last. Estimates are ranges where the frames decide
between ways; `ratio` is the end that is nearer to the truth, over the truth, and 1 within the range. Wanted: within a
factor of 1.5, and never below 0.8 of the truth.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import machine
from rows import read, write

from holosplat.beamline.simulate import SIMULATED_FRINGE_SAMPLES
from holosplat.geometry import Views
from holosplat.io.vtk import write_mesh
from holosplat.methods import METHODS
from holosplat.optics.sampling import resolving_oversample
from holosplat.planning.acts import of_simulation
from holosplat.planning.needs import Sizes, of_reconstruction
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import random_cells

ENERGY_KEV, DISTANCE = 20.0, 0.1
"""Those that `simulate` takes by default."""
FEW = {"retrieval": 4, "iterations": 10, "corrections": 1, "inner": 2}
START = [f"volume.{name}={value}" for name, value in FEW.items()]
QUICK = {
    "gaussians": [*START, "approximate_steps=2", "fit.schedule.steps=6"],
    "surfaces": [
        *(f"gaussians.{change}" for change in (*START, "approximate_steps=2", "fit.schedule.steps=6")),
        "fit.schedule.steps=3",
    ],
    "volume": [*START, "rounds=1", "iterations=3"],
    "voxels": [*START, "fit.steps=4"],
    "holographic-tv": START,
    "tikhonov-tv": [],
}
"""Changes of a method's options that leave its arrays as large as they are."""
MEASURE = """
import sys
from holosplat.cli import main
try:
    main()
finally:
    lines = open("/proc/self/status").read().splitlines()
    print("peak", next(line.split()[1] for line in lines if line.startswith("VmHWM:")))
"""


@dataclass(frozen=True)
class Job:
    """A method on so many views of rows × columns pixels of a size [m]."""

    method: str
    rows: int
    columns: int
    views: int
    pixel: float


JOBS = (
    Job("simulate", 128, 128, 8, 3.2e-6),
    Job("simulate", 384, 384, 2, 1.6e-6),
    Job("gaussians", 48, 64, 2, 8.6e-6),
    Job("gaussians", 64, 64, 16, 3.2e-6),
    Job("gaussians", 128, 128, 8, 3.2e-6),
    Job("gaussians", 384, 384, 2, 1.6e-6),
    Job("surfaces", 96, 128, 4, 3.2e-6),
    Job("surfaces", 256, 256, 3, 1.6e-6),
    Job("volume", 64, 64, 16, 3.2e-6),
    Job("volume", 192, 160, 4, 1.6e-6),
    Job("voxels", 96, 128, 4, 3.2e-6),
    Job("holographic-tv", 192, 160, 4, 1.6e-6),
    Job("tikhonov-tv", 128, 128, 8, 3.2e-6),
    Job("tikhonov-tv", 256, 256, 3, 1.6e-6),
)


def peak(arguments: list[object]) -> float:
    """Bytes that a command takes at its peak."""
    command = [sys.executable, "-c", MEASURE, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(done.stderr[-2000:])
    return 1024 * float(done.stdout.split("peak")[-1])


def simulated(job: Job, folder: Path) -> tuple[Path, float]:
    """The scan of a job, of four cells, and what simulating it takes."""
    extents = (job.columns * job.pixel, job.rows * job.pixel, job.columns * job.pixel)
    cells = random_cells(4, extents, 1, min(job.rows, job.columns) * job.pixel / 3.2)
    files = [folder / f"{cell.name}.vtk" for cell in cells]
    for file, cell in zip(files, cells):
        write_mesh(file, cell, "um")
    beam = ["--detector", job.rows, job.columns, "--pixel-size", job.pixel, "--views", job.views, "--test-every", 0]
    out = folder / "scan.nxs"
    return out, peak(["simulate", *files, "--length-unit", "um", "--material", "haemoglobin", *beam, "--out", out])


def row(job: Job) -> dict[str, object]:
    """What a job is said to take, and takes."""
    with tempfile.TemporaryDirectory() as name:
        scan, found = simulated(job, Path(name))
        if job.method != "simulate":
            known = ["--material", "haemoglobin", "--matter", "continuous" if job.method == "volume" else "levels"]
            changes = [part for change in QUICK[job.method] for part in ("--set", change)]
            out = ["--out", Path(name) / "run", "--method", job.method]
            found = peak(["reconstruct", scan, *out, *known, *changes])
    return vars(job) | compared(job, found / 1e6)


def compared(job: Job, measured: float) -> dict[str, object]:
    """What a job is said to take beside what it takes [MB]."""
    views = Views.evenly_spaced(job.views, (job.rows, job.columns), job.pixel)
    exposures = Exposures.of(views, ENERGY_KEV, DISTANCE)
    if job.method == "simulate":
        said = of_simulation(exposures, resolving_oversample(exposures, SIMULATED_FRINGE_SAMPLES, 4), job.views)
    else:
        said = of_reconstruction(Sizes.of(exposures), METHODS[job.method])
    assert said is not None
    least, most = (said.least_memory or said.memory) / 1e6, said.memory / 1e6
    ratio = min(max(measured, least), most) / measured
    found = {"measured_mb": round(measured), "ratio": round(ratio, 2)}
    return {"least_mb": round(least), "estimate_mb": round(most)} | found


def again(path: Path) -> list[dict[str, object]]:
    """The table with the same measurements and estimates made anew."""
    rows = read(path)
    for row in rows:
        sizes = (int(str(row[name])) for name in ("rows", "columns", "views"))
        job = Job(str(row["method"]), *sizes, float(str(row["pixel"])))
        row |= compared(job, float(str(row["measured_mb"])))
    return rows


def main() -> None:
    """All jobs, and a table of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--again", action="store_true", help="estimates anew, beside the measurements of the table")
    given, rows = parser.parse_args(), list[dict[str, object]]()
    if given.again:
        write(again(given.csv), given.csv)
        return
    if given.csv and given.csv.exists():  # what is there is kept, so that a table may grow
        rows = again(given.csv)
    there = {tuple(str(row[name]) for name in vars(JOBS[0])) for row in rows}
    for job in JOBS:
        if tuple(map(str, vars(job).values())) in there:
            continue
        rows.append(row(job) | {"machine": f"{os.cpu_count()} × {platform.machine()}", "commit": machine.commit()})
        print(rows[-1], flush=True)
        if given.csv:
            write(rows, given.csv)


if __name__ == "__main__":
    main()
