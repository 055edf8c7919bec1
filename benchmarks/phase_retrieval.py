"""Errors and times of phase retrieval, method by method: the table of docs/notebook/phase_retrieval.md.

    python benchmarks/phase_retrieval.py [--views 4] [--seeds 1 2]

Red cells of haemoglobin or in plasma, simulated in float64 from meshes; the error is that of the thickness, root mean
square over that of the thickness itself, averaged over views. Seconds are the processor's, for 12 views; run it with
one thread (OMP_NUM_THREADS=1). Seeds below 100 are those that the defaults were chosen on.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from holosplat import Exposures, MeshScene, Views, simulate
from holosplat.materials import HAEMOGLOBIN, PLASMA, RED_CELL
from holosplat.optics.propagation import bin_pixels, poisson
from holosplat.optics.retrieval import RETRIEVALS, Linear, paganin
from holosplat.specimens import random_cells

SIDE = 128
PIXEL, PSF = {"holographic": 0.5e-6, "blurred": 0.5e-6, "strong": 3.2e-6, "plasma": 1e-6}, {"blurred": 0.7}
"""Pixel [m] and standard deviation of the point-spread function [px] of each regime."""


def scene(regime: str, seed: int, views: int) -> tuple[Exposures, MeshScene, torch.Tensor]:
    """Exposures, cells, and their thickness [V, H, W] in metres."""
    plasma, pixel = regime == "plasma", PIXEL[regime]
    energy, distance = (10.0, 0.5) if plasma else (20.0, 0.1)
    material = HAEMOGLOBIN.delta_beta(energy)
    if plasma:
        material = RED_CELL.delta_beta(energy).against(PLASMA.delta_beta(energy))
    width = SIDE * pixel
    cells = random_cells(
        40 if plasma else 24,
        (0.8 * width, 0.85 * width, 0.8 * width),
        seed=seed,
        diameter=64e-6 if regime == "strong" else 8e-6,
    )
    matter = MeshScene.of_one_material(cells, material)
    exposures = Exposures.of(Views.evenly_spaced(views, (SIDE, SIDE), pixel), energy, distance, PSF.get(regime, 0.0))
    return exposures, matter, bin_pixels(matter.project(exposures.views.refined(2))[1] / material.delta, 2)


def main() -> None:
    """Print one row for each method, with and without noise."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    given = parser.parse_args()
    plain = {"paganin, noise=0": lambda *a: paganin(*a, options=Linear(noise=0))}
    rows: dict[tuple[str, str], list[float]] = {}
    for regime in PIXEL:
        for seed in given.seeds:
            exposures, matter, truth = scene(regime, seed, given.views)
            clean = simulate(matter, exposures).frames
            photons = 10_000 if regime == "plasma" else 2_000
            for label, frames in (("", clean), (" noisy", poisson(clean.astype(np.float64), photons, seed))):
                for name, retrieve in {**plain, **RETRIEVALS}.items():
                    started = time.process_time()
                    found = retrieve(torch.from_numpy(frames), exposures, *matter.materials[0]).double()
                    seconds = (time.process_time() - started) * 12 / given.views
                    error = (found - truth).square().mean(dim=(1, 2)) / truth.square().mean(dim=(1, 2))
                    rows.setdefault((name, regime + label), []).append(float(error.sqrt().mean()))
                    rows.setdefault((name, "seconds"), []).append(seconds)
    names = list(dict.fromkeys(name for name, _ in rows))
    columns = [r + label for r in PIXEL for label in ("", " noisy")]
    print("| method |", " | ".join(columns), "| seconds |")
    print("| --- |" + " --- |" * (len(columns) + 1))
    for name in names:
        errors = [f"{np.mean(rows[name, column]):.3f}" for column in columns]
        print(f"| {name} |", " | ".join(errors), f"| {np.max(rows[name, 'seconds']):.1f} |")


if __name__ == "__main__":
    main()
