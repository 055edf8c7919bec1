"""How well a nearly round cell, a pure phase object of 3 rad, is reconstructed: docs/data/round_cell.csv.

    python benchmarks/round_cell.py --out docs/data/round_cell.csv          # some minutes on one core
    python benchmarks/round_cell.py --cases "4 views" --seeds 3

`reconstruct` without options, told a ratio δ/β that leaves next to no absorption, or nothing. Held-out views have no
noise. A row: errors of the held-out phase and of δ, relative (‖found − true‖/‖true‖), those of the held-out frames over
their contrast, and the mass that was found over the true one. Lines of the truth are closed forms.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit
from rows import written

import holosplat as hs
from holosplat.model import measure
from holosplat_bench.specimens.soft_matter import round_cell

PIXEL, ENERGY, RATIO, TEST = 1e-6, 20.0, 1e5, 3
MATERIAL = hs.DeltaBeta(6.8e-7, 6.8e-12)
COLUMNS: tuple[str, ...] = (
    "case",
    "seed",
    "told",
    "phase",
    "frames",
    "error_delta",
    "mass",
    "kept",
    "seconds",
    "machine",
    "commit",
)


@dataclass(frozen=True)
class Experiment:
    """views: for training; photons: a pixel, None for no noise; shape: of the frames; distance [m]."""

    views: int
    photons: float | None = None
    shape: tuple[int, int] = (64, 64)
    distance: float = 0.05

    def scan(self, truth: hs.volume.Object, seed: int) -> hs.Scan:
        """Frames evenly over half a turn, those held out between two of the others and without noise."""
        train = np.arange(self.views) * 180.0 / self.views
        angles = np.concatenate([train, train[:: max(1, self.views // TEST)][:TEST] + 90.0 / self.views])
        is_test = np.arange(len(angles)) >= self.views
        order = np.argsort(angles)
        views = hs.Views.from_angles(angles[order], self.shape, PIXEL)
        exposures = hs.Exposures.of(views, ENERGY, self.distance, 0.3)
        clean = hs.simulate(truth, exposures, is_test=is_test[order])
        frames = clean.frames.copy()
        if self.photons is not None:
            noise, seen = np.random.default_rng(seed), ~clean.is_test
            frames[seen] = noise.poisson(frames[seen] * self.photons) / self.photons
        return hs.Scan(frames.astype(np.float32), exposures, clean.is_test)


CASES = {
    "12 views": Experiment(12),
    "12 views, 51 × 63 pixels": Experiment(12, shape=(51, 63), distance=0.03),
    "4 views": Experiment(4),
    "12 views, 2000 photons": Experiment(12, 2000.0),
    "4 views, 2000 photons": Experiment(4, 2000.0),
}


def row(name: str, seed: int, told: str) -> dict[str, str]:
    """A row of the table."""
    case = CASES[name]
    truth = round_cell(0.72 * min(case.shape) * PIXEL, MATERIAL, seed)
    scan = case.scan(truth, seed)
    prior = hs.MaterialPrior.unknown() if told == "nothing" else hs.MaterialPrior.of_ratio(RATIO)
    began = time.process_time()
    done = hs.reconstruct(scan, prior)
    seconds = time.process_time() - began
    test = scan.exposures[np.flatnonzero(scan.is_test)]
    grid = hs.Grid.of_views(scan.views)
    found, true = (np.asarray(each.voxelise(grid).delta, dtype=np.float64) for each in (done.object, truth))
    phases = [each.project(test.views)[1].detach().numpy() for each in (done.object, truth)]
    frames = scan.frames[scan.is_test]
    predicted = measure(done.object, test, done.oversample).detach().numpy()
    values = {
        "phase": _relative(*(np.asarray(p, dtype=np.float64) for p in phases)),
        "frames": float(np.sqrt(np.square(predicted - frames).mean()) / frames.std()),
        "error_delta": _relative(found, true),
        "mass": float(found.sum() / true.sum()),
    }
    said = {"case": name, "seed": str(seed), "told": told, "kept": f"{done.object.kind}, {done.choice.kept}"}
    numbers = {key: f"{value:.4f}" for key, value in values.items()}
    return said | numbers | {"seconds": f"{seconds:.0f}", "machine": platform.machine(), "commit": commit()}


def _relative(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


def main() -> None:
    """Write the table, line by line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=list(CASES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--told", nargs="+", default=["ratio", "nothing"])
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    wanted = product(options.cases, options.seeds, options.told)
    written(options.out, COLUMNS, (row(*each) for each in wanted))


if __name__ == "__main__":
    main()
