"""The main job, measured: simulate, reconstruct, judge, on scenes that no setting was chosen on.

    python benchmarks/main_job.py --json                                  # 24 generated cells, seeds 101, 102, 103
    python benchmarks/main_job.py --preset auto --csv docs/data/main_job_idle.csv    # as reconstruct does it unasked
    python benchmarks/main_job.py --preset auto --cases cells free --seeds 101 --csv docs/data/main_job_decisions.csv
    python benchmarks/main_job.py --cases ratio free poses noise nine plasma --surfaces     # harder ones, and surfaces
    python benchmarks/main_job.py --cases snapshot --meshes DIR/rbc*_049.vtk
    OMP_NUM_THREADS=1 python benchmarks/main_job.py --cases cells nine --surfaces --csv docs/data/main_job.csv

Settings were chosen on other scenes (seeds below 100). Prints one JSON object, or a Markdown table; `--csv` adds each
row to a file as it comes, and leaves out what the file has.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit
from rows import read, write
from scipy.spatial.transform import Rotation

import holosplat as hs
from holosplat.methods import METHODS
from holosplat.methods.surface_fit import oversampling
from holosplat.workflows.evaluate import Scores, score_object
from holosplat.workflows.provenance import environment
from holosplat_bench.suite.case import Between

HAEMOGLOBIN = hs.materials.HAEMOGLOBIN.delta_beta(20.0)


@dataclass(frozen=True)
class Case:
    """A scene, how it is measured, and what the reconstruction is told of its material; is_test: [N] bool, frames held
    out, every fourth by default, which are free of noise if `clean_test`."""

    scene: hs.MeshScene
    exposures: hs.Exposures
    prior: hs.MaterialPrior
    photons: float | None = None
    is_test: np.ndarray | None = None
    clean_test: bool = False

    def scan(self, seed: int) -> hs.Scan:
        """The measured frames."""
        scan = hs.simulate(self.scene, self.exposures, photons_per_pixel=self.photons, seed=seed, is_test=self.is_test)
        if not self.clean_test:
            return scan
        clean = hs.simulate(self.scene, self.exposures, is_test=self.is_test)
        return replace(scan, frames=np.where(scan.is_test[:, None, None], clean.frames, scan.frames))


def cells(seed: int, prior: hs.MaterialPrior | None = None, photons: float | None = None) -> Case:
    """24 cells of 20 px diameter, 128 × 128 px of 3.2 µm, 20 keV, 10 cm, 16 views, PSF 0.05 px, haemoglobin."""
    pixel = 3.2e-6
    meshes = hs.specimens.random_cells(24, (128 * pixel,) * 3, seed, 20 * pixel)
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(16, (128, 128), pixel), 20.0, 0.1, 0.05)
    known = hs.MaterialPrior.known(HAEMOGLOBIN)
    return Case(hs.MeshScene.of_one_material(meshes, HAEMOGLOBIN), exposures, prior or known, photons)


def nine(seed: int) -> Case:
    """The same from 9 views blurred by 0.7 px, 2000 photons a pixel, judged by 3 noise-free views between them."""
    case = cells(seed)
    rotations, is_test = Between(9, 3).poses()
    views = hs.Views.from_rotations(rotations, (128, 128), 3.2e-6)
    return Case(case.scene, hs.Exposures.of(views, 20.0, 0.1, 0.7), case.prior, 2000.0, is_test, clean_test=True)


def poses(seed: int) -> Case:
    """The same from 10 random orientations (8 for the fit), no two axes alike."""
    case = cells(seed)
    rotations = Rotation.random(10, rng=seed).as_matrix()
    views = hs.Views.from_rotations(rotations, (128, 128), 3.2e-6)
    return Case(case.scene, hs.Exposures.of(views, 20.0, 0.1, 0.05), case.prior)


def plasma(seed: int) -> Case:
    """40 red cells in plasma, 96 × 96 px of 1 µm, 10 keV, 50 cm, 16 views, 1e5 photons a pixel; Δβ is negative."""
    contrast = hs.materials.RED_CELL.delta_beta(10.0).against(hs.materials.PLASMA.delta_beta(10.0))
    scene = hs.MeshScene.of_one_material(hs.specimens.random_cells(40, (96e-6,) * 3, seed, 7.8e-6), contrast)
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(16, (96, 96), 1e-6), 10.0, 0.5)
    return Case(scene, exposures, hs.MaterialPrior.known(contrast), 1e5)


def snapshot(meshes: list[Path]) -> Case:
    """A snapshot of cells in µm, 128 × 192 px of 0.5 µm, 20 keV, 10 cm, 16 views, haemoglobin."""
    scene = hs.beamline.read_scene(sorted(meshes), hs.beamline.Filling(), 20.0)
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(16, (128, 192), 0.5e-6), 20.0, 0.1)
    return Case(scene, exposures, hs.MaterialPrior.known(HAEMOGLOBIN))


CASES: dict[str, Callable[[int], Case]] = {
    "cells": cells,
    "ratio": lambda seed: cells(seed, hs.MaterialPrior.of_ratio(HAEMOGLOBIN.ratio)),
    "free": lambda seed: cells(seed, hs.MaterialPrior.unknown()),
    "noise": lambda seed: cells(seed, photons=2000.0),
    "nine": nine,
    "poses": poses,
    "plasma": plasma,
}


AS_ASKED = "auto"
"""What `holosplat reconstruct` does without a method: here surfaces, at once."""


def run(case: Case, preset: str, seed: int, surfaces: bool = False) -> list[dict[str, Any]]:
    """Simulate, reconstruct and score one case; with `surfaces`, a second row for those fitted from the Gaussians.

    preset: of Gaussians, or `AS_ASKED`.
    """
    scan = case.scan(seed)
    truth = case.scene.voxelise(hs.Grid.of_views(case.exposures.views))
    began, cpu = time.perf_counter(), time.process_time()
    result = hs.reconstruct(scan, case.prior, METHODS[AS_ASKED] if preset == AS_ASKED else hs.preset(preset), seed)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - cpu
    clouds = isinstance(result.object, hs.representations.GaussianCloud)
    assert clouds or isinstance(result.object, hs.representations.SurfaceMesh)
    scores = hs.evaluate(result, scan, truth)
    material = scores.as_dict()["material"]
    rows = [
        {
            "method": "gaussians" if clouds else "surfaces",
            "seconds": seconds,
            "cpu_seconds": cpu_seconds,
            **{f"{stage}_seconds": value for stage, value in result.timing.items()},
            "gaussians": len(result.object) if clouds else 0,
            **numbers(scores, material),
        }
    ]
    if surfaces and clouds:
        began, cpu = time.perf_counter(), time.process_time()
        found = hs.methods.refine_surfaces(result.object, scan)
        seconds += time.perf_counter() - began
        cpu_seconds += time.process_time() - cpu
        refined = score_object(found, scan, truth, oversampling(scan.train()))
        times = {"seconds": seconds, "cpu_seconds": cpu_seconds}
        rows.append({"method": "surfaces", **times, "gaussians": 0, **numbers(refined, material)})
    return [{"seed": seed, "preset": preset, **row} for row in rows]


def numbers(scores: Scores, material: dict[str, Any]) -> dict[str, Any]:
    """What a row says of a result."""
    assert scores.train is not None
    train = {f"train_{name}": scores.train.mean[name] for name in ("ssim", "frcm")}
    return {**scores.headline(), **train, "material": material}


def main() -> None:
    """Run the cases and print their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=(*CASES, "snapshot"), default=["cells"])
    parser.add_argument("--meshes", type=Path, nargs="*", default=[])
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102, 103])
    parser.add_argument("--preset", default="default", help=f"of Gaussians, or {AS_ASKED}: as reconstruct chooses")
    parser.add_argument("--surfaces", action="store_true", help="also fit surfaces; times are those of both together")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--csv", type=Path, help="add rows to this file, but for those that it has")
    options = parser.parse_args()
    if "snapshot" in options.cases and not options.meshes:
        parser.error("the case snapshot needs --meshes")
    rows: list[dict[str, Any]] = []
    kept = read(options.csv) if options.csv else []
    for name in options.cases:
        for seed in [0] if name == "snapshot" else options.seeds:
            if any((r["case"], r["seed"], r["preset"]) == (name, str(seed), options.preset) for r in kept):
                continue
            case = snapshot(options.meshes) if name == "snapshot" else CASES[name](seed)
            rows += [{"case": name, **row} for row in run(case, options.preset, seed, options.surfaces)]
            if options.csv:
                write(kept + [flat(row) for row in rows], options.csv, COLUMNS)
    report = {"commit": commit(), **environment("cpu"), "rows": rows}
    print(json.dumps(report, indent=2) if options.json else table(report))


