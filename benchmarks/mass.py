"""How right the total δ of a run is, and how well its standard error says so, on matter of many kinds in noise.

    python benchmarks/mass.py --out docs/data/mass.csv                 # some ten minutes on one core
    python benchmarks/mass.py --cases balls --noise 0 --priors ratio --seeds 3

Noise is white, of a share of the frames' contrast (rms). Matter with levels is fitted by Gaussians, continuous matter
by a smooth volume. A row: what the volume holds and the total over the true one, the standard error as a share of the
total, and how many standard errors the total is off.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from rows import written

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit

import holosplat as hs
from holosplat.matter import MatterKind
from holosplat.specimens.phantoms import packed_balls
from holosplat_bench.specimens import soft_matter
from holosplat_bench.specimens.phantoms import place_capsules

PIXEL, ENERGY = 1e-6, 20.0
SQUARE, WIDE = (64, 64), (49, 65)


@dataclass(frozen=True)
class Sample:
    """Matter, its `material` against the medium, the frames' shape, the distance [m], and what kind of matter it is."""

    truth: hs.volume.Object
    material: hs.DeltaBeta
    shape: tuple[int, int]
    distance: float
    matter: MatterKind

    @property
    def total(self) -> float:
        """∫ δ dV [m³]."""
        grid = hs.Grid.of_views(hs.Views.evenly_spaced(2, self.shape, PIXEL))
        return float(np.asarray(self.truth.voxelise(grid).delta, dtype=np.float64).sum()) * math.prod(grid.voxel_size)

    def scan(self, count: int, noise: float, seed: int) -> hs.Scan:
        """`count` views, with photon noise of the share `noise` of their contrast."""
        views = hs.Views.evenly_spaced(count, self.shape, PIXEL)
        exposures = hs.Exposures.of(views, ENERGY, self.distance, 0.3)
        scan = hs.simulate(self.truth, exposures, is_test=np.zeros(count, dtype=bool))
        if noise == 0:
            return scan
        sigma = noise * float(np.sqrt(np.square(scan.frames - 1).mean()))
        counts = np.random.default_rng(seed).poisson(scan.frames / sigma**2)
        return replace(scan, frames=(counts * sigma**2).astype(np.float32))

    def prior(self, known: str) -> hs.MaterialPrior:
        """What is told of the matter."""
        if known == "known":
            return hs.MaterialPrior.known(self.material)
        return hs.MaterialPrior.of_ratio(self.material.ratio) if known == "ratio" else hs.MaterialPrior.unknown()


def box(shape: tuple[int, int], part: float = 0.94) -> tuple[float, float, float]:
    """Extents [m] of what fits the frames."""
    h, w = shape
    return part * w * PIXEL, part * h * PIXEL, part * w * PIXEL


def cells(seed: int) -> Sample:
    """Six red cells of haemoglobin."""
    material = hs.materials.HAEMOGLOBIN.delta_beta(ENERGY)
    meshes = hs.specimens.random_cells(6, box(SQUARE), seed, 17 * PIXEL)
    return Sample(hs.MeshScene.of_one_material(meshes, material), material, SQUARE, 0.05, "levels")


def shells(seed: int) -> Sample:
    """Seven hollow shells of water."""
    material = hs.materials.WATER.delta_beta(ENERGY)
    capsules = place_capsules((14 * PIXEL, 20 * PIXEL), 7, box(WIDE), 3 * PIXEL, seed)
    hollow = hs.DeltaBeta(-material.delta, -material.beta)
    meshes = [c.outer(name=f"outer{i}") for i, c in enumerate(capsules)]
    cores = [c.core(name=f"core{i}") for i, c in enumerate(capsules)]
    filling = (*[material] * len(meshes), *[hollow] * len(cores))
    return Sample(hs.MeshScene((*meshes, *cores), filling), material, WIDE, 0.08, "levels")


def soft(seed: int) -> Sample:
    """Five soft cells."""
    material = hs.DeltaBeta(2.5e-7, 2.5e-7 / 1500)
    scene = hs.specimens.soft_cells(5, (15 * PIXEL, 22 * PIXEL), box(WIDE), material, seed, 3 * PIXEL)
    return Sample(scene, material, WIDE, 0.1, "continuous")


def tissue(seed: int) -> Sample:
    """A piece of tissue that fills most of the field."""
    material = hs.DeltaBeta(1.2e-7, 6e-11)
    return Sample(soft_matter.tissue(box(SQUARE, 0.85), material, seed), material, SQUARE, 0.1, "continuous")


def round_cell(seed: int) -> Sample:
    """A round cell of 3 rad."""
    material = hs.DeltaBeta(6e-7, 4e-10)
    return Sample(soft_matter.round_cell(46 * PIXEL, material, seed), material, SQUARE, 0.03, "continuous")


def balls(seed: int) -> Sample:
    """Twelve small dense balls of silica, 4 to 6 pixels wide."""
    material = hs.materials.Compound("SiO2", 2.2).delta_beta(ENERGY)
    packed = packed_balls(np.linspace(6, 4, 12) * PIXEL, box(WIDE, 0.8), seed, margin=2 * PIXEL)
    meshes = [ball.mesh(name=f"ball{i:02d}") for i, ball in enumerate(packed)]
    return Sample(hs.MeshScene.of_one_material(meshes, material), material, WIDE, 0.05, "levels")


CASES: dict[str, Callable[[int], Sample]] = {
    "cells": cells,
    "shells": shells,
    "soft": soft,
    "tissue": tissue,
    "round": round_cell,
    "balls": balls,
}

COLUMNS = ("case", "seed", "views", "noise", "told", "held", "total", "error", "off", "words", "seconds")


def row(name: str, seed: int, count: int, noise: float, known: str) -> dict[str, str]:
    """A row of the table."""
    sample = CASES[name](seed)
    method = hs.methods.METHODS["gaussians" if sample.matter == "levels" else "volume"]
    began = time.process_time()
    found = hs.reconstruct(sample.scan(count, noise, seed), sample.prior(known), method, matter=sample.matter).total
    assert found is not None
    seconds, true = time.process_time() - began, sample.total
    total = off = error = ""
    if found.value is not None and found.error is not None:
        total, error = f"{found.value / true:.3f}", f"{found.error / found.value:.3f}"
        off = f"{(found.value - true) / found.error:.2f}"
    told = (name, str(seed), str(count), f"{noise:g}", known)
    return dict(zip(COLUMNS, (*told, f"{found.held / true:.3f}", total, error, off, found.words, f"{seconds:.0f}")))


def main() -> None:
    """Write the table, line by line, or print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[101])
    parser.add_argument("--views", nargs="+", type=int, default=[12, 4])
    parser.add_argument("--noise", nargs="+", type=float, default=[0.0, 0.5, 1.0])
    parser.add_argument("--priors", nargs="+", default=["ratio", "known", "nothing"])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    here = {"commit": commit(), "machine": platform.machine()}
    wanted = itertools.product(options.views, options.priors, options.noise, options.cases, options.seeds)
    made = ({**row(name, seed, count, noise, known), **here} for count, known, noise, name, seed in wanted)
    written(options.out, [*COLUMNS, *here], made)


if __name__ == "__main__":
    main()
