"""What is lost where matter goes on above and below the frames: docs/data/cut_frames.csv.

    python benchmarks/cut_frames.py --out docs/data/cut_frames.csv          # some minutes on one core

Frames of a whole body are simulated, and only their middle rows are reconstructed: by `auto`, without options but the
ratio δ/β, or by another method for continuous matter ("in the field": a smooth volume that ends with the frames).
A row: relative error of δ in the field of view, in its middle half and in its two outermost rows on either side, the
mass that was found over the true one there, and whether the verdict is good. Lines of the truth are closed forms.
"""

from __future__ import annotations

import argparse
import os
import platform
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit
from rows import written

import holosplat as hs
from holosplat_bench.specimens.soft_matter import round_cell, tissue

PIXEL, ENERGY, VIEWS, SEED = 1e-6, 20.0, 12, 3
SOFT, DARK = hs.DeltaBeta(3e-7, 2e-10), hs.DeltaBeta(1e-6, 1e-8)
"""Matter that fringes show, and matter that shows in contact."""
COLUMNS: tuple[str, ...] = ("body", "seed", "rows", "of", "distance_m", "photons", "method")
COLUMNS += ("error_delta", "middle", "edge", "mass", "good", "machine", "commit")
CASES = {
    "round cell, whole": ("round cell", 120, 0.05, None, "auto"),
    "round cell": ("round cell", 40, 0.05, None, "auto"),
    "round cell, in the field": ("round cell", 40, 0.05, None, "in the field"),
    "round cell, gaussians": ("round cell", 40, 0.05, None, "gaussians"),
    "round cell, 5000 photons": ("round cell", 40, 0.05, 5000.0, "auto"),
    "round cell, 5000 photons, in the field": ("round cell", 40, 0.05, 5000.0, "in the field"),
    "round cell, contact": ("round cell", 40, 0.0, 20_000.0, "auto"),
    "tissue": ("tissue", 60, 0.05, None, "auto"),
    "tissue, in the field": ("tissue", 60, 0.05, None, "in the field"),
}
SMOOTH = hs.methods.SmoothVolume()
METHODS = {**hs.methods.METHODS, "in the field": replace(SMOOTH, volume=replace(SMOOTH.volume, beyond=False))}
"""The program's, and a smooth volume that ends with the frames."""


def body(name: str, material: hs.DeltaBeta) -> tuple[hs.volume.Object, tuple[int, int]]:
    """The body, and the frames that hold all of it."""
    if name == "tissue":
        return tissue((80e-6, 200e-6, 80e-6), material, SEED), (220, 120)
    return round_cell(88e-6, material, SEED), (120, 120)


def row(name: str, rows: int, distance: float, photons: float | None, method: str) -> dict[str, str]:
    """A row of the table."""
    material = SOFT if distance else DARK
    truth, (height, width) = body(name, material)
    views = hs.Views.evenly_spaced(VIEWS, (height, width), PIXEL)
    exposures = hs.Exposures.of(views, ENERGY, distance, 0.3)
    whole = hs.simulate(truth, exposures, is_test=np.arange(VIEWS) % 4 == 3, photons_per_pixel=photons, seed=SEED)
    top = (height - rows) // 2
    scan = whole.cropped(slice(top, top + rows), slice(0, width))
    matter = None if method == "auto" else "continuous"
    done = hs.reconstruct(scan, hs.MaterialPrior.of_ratio(material.ratio), METHODS[method], matter=matter)
    grid = hs.Grid.of_views(scan.views)
    found, true = (np.asarray(each.voxelise(grid).delta, dtype=np.float64) for each in (done.object, truth))

    def error(at: slice | list[int]) -> str:
        size = np.linalg.norm(true[:, at])
        return f"{np.linalg.norm(found[:, at] - true[:, at]) / size:.3f}" if size > 0 else ""

    parts = (slice(None), slice(rows // 4, rows - rows // 4), [0, 1, -2, -1])
    measured = dict(zip(("error_delta", "middle", "edge"), map(error, parts)))
    said = {"body": name, "seed": str(SEED), "rows": str(rows), "of": str(height), "distance_m": f"{distance:g}"}
    said |= {"photons": f"{photons or 0:g}", "method": method, "mass": f"{found.sum() / true.sum():.3f}"}
    good = str(done.verdict.good) if done.verdict else ""
    return said | measured | {"good": good, "machine": platform.machine(), "commit": commit()}


def main() -> None:
    """Write the table, line by line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    written(options.out, COLUMNS, (row(*CASES[name]) for name in options.cases))


if __name__ == "__main__":
    main()
