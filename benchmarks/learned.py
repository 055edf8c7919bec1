"""What a learned start is worth: rows of docs/data/learned.csv.

    python benchmarks/learned.py [DATA] [--cases espresso cells capsules foam] [--views 2 3 4 6 8] [--weights FILE]
        [--write]

espresso: one time of red cells in flow, of an ESPResSo run in DATA (as for motion.py), on 128 × 96 pixels of 0.5 µm
(20 keV, 10 cm), at 0/90°, 0/30/48° and even directions. cells, capsules, foam: scenes that `holosplat dataset` draws by
a seed that nothing was learnt from, in the first of their views. Haemoglobin, or the material, is known; there is no
noise. Every scene is reconstructed by surfaces after Gaussians that begin with phase retrieval and with the network's
guess, and scored against the true volume. A guess that the frames contradict is not taken: its row says so.
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from machine import commit
from rows import read, write

import holosplat as hs
from holosplat.geometry import Grid
from holosplat.learning.start import LearnedStart, guessed
from holosplat.methods import Surfaces
from holosplat.metrics import volume_scores
from holosplat.specimens.scene import MeshScene
from holosplat.training.ranges import Ranges
from holosplat.training.sample import drawn_case
from motion import MATERIAL, PIXEL, SHAPE, cells_in_flow

PAGE = Path(__file__).resolve().parents[1] / "docs" / "data" / "learned.csv"
UNEQUAL = {2: (0.0, 90.0), 3: (0.0, 30.0, 48.0)}
"""Angles of two and three beams [degrees], as instruments have them; more are even."""
SEED = 77
"""Of drawn scenes; networks learn from seed 0 and are validated by seed 1."""
KINDS = {"cells": "red-cells", "capsules": "capsules", "foam": "foam"}


@dataclass(frozen=True)
class Row:
    """case, scene: which snapshot, or number of a drawn scene; start: phase, learned, or guess (the network's volume
    itself); dice, error: of occupancy and relative of δ, empty where frames contradict the guess; left: what the guess
    leaves unexplained of the retrieved thickness."""

    case: str
    scene: int
    views: int
    start: str
    dice: float | str
    error: float | str
    left: float | str
    seconds: float
    machine: str
    commit: str


@dataclass(frozen=True)
class Setting:
    """A scan with its true scene and material."""

    scan: hs.Scan
    scene: MeshScene
    material: hs.DeltaBeta


def espresso(data: Path, snapshot: int, views: int) -> Setting:
    """One time of the flowing cells."""
    scene = cells_in_flow(data, snapshot, 1).snapshots[0]
    angles = UNEQUAL.get(views) or tuple(np.arange(views) * 180 / views)
    exposures = hs.Exposures.of(hs.Views.from_angles(np.array(angles), SHAPE, PIXEL), 20.0, 0.1)
    return Setting(hs.simulate(scene, exposures, is_test=np.zeros(views, dtype=bool)), scene, MATERIAL)


def drawn(kind: str, number: int, views: int) -> Setting:
    """A drawn scene, without noise, in the first of its views."""
    ranges = Ranges(kinds=(kind,), noiseless=1.0, tilted=0.0, views=max(views, 2))  # type: ignore[arg-type]
    case = drawn_case(ranges, SEED, number)
    scan = case.scan().train()[np.arange(views)]
    assert isinstance(case.scene, MeshScene)
    return Setting(scan, case.scene, case.prior.materials[0])


def rows(setting: Setting, weights: str) -> list[tuple[str, float | str, float | str, float | str, float]]:
    """(start, Dice, error, left, seconds) of the guess and of both starts."""
    how, known = LearnedStart(weights=weights), hs.MaterialPrior.known(setting.material)
    began = time.perf_counter()
    guess = guessed(setting.scan, setting.material, how.network.network, lambda stage, fraction: None)
    truth, found = setting.scene.voxelise(guess.grid), guess.values.numpy() * setting.material.delta
    scores = volume_scores(hs.Volume(found, found / setting.material.ratio, guess.grid), truth)
    left = guess.left()
    table = [("guess", scores.dice, scores.relative_error_delta, left, time.perf_counter() - began)]
    grid, plain = Grid.of_views(setting.scan.views), Surfaces()
    for start in ("phase", "learned"):
        method = replace(plain, gaussians=replace(plain.gaussians, start=start, learned=how))
        began = time.perf_counter()
        try:
            result = hs.reconstruct(setting.scan, known, method, matter="levels")
        except hs.InputError as error:
            print(f"  {start}: {error}")
            table.append((start, "", "", left, time.perf_counter() - began))
            continue
        scores = volume_scores(result.object.voxelise(grid), setting.scene.voxelise(grid))
        table.append((start, scores.dice, scores.relative_error_delta, "", time.perf_counter() - began))
    return table


def keep(row: Row) -> None:
    """Write `row` into the table, in place of an earlier one of the same case, scene, views and start."""
    new = {name: str(value) for name, value in asdict(row).items()}
    names = ("case", "scene", "views", "start")
    others = [each for each in read(PAGE) if [each[name] for name in names] != [new[name] for name in names]]
    write([*others, new], PAGE)


def main() -> None:
    """Run the cases that are asked for, and print and write their rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", type=Path)
    parser.add_argument("--cases", nargs="+", default=["espresso", *KINDS], choices=["espresso", *KINDS])
    parser.add_argument("--views", nargs="+", type=int, default=[2, 3, 4, 6, 8])
    parser.add_argument("--scenes", nargs="+", type=int, default=[5, 40])
    parser.add_argument("--weights", default="")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    for case in options.cases:
        for scene in options.scenes:
            for views in options.views:
                given = espresso(options.data, scene, views) if case == "espresso" else drawn(KINDS[case], scene, views)
                for start, dice, error, left, seconds in rows(given, options.weights):
                    row = Row(case, scene, views, start, dice, error, left, seconds, platform.machine(), commit())
                    print(row, flush=True)
                    if options.write:
                        keep(row)


if __name__ == "__main__":
    main()
