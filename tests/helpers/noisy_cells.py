"""Red cells in small noisy frames, whose fringes pixels hardly resolve, and what is compared with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from helpers.bumpy import surfaces
from holosplat.beamline.simulate import Simulation, simulated_frames
from holosplat.geometry import Grid, Views
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import MaterialPrior
from holosplat.methods import Task
from holosplat.methods.illumination import prepared
from holosplat.optics.background import LightOptions
from holosplat.representations import SurfaceMesh
from holosplat.scan import Exposures, Scan
from holosplat.specimens import random_cells
from holosplat.specimens.scene import MeshScene

PITCH, SHAPE = 4.2e-6, (31, 42)
MATTER = HAEMOGLOBIN.delta_beta(20.0)
CELLS = random_cells(4, (30.5 * PITCH, 27.4 * PITCH, 30.5 * PITCH), 5, 13.7 * PITCH)


class Undetected(Simulation):
    """Intensities as they come to the detector."""

    def detector(self, exposures: Exposures) -> Callable[[np.ndarray, int], np.ndarray]:
        return lambda intensity, frame: intensity


@cache
def intensities() -> tuple[Exposures, np.ndarray]:
    """Sixteen views of cells of 14 pixels, without noise."""
    scene = MeshScene.of_one_material(CELLS, MATTER)
    exposures = Exposures.of(Views.evenly_spaced(16, SHAPE, PITCH), 20.0, 0.17, 0.05)
    return exposures, np.stack([*simulated_frames(scene, exposures, Undetected())])


@cache
def scan_of(photons: float) -> Scan:
    """These views in so many photons a pixel."""
    exposures, seen = intensities()
    detect = Simulation(photons, seed=1).detector(exposures)
    return Scan(np.stack([detect(frame, n) for n, frame in enumerate(seen)]), exposures, np.zeros(16, dtype=bool))


def task_of(photons: float) -> Task:
    """The reconstruction of these of known matter; of 2000 photons about half of the contrast is noise."""
    even = LightOptions("even", noise="white")  # what is compared is matter
    return prepared(Task(scan_of(photons), MaterialPrior.known(MATTER), light=even))


def mesh_of(count: int = 4) -> SurfaceMesh:
    """The first cells, in pixels."""
    return surfaces(*(replace(cell, vertices=cell.vertices / PITCH) for cell in CELLS[:count]), unit=PITCH)


def occupancy(found: SurfaceMesh) -> np.ndarray:
    """On voxels of a pixel."""
    there = found.voxelise(Grid.of_views(Views.evenly_spaced(16, SHAPE, PITCH)))
    return np.asarray(there.delta, dtype=float) / found.matter.delta


def error(found: SurfaceMesh | np.ndarray) -> float:
    """Of an occupancy, in parts of the truth."""
    true, other = occupancy(mesh_of()), found if isinstance(found, np.ndarray) else occupancy(found)
    return float(np.linalg.norm(other - true) / np.linalg.norm(true))
