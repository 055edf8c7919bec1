"""The options of every tomography, scanned on tuning scenes (seeds below 100): where the defaults come from.

    python benchmarks/tune_tomography.py                # all scenes, all methods but svmbir: an hour on two cores
    python benchmarks/tune_tomography.py --methods tv sirt --scenes main12 --seeds 1 2
    python benchmarks/tune_tomography.py --defaults     # the defaults only; held-out frames are predicted too

Thickness is retrieved by --retrieval, of the scene's own material; the occupancy is bounded by 1. Prints a Markdown
table.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit

import holosplat as hs
from holosplat.baselines.algebraic import Algebraic, Ramp, art, filtered_backprojection, sirt
from holosplat.baselines.tomography import TOMOGRAPHIES, TotalVariation, total_variation
from holosplat.matter import Matter
from holosplat.metrics import image_scores, intensity_range, volume_scores
from holosplat.optics.retrieval import RETRIEVALS
from holosplat.optics.sampling import fringe_sampling
from holosplat.representations.voxels import VoxelGrid
from holosplat_bench.opponents.mbir import Mbir, svmbir_volume

HAEMOGLOBIN = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
PITCH = 3.2e-6
UNEQUAL = [0.0, 33.0, 71.0, 124.0]
HELD_OUT = [17.0, 52.0, 97.0, 150.0]


@dataclass(frozen=True)
class Scene:
    """A tuning scene: cells of haemoglobin, `train` views and held-out ones; lengths [m]."""

    cells: int
    diameter: float
    side: int
    pitch: float
    train: list[float]
    held_out: list[float]
    psf_px: float = 0.05
    photons: float | None = None


THIRDS = [i * 11.25 for i in range(16) if i % 4 != 3]
FOURTHS = [i * 11.25 for i in range(16) if i % 4 == 3]
SCENES = {
    "main12": Scene(24, 20 * PITCH, 128, PITCH, THIRDS, FOURTHS),
    "noise12": Scene(24, 20 * PITCH, 128, PITCH, THIRDS, FOURTHS, photons=2000.0),
    "main4": Scene(24, 20 * PITCH, 128, PITCH, UNEQUAL, HELD_OUT),
    "holo8": Scene(10, 7.8e-6, 96, 0.5e-6, [i * 22.5 for i in range(8)], [11.25, 56.25, 101.25, 146.25], 0.0),
}

FBP = [Ramp(window, cutoff) for window in ("ramlak", "shepp-logan", "hann") for cutoff in (1.0, 0.7, 0.5)]
SIRT = [Algebraic(sweeps) for sweeps in (10, 30, 60, 100, 200)]
SIRT_NONNEG = [Algebraic(sweeps, 1.9, True) for sweeps in (30, 60, 100, 200)]
ART = [
    Algebraic(s, r, n)
    for n in (False, True)
    for s, r in ((5, 0.2), (10, 0.2), (20, 0.5), (20, 1.0), (40, 0.5), (40, 1.0))
]
TV = [TotalVariation(weight, discount=power) for power in (0.0, 0.5, 1.0) for weight in (0.2, 0.5, 1.0, 2.0)]
TV += [TotalVariation(0.5, 60, iterations) for iterations in (60, 200)]
MBIR = [Mbir(snr, sharpness, 1.1, threshold) for snr in (25, 30) for sharpness in (0, 1) for threshold in (0.1, 0.3)]
OPTIONS: dict[str, tuple[Callable[..., torch.Tensor], list[Any]]] = {
    "fbp": (filtered_backprojection, FBP),
    "art": (art, ART),
    "sirt": (sirt, SIRT),
    "sirt-nonneg": (sirt, SIRT_NONNEG),
    "tv": (total_variation, TV),
    "svmbir": (svmbir_volume, MBIR),
}


@dataclass(frozen=True)
class Job:
    """A simulated scene: what was measured and retrieved, and what is true."""

    scan: hs.Scan
    lines: torch.Tensor
    truth: hs.Volume


def job(name: str, seed: int, retrieval: str) -> Job:
    """Simulate and retrieve; held-out frames are free of noise."""
    scene = SCENES[name]
    meshes = hs.specimens.random_cells(scene.cells, (scene.side * scene.pitch,) * 3, seed, scene.diameter)
    matter = hs.MeshScene.of_one_material(meshes, HAEMOGLOBIN)
    views = hs.Views.from_angles(scene.train + scene.held_out, (scene.side, scene.side), scene.pitch)
    exposures = hs.Exposures.of(views, 20.0, 0.1, scene.psf_px)
    is_test = np.arange(len(views)) >= len(scene.train)
    scan = hs.simulate(matter, exposures, seed=seed, is_test=is_test)
    if scene.photons:
        noisy = hs.simulate(matter, exposures, seed=seed, is_test=is_test, photons_per_pixel=scene.photons)
        frames = np.where(is_test[:, None, None], scan.frames, noisy.frames)
        scan = hs.Scan(frames, exposures, is_test)
    train = scan.train()
    lines = RETRIEVALS[retrieval](torch.from_numpy(train.frames), train.exposures, *HAEMOGLOBIN)
    return Job(scan, lines, matter.voxelise(hs.Grid.of_views(views)))


def row(job: Job, method: Callable[..., torch.Tensor], held_out: bool) -> str:
    """Scores of one method on one scene, as cells of a table."""
    train, grid = job.scan.train(), job.truth.grid
    began = time.perf_counter()
    volume = method(job.lines, train.views, grid, 1.0, lambda fraction: None)
    seconds = time.perf_counter() - began
    voxels = VoxelGrid(volume[None], grid, Matter.one(*HAEMOGLOBIN))
    scores = volume_scores(voxels.voxelise(grid), job.truth)
    cells = f"{scores.dice:.4f} | {scores.relative_error_delta:.4f} | {seconds:.1f}"
    if not held_out:
        return cells
    test = job.scan.test()
    oversample = fringe_sampling(train.exposures)
    with torch.no_grad():
        predicted = hs.model.measure(voxels, test.exposures, oversample).numpy()
    mean = image_scores(predicted, test.frames, intensity_range(train.frames)).mean
    return f"{cells} | {mean['ssim']:.4f} | {mean['frcm']:.4f}"


def main() -> None:
    """Scan what was asked for, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", choices=OPTIONS, default=list(TOMOGRAPHIES))
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--retrieval", choices=RETRIEVALS, default="paganin")
    parser.add_argument("--defaults", action="store_true")
    chosen = parser.parse_args()
    print("| scene, seed | method | Dice | error of δ | time / s |" + " SSIM | FRCM |" * chosen.defaults)
    print("|" + " --- |" * (7 if chosen.defaults else 5))
    for name in chosen.scenes:
        for seed in chosen.seeds:
            ready = job(name, seed, chosen.retrieval)
            for method in chosen.methods:
                function, options = OPTIONS[method]
                runs = [(str(option), partial(function, options=option)) for option in options]
                if chosen.defaults:
                    runs = [(method, TOMOGRAPHIES.get(method) or partial(function, options=Mbir()))]
                for label, run in runs:
                    print(f"| {name}, {seed} | {label} | {row(ready, run, chosen.defaults)} |", flush=True)
    where = f"commit {commit()}, torch {torch.__version__}, {torch.get_num_threads()} threads"
    print(f"\nThickness by {chosen.retrieval}; {where}")


if __name__ == "__main__":
    main()
