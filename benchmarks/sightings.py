"""What single times show of red cells in few beams: docs/data/sightings.csv.

    python benchmarks/sightings.py DATA --out docs/data/sightings.csv      # two minutes on one core

The cells and frames of benchmarks/motion.py, at four times of two windows. A row: Dice of the volume of one time by
tomography and by the network that ships with the package; what bodies of either leave unexplained of the retrieved
thickness, and whether `track` would take the network by that; how many cells are in the field; and how many of them
have a body of their own (intersection over union above a half) in either volume, before and after bodies that touch are
parted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from machine import commit
from rows import written
from scipy.ndimage import label
from torch import Tensor

import holosplat as hs
from holosplat.bodies.rest_shape import parted
from holosplat.inference import Compared
from holosplat.learning.start import Guessed, LearnedStart, guess_matter, unexplained
from holosplat.matter import Matter
from holosplat.motion.detections import NETWORK, SightingOptions, missed_by_bodies, occupancy
from holosplat.representations import VoxelGrid
from motion import MATERIAL, cells_in_flow, imaged

ANGLES = {"4": (0.0, 45.0, 90.0, 135.0), "3": (0.0, 30.0, 48.0), "2": (0.0, 90.0), "2 near": (0.0, 23.8)}
WINDOWS, TIMES, CHOSEN = (0, 30), 16, (0, 5, 10, 15)
SEEN = 500
"""Voxels in the field from which on a cell counts as seen: two thirds of one."""
COLUMNS = (
    *("beams", "first", "time", "dice_tomography", "dice_network", "left_tomography", "left_network", "network_taken"),
    *("cells", "own_tomography", "own_tomography_parted", "own_network", "own_network_parted", "commit"),
)


def truth(cells: list[hs.mesh.TriangleMesh], grid: hs.Grid) -> np.ndarray:
    """[Z, Y, X] the number of the cell that fills a voxel, from 1 on."""
    numbers = np.zeros(grid.shape, dtype=int)
    for k, mesh in enumerate(cells):
        filled = hs.MeshScene.of_one_material([mesh], MATERIAL).voxelise(grid).delta > 0.5 * MATERIAL.delta
        numbers[filled] = k + 1
    return numbers


def own(values: np.ndarray, numbers: np.ndarray, level: float) -> int:
    """How many cells have a body of their own."""
    bodies, count = label(values > level)
    found = 0
    for k in range(1, numbers.max() + 1):
        cell = numbers == k
        if cell.sum() < SEEN:
            continue
        inside = np.bincount(bodies[cell], minlength=count + 1)
        inside[0] = 0
        best = int(inside.argmax())
        found += bool(inside[best] > 0.5 * ((bodies == best) | cell).sum()) if best else 0
    return found


def rows(data: Path) -> Iterator[dict[str, str]]:
    """A row a time."""
    options, network = SightingOptions(), LearnedStart().network.network
    for beams, angles in ANGLES.items():
        for first in WINDOWS:
            cells = cells_in_flow(data, first, TIMES)
            scan = imaged(cells, angles, 1)
            for t in CHOSEN:
                at = scan.at_instant(t)
                guess = guess_matter(at, MATERIAL, network, lambda stage, part: None)
                values, grid = occupancy(at, MATERIAL, options, lambda stage, part: None, None)
                seen = VoxelGrid(values[None], grid, Matter.one(*MATERIAL)).resampled(guess.grid).values[0]
                where = (beams, str(first), str(t))
                yield dict(
                    zip(COLUMNS, (*where, *judged(seen, guess, list(cells.snapshots[t].meshes), options)), strict=True)
                )


def judged(
    tomography: Tensor, guess: Guessed, cells: list[hs.mesh.TriangleMesh], options: SightingOptions
) -> list[str]:
    """What is said of one time."""
    numbers, level, both = truth(cells, guess.grid), options.level, (tomography, guess.values)
    masks = [volume.numpy() > level for volume in both]
    dice = [2 * (mask & (numbers > 0)).sum() / (mask.sum() + (numbers > 0).sum()) for mask in masks]
    left = [unexplained((volume > level).float(), guess.images, guess.taps) for volume in both]
    missed = [missed_by_bodies(volume, guess, level) for volume in both]
    taken = Compared(NETWORK, *missed[1].gain_over(missed[0])).wins
    counts = list[int]()
    for volume in both:
        whole = volume.numpy()
        counts += [own(whole, numbers, level), own(parted(whole, level, options.least_volume), numbers, level)]
    there = int((np.bincount(numbers.ravel())[1:] >= SEEN).sum())
    said = [f"{value:.3f}" for value in (*dice, *left)]
    return [*said, str(taken), *(str(count) for count in (there, *counts)), commit()]


def main() -> None:
    """Run and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of the ESPResSo run")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    torch.set_num_threads(1)
    written(given.out, COLUMNS, rows(given.data))


if __name__ == "__main__":
    main()
