"""Surfaces against the Gaussians that they are cut out of, on scenes of the benchmark that no setting was chosen on.

    python benchmarks/surfaces.py --json > surfaces.json              # four cases, seeds 101 and 102
    python benchmarks/surfaces.py --cases main4 noise12-2000 --seeds 101 --variants --runs RUNS

Settings were chosen on seed 1. `--runs` keeps scans, truths and runs by Gaussians in a folder, and uses those that are
there. Seconds are CPU time of the step alone, all threads together, so that they do not depend on who else uses the
machine; those of the Gaussians are in docs/notebook/results.md.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch
from changes import changed
from machine import commit

import holosplat as hs
from holosplat.io.atomic import write_json
from holosplat.methods import Extraction, SurfaceFit, SurfaceOptions, finished
from holosplat.methods.surface_fit import extract_surfaces, oversampling, surface_fit
from holosplat.representations import GaussianCloud, SurfaceMesh
from holosplat.workflows.evaluate import Scores, score_object
from holosplat.workflows.provenance import environment
from holosplat_bench.suite.case import load_case

CASES = ("main12", "main4", "noise12-2000", "shells8")
VARIANTS: dict[str, dict[str, Any]] = {
    "as they are": {},
    "triangles of 1.5 px": {"spacing": 1.5},
    "waves as coarse as the Gaussians'": {"coarser": 1},
    "no smoothness": {"curvature": 0.0},
    "four times as smooth": {"curvature": 12.0},
    "plain L1": {"rounding": 0.0},
    "no membrane": {"stiffness": 0.0},
    "40 steps": {"steps": 40},
    "rate 0.4 px": {"rate": 0.4},
}
"""What is changed, one thing at a time, in options of the extraction or the fit."""


def prepared(name: str, seed: int, runs: Path) -> tuple[hs.Scan, hs.Volume, GaussianCloud, int]:
    """Scan, truth, Gaussians and the wave samples per pixel that these were fitted with, from `runs` or made there."""
    folder = runs / f"{name}_{seed}"
    scan, truth, run = folder / "scan.nxs", folder / "truth.h5", hs.RunFolder(folder / "run")
    if not run.summary.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        case = load_case(name, seed)
        measured = case.scan()
        hs.io.write_scan(scan, measured)
        hs.io.write_volume(truth, case.truth())
        hs.reconstruct(measured, case.prior, hs.preset("default"), seed, folder=run)
        write_json(run.source, {"scan": str(scan.resolve()), "time_frame": None})  # for those who read the run later
    found = hs.load_reconstruction(run)
    assert isinstance(found.object, GaussianCloud)
    return hs.io.read_scan(scan), hs.io.read_volume(truth), found.object, found.oversample


def fitted_surfaces(scan: hs.Scan, start: SurfaceMesh, options: SurfaceFit) -> SurfaceMesh:
    """The surfaces that a fit from `start` ends with."""
    fit = surface_fit(scan, start, options)
    fit.run(lambda record: None)
    found = finished(fit)
    assert isinstance(found, SurfaceMesh)
    return found


def measured(name: str, seed: int, runs: Path) -> list[dict[str, Any]]:
    """One row each for the Gaussians, for the surfaces cut out of them, and for these after the fit."""
    scan, truth, cloud, sampled = prepared(name, seed, runs)
    options = SurfaceOptions()
    sampling = oversampling(scan.train(), options.fit)
    rows = [
        row("Gaussians", score_object(cloud, scan, truth, sampled), 0.0),
        row("Gaussians, finer waves", score_object(cloud, scan, truth, sampling), 0.0),
    ]
    began = time.process_time()
    start = extract_surfaces(cloud, scan, options.extraction)
    cut = time.process_time() - began
    rows.append(row("marching cubes", score_object(start, scan, truth, sampling), cut) | sizes(start))
    began = time.process_time()
    found = fitted_surfaces(scan, start, options.fit)
    fitted = time.process_time() - began
    rows.append(row("surfaces", score_object(found, scan, truth, sampling), fitted) | sizes(found))
    return [{"case": name, "seed": seed, **r} for r in rows]


def variants(name: str, seed: int, runs: Path) -> list[dict[str, Any]]:
    """One row for each of `VARIANTS`, judged with the same waves."""
    scan, truth, cloud, _ = prepared(name, seed, runs)
    sampling = oversampling(scan.train())
    rows = []
    for called, every in VARIANTS.items():
        changes = dict(every)
        spacing, coarser = changes.pop("spacing", 1.0), changes.pop("coarser", 0)
        fit = changed(SurfaceFit(), {"oversample": sampling - coarser, **changes})
        start = extract_surfaces(cloud, scan, Extraction(spacing=spacing))
        began = time.process_time()
        found = fitted_surfaces(scan, start, fit)
        seconds = time.process_time() - began
        scores = score_object(found, scan, truth, sampling)
        rows.append({"case": name, "seed": seed, **row(called, scores, seconds)})
    return rows


def row(method: str, scores: Scores, seconds: float) -> dict[str, Any]:
    """The numbers of one method."""
    assert scores.train is not None
    return {"method": method, "seconds": seconds, **scores.headline(), "train_ssim": scores.train.mean["ssim"]}


def sizes(surfaces: SurfaceMesh) -> dict[str, Any]:
    """What the surfaces are made of."""
    return {"triangles": len(surfaces.faces), "bodies": len(surfaces.bodies()), "stored_bytes": surfaces.stored_bytes}


def table(report: dict[str, Any]) -> str:
    """The rows as Markdown."""
    lines = ["| case, seed | method | SSIM | FRCM | Dice | error of δ | mean δ | s |", "|" + " --- |" * 8]
    for r in report["rows"]:
        deviation = 100 * (r["mean_delta"] / r["true_mean_delta"] - 1)
        seconds = f"{r['seconds']:.0f}" if r["seconds"] else ""
        lines.append(
            f"| {r['case']}, {r['seed']} | {r['method']} | {r['ssim']:.4f} | {r['frcm']:.4f} | {r['dice']:.4f} "
            f"| {r['relative_error_delta']:.4f} | {deviation:+.2f} % | {seconds} |"
        )
    machine = report["machine"]
    measured_on = f"{machine['processor']}, torch {report['versions']['torch']}"
    return "\n".join([*lines, "", f"Measured on {measured_on}; commit {report['commit']}."])


def main() -> None:
    """Run the cases and print their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=list(CASES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102])
    parser.add_argument("--runs", type=Path)
    parser.add_argument("--variants", action="store_true", help="change one setting at a time")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    with tempfile.TemporaryDirectory() as scratch:
        runs = options.runs or Path(scratch)
        measure = variants if options.variants else measured
        rows = [r for name in options.cases for seed in options.seeds for r in measure(name, seed, runs)]
    report = {"commit": commit(), **environment("cpu"), "rows": rows}
    print(json.dumps(report, indent=2) if options.json else table(report))


if __name__ == "__main__":
    main()
