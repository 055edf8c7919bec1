"""Simulation, measured: time, memory and accuracy of frames that stream to a file, and of the true volume.

    python benchmarks/simulate.py           # a Markdown table
    python benchmarks/simulate.py --json

Generated red cells of 8 µm (1280 triangles each), 20 keV, 10 cm, PSF 0.5 px, seed 1; each case is a process of its own.
Accuracy: the same cells on a field of 96 × 80 pixels, against float64 waves and rays on a raster `FINER` times as fine
as a pixel, root mean square over the contrast's. Projection: 12 views of the cells by the compiled kernel and by
its twin in plain torch, in turns, the least of three times.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit, memory_megabytes

import holosplat as hs
from holosplat.beamline.simulate import Simulation, simulated_frames
from holosplat.io.nxtomo import scan_writer
from holosplat.io.volumes import write_voxels
from holosplat.specimens.scene import MeshSeries
from holosplat.workflows.provenance import environment

SEED, CELLS, DIAMETER = 1, 16, 8e-6
SPEED, FRAME_RATE = 0.05, 1.128e6
"""Of the cells along x [m/s], and of the camera [Hz]."""
CASES: dict[str, tuple[int, int, int, float]] = {
    "16 views": (512, 1, 16, 0.5e-6),
    "16 views, coarse": (512, 1, 16, 1e-6),
    "16 times × 4 views": (256, 16, 4, 0.5e-6),
    "64 times × 4 views": (256, 64, 4, 0.5e-6),
    "64 times × 4 views, coarse": (256, 64, 4, 1e-6),
    "true volume": (512, 1, 0, 0.5e-6),
}
"""Pixels along an edge, times, views at each (0: voxels), pixel size [m]."""
FINER, SMALL = 10, (96, 80)
FINE = (1, 4, 16)
"""Samples along the edge of a pixel of the projections that are timed."""


def cells(box: float) -> hs.MeshScene:
    """The cells in a cube of edge `box` [m]."""
    meshes = hs.specimens.random_cells(CELLS, (box, box, box), SEED, DIAMETER)
    return hs.MeshScene.of_one_material(meshes, hs.materials.HAEMOGLOBIN.delta_beta(20.0))


def moving(scene: hs.MeshScene, times: int) -> MeshSeries:
    """The cells, carried along x."""
    length = max(times - 1, 1) / FRAME_RATE
    return MeshSeries((scene, scene.moved(np.array([SPEED * length, 0, 0]))), np.array([0.0, length]))


def exposures(shape: tuple[int, int], views: int, pixel: float) -> hs.Exposures:
    """20 keV, 10 cm, evenly spaced views."""
    return hs.Exposures.of(hs.Views.evenly_spaced(views, shape, pixel), 20.0, 0.1, 0.5)


def run(name: str) -> dict[str, Any]:
    """One case, in this process: seconds, those of all cores together, and megabytes."""
    size, times, views, pixel = CASES[name]
    obj = moving(cells(0.6 * min(size * pixel, 140e-6)), times)
    taken = exposures((size, size), max(views, 1), pixel).repeated(np.arange(times) / FRAME_RATE)
    before = memory_megabytes("VmRSS")
    with tempfile.TemporaryDirectory() as folder:
        began, cpu = time.perf_counter(), time.process_time()
        if views:
            with scan_writer(Path(folder) / "scan.nxs", taken, np.zeros(len(taken), bool), {}) as add:
                for frame in simulated_frames(obj, taken):
                    add(frame)
        else:
            write_voxels(Path(folder) / "truth.h5", obj.at(0.0), hs.Grid.of_views(taken.views))
        seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    count = len(taken) if views else 0
    peak = memory_megabytes("VmHWM")
    return {"case": name, "size": size, "pixel": pixel, "frames": count, "samples": Simulation().samples(taken),
            "seconds": seconds, "cpu_seconds": cpu, "peak_mb": peak, "added_mb": peak - before}  # fmt: skip


def accuracy(pixel: float) -> dict[str, float]:
    """Errors of a frame of cells, over the root mean square of its contrast: of the method, and of float32 alone."""
    taken = exposures(SMALL, 1, pixel)
    scene = cells(0.6 * min(SMALL) * pixel)
    frame = next(simulated_frames(scene, taken)).astype(np.float64)
    same, finer = (
        hs.model.measure(scene, taken, n, torch.float64)[0].numpy() for n in (Simulation().samples(taken), FINER)
    )
    contrast = float(np.linalg.norm(finer - 1))
    errors = {"method": np.linalg.norm(frame - finer), "single_precision": np.linalg.norm(frame - same)}
    return {"pixel": pixel, **{name: float(error) / contrast for name, error in errors.items()}}


def projection(samples: int, pixel: float) -> dict[str, float]:
    """Seconds of the kernel and of its twin, and their largest difference over the largest number."""
    views, scene = exposures(SMALL, 12, pixel).views.refined(samples), cells(0.6 * min(SMALL) * pixel)
    seconds, found = {}, {}
    for _ in range(3):
        for backend in ("cpu", "reference"):
            began = time.perf_counter()
            found[backend] = scene.on(backend).project(views)[0]
            seconds[backend] = min(time.perf_counter() - began, seconds.get(backend, np.inf))
    apart = float((found["cpu"] - found["reference"]).abs().max() / found["reference"].abs().max())
    return {"samples": samples, **seconds, "apart": apart}


def table(report: dict[str, Any]) -> str:
    """The rows as Markdown, and where they were measured."""
    lines = ["| case | pixels | frames | samples a pixel | time / s | time of all cores / s | peak memory / MB |"]
    lines.append("|" + " --- |" * 7)
    for row in report["rows"]:
        dimension = "²" if row["frames"] else "³"
        lines.append(
            f"| {row['case']} | {row['size']}{dimension} of {1e6 * row['pixel']:g} µm | {row['frames'] or '–'} "
            f"| {row['samples'] if row['frames'] else '–'} | {row['seconds']:.1f} | {row['cpu_seconds']:.1f} "
            f"| {row['peak_mb']:.0f} (+{row['added_mb']:.0f}) |"
        )
    lines += [
        "",
        "| pixel | error against 10 times finer waves and rays | of which single precision |",
        "| --- | --- | --- |",
    ]
    for row in report["accuracy"]:
        lines.append(f"| {1e6 * row['pixel']:g} µm | {row['method']:.1e} | {row['single_precision']:.0e} |")
    lines += ["", "| samples a pixel | C++ / s | plain torch / s | times faster | difference |", "|" + " --- |" * 5]
    for row in report["projection"]:
        times = row["reference"] / row["cpu"]
        lines.append(
            f"| {row['samples']} | {row['cpu']:.3f} | {row['reference']:.3f} | {times:.1f} | {row['apart']:.0e} |"
        )
    machine = report["machine"]
    load = f"load {report['load']:.1f} when it began"
    lines += ["", f"{machine['processor']}, {machine['threads']}, {load}, torch {report['versions']['torch']}, "
              f"seed {SEED}, commit {report['commit']}"]  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    """Run all cases and print their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--case", choices=tuple(CASES), help="run this one here, and print it as JSON")
    options = parser.parse_args()
    if options.case:
        print(json.dumps(run(options.case)))
        return
    report: dict[str, Any] = {"commit": commit(), "load": os.getloadavg()[0], **environment("reference"), "rows": []}
    for name in CASES:
        done = subprocess.run([sys.executable, __file__, "--case", name], capture_output=True, text=True, check=True)
        report["rows"].append(json.loads(done.stdout))
    report["projection"] = [projection(samples, 0.5e-6) for samples in FINE]
    report["accuracy"] = [accuracy(pixel) for pixel in (0.5e-6, 1e-6)]
    print(json.dumps(report, indent=2) if options.json else table(report))


if __name__ == "__main__":
    main()