COLUMNS = (
    "case",
    "seed",
    "preset",
    "method",
    "ssim",
    "frcm",
    "psnr",
    "l1",
    "dice",
    "relative_error_delta",
    "mean_delta",
)
COLUMNS += ("true_mean_delta", "delta", "ratio", "single_material", "gaussians", "seconds", "cpu_seconds", "threads")
COLUMNS += ("commit",)


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """A row as the file has it."""
    said = row | row["material"] | {"threads": torch.get_num_threads(), "commit": commit()}
    return {name: f"{said[name]:.6g}" if isinstance(said[name], float) else said[name] for name in COLUMNS}


def table(report: dict[str, Any]) -> str:
    """The rows as Markdown, and where they were measured."""
    head = "| case, seed | SSIM | FRCM | PSNR / dB | Dice | mean δ | error of δ | δ/β | Gaussians | time / s |"
    lines = [head, "|" + " --- |" * 10]
    for row in report["rows"]:
        deviation = 100 * (row["mean_delta"] / row["true_mean_delta"] - 1)
        found = row["material"]
        called = f"{row['case']}, {row['seed']}" + (", surfaces" if row["method"] == "surfaces" else "")
        ratio = f"{found['ratio']:.0f}" + ("" if found["single_material"] else " (found)")
        lines.append(
            f"| {called} | {row['ssim']:.3f} | {row['frcm']:.3f} | {row['psnr']:.1f} "
            f"| {row['dice']:.3f} | {deviation:+.1f} % | {row['relative_error_delta']:.3f} | {ratio} "
            f"| {row['gaussians'] or '–'} | {row['seconds']:.0f} |"
        )
    machine = report["machine"]
    measured = f"{machine['processor']}, {machine['threads']}, torch {report['versions']['torch']}"
    return "\n".join([*lines, "", f"Measured on {measured}; commit {report['commit']}."])


if __name__ == "__main__":
    main()
