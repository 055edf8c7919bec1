"""Other ways to reconstruct all times of a scan: rows of docs/data/moving_methods.csv.

    python benchmarks/moving_methods.py DATA [--cases flow4 stir4 burst4] [--methods low-rank hexplane …] [--write]

DATA holds the snapshots of an ESPResSo run, as for motion.py. The cases are those of motion.py (flow4, flow3, flow2: 16
red cells in flow, 16 times, 1000 photons) and of moving_matter.py (stir4: a stirred blob, 8 times of 1000 photons;
burst4: one that hardly moves, 16 times of 200). Bodies of flows are said to have levels, the others to be continuous,
and the material is known, for every method. All go through the project's waves and its likelihood; options are those
by default, which were chosen on other snapshots, specimens and photons (--first 34 --seed 2; --scene 8 --seed 3).

Times by themselves are what `hs.reconstruct` makes of `scan.at_instant(k)`: by total variation (each-tv), voxels
through the waves (each-voxels), surfaces (each-surfaces) or, of continuous matter, a smooth volume (each-volume).
warm-… begins each fit with what the time before ended with. Scores are of volumes at the frames' times: Dice of bodies,
and the relative error of δ. With --write, rows stand in the file in place of earlier ones of the same case, method,
times, first snapshot and seed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import moving_matter
import numpy as np
import rows
import torch
from machine import commit

import holosplat as hs
import motion
from holosplat.baselines import HolographicTV
from holosplat.geometry import Grid
from holosplat.matter import MatterKind
from holosplat.methods import HolographicVoxels, Method, SmoothVolume, Surfaces, VoxelFit, Voxels
from holosplat.metrics import volume_scores
from holosplat_bench.opponents.moving import Deformed, HexPlane, LowRank, Snapshots, SpaceTimeTV, each_time

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "moving_methods.csv"
VOLUME = HolographicTV(refine=1)
SINGLE: dict[str, Method] = {
    "tv": HolographicVoxels(VOLUME),
    "voxels": Voxels(VOLUME, VoxelFit(refine=1)),
    "surfaces": Surfaces(),
    "volume": SmoothVolume(),
}
"""Methods of one time, by what follows `each-` and `warm-` in the names of methods."""
TOGETHER: dict[str, Method] = {
    "space-time-tv": SpaceTimeTV(),
    "low-rank": LowRank(),
    "hexplane": HexPlane(),
    "deformed": Deformed(),
}
BODIES = ("each-tv", "each-voxels", "each-surfaces", "warm-voxels", "warm-surfaces", *TOGETHER)
MATTER = ("each-volume", "warm-volume", *TOGETHER)
"""Methods of cases with bodies, and of those without."""
FLOWS, BLOBS = ("flow4", "flow3", "flow2"), ("stir4", "burst4")


@dataclass(frozen=True)
class Row:
    """One method on one series. first: snapshot of the first time, or seed of the specimen; dice: of occupancy, mean
    over times, and least_dice of the worst (bodies alone); error, worst: of δ, mean over times and the largest;
    memory_mb: the most of the process while it ran, what it held before included."""

    case: str
    method: str
    times: int
    first: int
    seed: int
    dice: float
    least_dice: float
    error: float
    worst: float
    seconds: float
    cpu_seconds: float
    memory_mb: float
    machine: str
    commit: str


class Case:
    """A series and its truth."""

    def __init__(self, name: str, data: Path, first: int, scene: int, seed: int) -> None:
        self.name, self.seed, self.bodies = name, seed, name in FLOWS
        self.matter: MatterKind = "levels" if self.bodies else "continuous"
        self.first = first if self.bodies else scene
        if self.bodies:
            cells = motion.cells_in_flow(data, first, 16)
            self.times, self.truth = cells.times, cells
            self.scan, material = motion.imaged(cells, motion.ANGLES[name], seed), motion.MATERIAL
        else:
            blob = moving_matter.Case(name, 8, seed, scene)
            self.times, self.truth, self.scan, material = blob.times, blob.scene, blob.scan, moving_matter.MATERIAL
        self.prior = hs.MaterialPrior.known(material)

    def found(self, method: str) -> Callable[[float], hs.volume.Object]:
        """What a method makes of it, at any time."""
        if method in TOGETHER:
            return hs.reconstruct(self.scan, self.prior, TOGETHER[method], self.seed, matter=self.matter).object.at
        how, single = method.split("-")
        if how == "warm":
            return each_time(self.scan, self.prior, SINGLE[single], self.seed, self.matter, warm=True).at
        single = SINGLE[single]
        every = [
            hs.reconstruct(self.scan.at_instant(k), self.prior, single, self.seed, matter=self.matter).object
            for k in range(len(self.times))
        ]
        return Snapshots(self.times, tuple(every)).at

    def row(self, method: str) -> Row:
        """Its scores, and what it took."""
        with rows.spent() as spent:
            found = self.found(method)
        grid = Grid.of_views(self.scan.views)
        with torch.no_grad():
            scores = [volume_scores(found(t).voxelise(grid), self.truth.at(t).voxelise(grid)) for t in self.times]
        dice = np.array([one.dice for one in scores]) if self.bodies else np.array([np.nan])
        wrong = np.array([one.relative_error_delta for one in scores])
        told = (float(dice.mean()), float(dice.min()), float(wrong.mean()), float(wrong.max()))
        return Row(
            self.name, method, len(self.times), self.first, self.seed, *told, *spent.told(), rows.machine(), commit()
        )


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--cases", nargs="+", choices=[*FLOWS, *BLOBS], default=["flow4", "stir4", "burst4"])
    parser.add_argument("--methods", nargs="+", choices=[*BODIES, *MATTER[:2]], help="those of each case by default")
    parser.add_argument("--first", type=int, default=0, help="snapshot of the first time of flows")
    parser.add_argument("--scene", type=int, default=5, help="seed of the specimen of the others")
    parser.add_argument("--seed", type=int, default=1, help="of the photons and of the fits")
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    for name in asked.cases:
        case, usual = Case(name, asked.data, asked.first, asked.scene, asked.seed), BODIES if name in FLOWS else MATTER
        for method in [one for one in asked.methods or usual if one in usual]:
            row = case.row(method)
            rows.shown(row)
            if asked.write:
                rows.replaced(PAGE, row, key=5)


if __name__ == "__main__":
    main()
