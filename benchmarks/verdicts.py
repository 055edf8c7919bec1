"""What the verdict says of runs that are right and of runs that are wrong, on small scenes.

    python benchmarks/verdicts.py --out docs/data/verdicts.csv          # some minutes on two cores
    python benchmarks/verdicts.py --cases sharp soft --seeds 3

Each row has the run's error of δ against the truth, and in the band that is explained worst the residual over the
contrast, over the noise, and over what a residual may have (root mean squares).
"""

from __future__ import annotations

import argparse
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from rows import written

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch
from machine import commit

import holosplat as hs
from holosplat.fit.residuals import Prediction
from holosplat.methods import METHODS, Task, solve
from holosplat.model import smooth_modes
from holosplat.optics.sampling import fringe_sampling
from holosplat.workflows.verdict import Verdict, judge

PIXEL, SIZE = 3.2e-6, 48
HAEMOGLOBIN = hs.materials.HAEMOGLOBIN.delta_beta(20.0)
SOFT = hs.DeltaBeta(5e-7, 5e-7 / 1500)
BOX = (SIZE * PIXEL, SIZE * PIXEL, SIZE * PIXEL)


@dataclass(frozen=True)
class Run:
    """A measurement, what is told of it, and the method."""

    truth: hs.volume.Object
    prior: hs.MaterialPrior
    method: str
    photons: float | None = None
    light: float = 0.0
    stretch: float = 1.0

    def scan(self, seed: int) -> hs.Scan:
        """Frames of 16 views, 12 for the fit; `light`: rms of smooth light; `stretch`: said over true distance."""
        views = hs.Views.evenly_spaced(16, (SIZE, SIZE), PIXEL)
        scan = hs.simulate(
            self.truth, hs.Exposures.of(views, 20.0, 0.1, 0.05), photons_per_pixel=self.photons, seed=seed
        )
        modes = smooth_modes((SIZE, SIZE), 3)[1:]
        draws = torch.randn(len(scan), len(modes), generator=torch.Generator().manual_seed(seed))
        factor = torch.einsum("vk,khw->vhw", self.light * draws / len(modes) ** 0.5, modes).exp().numpy()
        told = replace(scan.exposures, distance=self.stretch * scan.exposures.distance)
        return replace(scan, frames=(scan.frames * factor).astype(np.float32), exposures=told)


def sharp(seed: int, method: str = "gaussians", **how: float) -> Run:
    """Six red cells of known haemoglobin."""
    cells = hs.specimens.random_cells(6, BOX, seed, 14 * PIXEL)
    scene = hs.MeshScene.of_one_material(cells, HAEMOGLOBIN)
    return Run(scene, hs.MaterialPrior.known(HAEMOGLOBIN), method, **how)


def soft(seed: int, method: str = "gaussians", **how: float) -> Run:
    """Four cells of continuous matter, of which δ/β is known."""
    scene = hs.specimens.soft_cells(4, (14 * PIXEL, 20 * PIXEL), BOX, SOFT, seed, 3 * PIXEL)
    return Run(scene, hs.MaterialPrior.of_ratio(SOFT.ratio), method, **how)


CASES: dict[str, Callable[[int], Run]] = {
    "sharp": sharp,
    "sharp, 2000 photons": lambda seed: sharp(seed, photons=2000),
    "sharp, distance 20 % too long": lambda seed: sharp(seed, stretch=1.2),
    "soft, start": lambda seed: soft(seed, "holographic-tv"),
    "soft": soft,
    "soft, 5000 photons": lambda seed: soft(seed, photons=5000),
    "soft, 5000 photons, light": lambda seed: soft(seed, photons=5000, light=0.02),
}


def measured(run: Run, seed: int) -> tuple[Verdict, float, float]:
    """The verdict, the relative error of δ, and total δ over the true one."""
    train = run.scan(seed).train()
    found = solve(METHODS[run.method], Task(train, run.prior, 0)).on("cpu")
    grid = hs.Grid.of_views(train.views)
    delta, true = found.voxelise(grid).delta, run.truth.voxelise(grid).delta
    said = judge(Prediction(found, train.exposures, fringe_sampling(train.exposures)), train)
    return said, float(np.linalg.norm(delta - true) / np.linalg.norm(true)), float(delta.sum() / true.sum())


def row(name: str, seed: int) -> dict[str, str]:
    """A row of the table."""
    said, error, total = measured(CASES[name](seed), seed)
    powers = {n: np.square(getattr(said, n)).mean(axis=0) for n in ("residual", "noise", "contrast", "allowed")}
    worst = int((powers["residual"] / powers["allowed"]).argmax())
    over = {
        n: (powers["residual"] / np.maximum(powers[n], 1e-12))[worst] ** 0.5 for n in ("contrast", "noise", "allowed")
    }
    numbers = {"error": error, "total": total, **{f"over_{n}": v for n, v in over.items()}}
    noiseless = float(np.sqrt(powers["noise"].mean() / powers["contrast"].mean())) < 0.02
    shown = {n: "" if noiseless and n == "over_noise" else f"{v:.3g}" for n, v in numbers.items()}
    return {
        "case": name,
        "seed": str(seed),
        "good": str(said.good),
        **shown,
        "words": " ".join((said.words, *said.reasons)),
    }


def main() -> None:
    """Write the table, or print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[101])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    here = {"commit": commit(), "machine": platform.machine()}
    rows = [{**row(name, seed), **here} for name in options.cases for seed in options.seeds]
    written(options.out, list(rows[0]), rows)


if __name__ == "__main__":
    main()
