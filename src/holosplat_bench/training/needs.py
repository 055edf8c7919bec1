"""Resource estimates of `dataset` and `train`.

`benchmarks/needs_acts.py` measures the memory that the constants below stand for, and writes docs/data/needs_acts.csv.
"""

from __future__ import annotations

from holosplat.learning.network import FINE, Size
from holosplat.planning.acts import Parts
from holosplat.planning.needs import Costs, Needs

TRAINER, CHANNEL, LIFTED = 0.61e9, 37.0, 49.0
"""Bytes of memory: the program while it trains, with its optimiser and what PyTorch compiles; a channel of a voxel of
the lattice of a network in training; a channel that is lifted from a view into such a voxel."""
SCENE = 8.0
"""Bytes of memory of a voxel of a scene, of which a file's are held."""
SCENE_PIXEL, SCENE_VOXEL = 4.0, 0.05
"""Bytes on the disk of a pixel of a frame of a scene, and of a voxel of its occupancy."""


def of_dataset(simulated: Needs, shape: tuple[int, int], views: int, scenes: int, jobs: int) -> Needs:
    """What `dataset` takes in so many processes for scenes of so many views, each `simulated` at what it takes most."""
    rows, columns = shape
    pixels, voxels = views * rows * columns, rows * columns**2
    memory = simulated.memory + Parts.plain_program - Costs.program + SCENE * voxels
    disk = scenes * (SCENE_PIXEL * pixels + SCENE_VOXEL * voxels) + 1e5
    return Needs(jobs * memory + (jobs > 1) * Costs.program, disk, 1.5e-4 * scenes * pixels / jobs)


def of_training(shape: tuple[int, int], views: int, size: Size, steps: int) -> Needs:
    """Estimate resources of `train` of the network of `--start learned`, of a certain size, for scenes of so many
    pixels and shown views."""
    lattice = shape[0] * shape[1] ** 2 / FINE**3
    channels = sum(width / 8**level for level, width in enumerate(size.volume)) + 3 * size.features
    memory = TRAINER + (CHANNEL * channels + LIFTED * size.features * views) * lattice
    return Needs(memory, 1e8, steps * (0.2 + 2e-5 * views * lattice))
