"""The main job, measured: simulate, reconstruct, judge, on scenes that no setting was chosen on.

    python benchmarks/main_job.py --json                      # 24 generated cells, seeds 101, 102, 103
    python benchmarks/main_job.py --case snapshot --meshes DIR/rbc*_049.vtk --json

Settings were chosen on other scenes (seeds below 100). Prints one JSON object; without --json a Markdown table.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np

import holosplat as hs
from holosplat.experiments.run_folder import environment


def generated_cells(seed: int) -> tuple[hs.MeshScene, hs.Exposures]:
    """24 cells of 20 px diameter, 128 × 128 px of 3.2 µm, 20 keV, 10 cm, 16 views, PSF 0.05 px, haemoglobin."""
    pixel = 3.2e-6
    cells = hs.random_cells(24, (128 * pixel,) * 3, seed, 20 * pixel)
    views = hs.Views.evenly_spaced(16, (128, 128), pixel)
    scene = hs.MeshScene.of_one_material(cells, hs.HAEMOGLOBIN.delta_beta(20.0))
    return scene, hs.Exposures.of(views, 20.0, 0.1, 0.05)


def snapshot(meshes: list[Path]) -> tuple[hs.MeshScene, hs.Exposures]:
    """A snapshot of cells in µm, 128 × 192 px of 0.5 µm, 20 keV, 10 cm, 16 views, haemoglobin."""
    scene = hs.read_scene(sorted(meshes), hs.Filling(), 20.0)
    return scene, hs.Exposures.of(hs.Views.evenly_spaced(16, (128, 192), 0.5e-6), 20.0, 0.1)


def run(scene: hs.MeshScene, exposures: hs.Exposures, preset: str, seed: int) -> dict[str, Any]:
    """Simulate, reconstruct and score one scene."""
    scan, truth = hs.simulate(scene, exposures), scene.voxelise(hs.Grid.of_views(exposures.views))
    began = time.perf_counter()
    result = hs.reconstruct(scan, hs.MaterialPrior.known(scene.materials[0]), hs.preset(preset), seed)
    seconds = time.perf_counter() - began
    scores = hs.evaluate(result, scan, truth)
    assert scores.train is not None
    return {
        "preset": preset,
        "seconds": seconds,
        **{f"{stage}_seconds": value for stage, value in result.timing.items()},
        "gaussians": len(result.cloud),
        **scores.headline(),
        "train_ssim": scores.train.mean["ssim"],
        "train_frcm": scores.train.mean["frcm"],
    }


def commit() -> str:
    """The commit that is measured, with a mark if the tree was changed."""
    shown = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=False)
    return shown.stdout.strip() or "unknown"


def main() -> None:
    """Run the cases and print their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", choices=("cells", "snapshot"), default="cells")
    parser.add_argument("--meshes", type=Path, nargs="*", default=[])
    parser.add_argument("--seeds", type=int, nargs="*", default=[101, 102, 103])
    parser.add_argument("--presets", nargs="*", default=["default"])
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = []
    for preset in options.presets:
        if options.case == "snapshot":
            rows.append({"scene": "snapshot", **run(*snapshot(options.meshes), preset, 0)})
        else:
            rows += [{"scene": f"seed {s}", **run(*generated_cells(s), preset, s)} for s in options.seeds]
    report = {"commit": commit(), **environment(), "case": options.case, "rows": rows}
    print(json.dumps(report, indent=2) if options.json else table(rows))


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    names = ("ssim", "frcm", "psnr", "dice", "relative_error_delta", "seconds", "gaussians")
    head = "| scene | preset | SSIM | FRCM | PSNR / dB | Dice | mean δ | error of δ | time / s | Gaussians |"
    lines = [head, "|" + " --- |" * 10]
    for row in rows:
        deviation = 100 * (row["mean_delta"] / row["true_mean_delta"] - 1)
        cells = [f"{row[n]:.4g}" if np.isfinite(row[n]) else "∞" for n in names]
        cells.insert(4, f"{deviation:+.1f} %")
        lines.append(f"| {row['scene']} | {row['preset']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
