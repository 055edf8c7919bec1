"""Scans that turn in other ways than in a plane, beside planar ones: rows of docs/data/turning.csv.

    python benchmarks/turning.py            # ten minutes on one core; rows that are there are not made again

Cells of water at 20 keV and 0.05 m, on pixels of 1 µm, with 3000 photons a pixel: `helix` has 48 frames of 40 rows over
540 degrees, in which the object moves by 60 rows, beside a planar scan of 19 views of 100 rows, as many photons in all;
`laminography` has 24 views of 48 × 64 pixels about an axis that leans by 30 degrees, beside one that does not; of
`planar, odd` there are 23, no two of them opposite. Errors of the helix are of the 60 rows that half a turn sees.
`aligned_px` is what is left of random shifts of one pixel (rms) after `align`, with 20,000 photons, without what moves
the object; lost views, more than 2 pixels off, count in `lost`.
Meshes are simulated exactly, which no reconstruction does.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from machine import commit
from rows import machine, read, replaced, shown
from scipy.spatial.transform import Rotation

import holosplat as hs
from holosplat.geometry import Grid, Views, rotation_y
from holosplat.io.larger_frames import heightened
from holosplat.methods import METHODS
from holosplat.metrics import volume_scores

PAGE = Path(__file__).resolve().parents[1] / "docs/data/turning.csv"
PIXEL, LEANS = 1e-6, 30.0
KINDS = ("helix", "planar, tall", "laminography", "planar", "planar, odd")


@dataclass(frozen=True)
class Row:
    """error, dice: of δ; lost: views; seconds: of the processor, of the reconstruction."""

    kind: str
    method: str
    seed: int
    error: float
    dice: float
    aligned_px: float
    lost: int
    seconds: float
    machine: str
    commit: str


def views_of(kind: str) -> Views:
    """The views of a kind of scan."""
    if kind == "planar, tall":
        return Views.evenly_spaced(19, (100, 48), PIXEL)
    if kind == "helix":
        part = np.linspace(0, 1, 48)
        rows = np.round(60 * (part - 0.5)) * PIXEL
        return replace(Views.from_angles(540 * part, (40, 48), PIXEL), shifts=np.stack([0 * rows, rows], 1))
    lean = Rotation.from_euler("x", LEANS if kind == "laminography" else 0.0, degrees=True).as_matrix()
    count = 23 if kind == "planar, odd" else 24
    return Views.from_rotations(lean @ rotation_y(np.arange(count) * 360.0 / count), (48, 64), PIXEL)


def run(kind: str, method: str, seed: int) -> Row:
    """One scan, reconstructed, and aligned where the method is the default."""
    water, views = hs.materials.parse_material("water").delta_beta(20.0), views_of(kind)
    tall = kind in KINDS[:2]
    box = (30e-6, 90e-6, 30e-6) if tall else (36e-6, 20e-6, 36e-6)
    cells = hs.specimens.random_cells(10 if tall else 6, box=box, seed=seed)
    scene, prior = hs.MeshScene.of_one_material(cells, water), hs.MaterialPrior.known(water)
    grid = Grid.centred((48, 60, 48) if tall else (64, 48, 64), PIXEL)

    def scan_of(seen: Views, photons: float) -> hs.Scan:
        exposures = hs.Exposures.of(seen, 20.0, 0.05)
        nothing = np.zeros(len(seen), dtype=bool)
        return hs.simulate(scene, exposures, photons_per_pixel=photons, seed=seed, is_test=nothing)

    began = time.process_time()
    found = hs.reconstruct(heightened(scan_of(views, 3000)), prior, METHODS[method], seed)
    seconds = time.process_time() - began
    scores = volume_scores(found.object.voxelise(grid), scene.voxelise(grid))
    away = PIXEL * np.random.default_rng(seed).normal(size=(len(views), 2))
    left, lost = np.nan, 0
    if method == "auto":
        moved = scan_of(replace(views, shifts=views.shifts + away), 20_000)
        said = heightened(moved.taken(replace(moved.exposures, views=views)))
        off = hs.align_views(said, prior).exposures.views.shifts - said.views.shifts - away
        near, gauge = np.abs(off).max(1) < 2 * PIXEL, views.rotations[:, :2]
        move = np.linalg.lstsq(gauge[near].reshape(-1, 3), off[near].reshape(-1), rcond=None)[0]
        left, lost = float((off - gauge @ move)[near].std() / PIXEL), int((~near).sum())
    numbers = (scores.relative_error_delta, scores.dice, left)
    return Row(kind, method, seed, *numbers, lost, round(seconds, 1), machine(), commit())


def main() -> None:
    """Make the rows that are not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=PAGE)
    parser.add_argument("--seeds", nargs="+", type=int, default=[101, 102])
    options = parser.parse_args()
    torch.set_num_threads(1)
    for seed, kind, method in product(options.seeds, KINDS, ("auto", "tikhonov-tv")):
        there = {(row["kind"], row["method"], row["seed"]) for row in read(options.out)}
        if (kind, method, str(seed)) not in there:
            row = run(kind, method, seed)
            replaced(options.out, row, key=3)
            shown(row)


if __name__ == "__main__":
    main()
