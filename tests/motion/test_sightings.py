"""Bodies of single times: touching ones are parted, and a network guesses them where the frames ask for it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import label

from helpers.moving_ellipsoids import MATERIAL as OTHER
from helpers.moving_ellipsoids import scan as of_ellipsoids
from holosplat.beamline.simulate import simulate
from holosplat.bodies.rest_shape import parted
from holosplat.geometry import Views
from holosplat.learning.start import LearnedStart
from holosplat.materials import HAEMOGLOBIN
from holosplat.motion.detections import SightingOptions, network_for, sightings
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene

SHAPE = (31, 29, 41)
CELLS = 6
MATERIAL = HAEMOGLOBIN.delta_beta(20.0)


def balls(*centres: tuple[float, float, float], radius: float = 5.0) -> np.ndarray:
    """Occupancy of balls at `(z, y, x)` with soft edges."""
    at = np.stack(np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij"))
    away = [np.sqrt(sum((at[a] - c[a]) ** 2 for a in range(3))) for c in centres]
    return np.clip(0.5 + 0.25 * (radius - np.min(away, axis=0)), 0, 1).astype(np.float32)


def count(values: np.ndarray) -> int:
    return int(label(values > 0.5)[1])


ALONE = ((7.0, 7.0, 7.0), (7.0, 7.0, 33.0), (23.0, 21.0, 7.0))


@pytest.mark.parametrize(("apart", "wanted"), [(9.0, 5), (8.0, 5), (2.0, 4)])
def test_bodies_that_touch_are_two(apart, wanted):
    """If they are two by their size and by a dip between them; the others stay bit for bit."""
    values = balls(*ALONE, (22.0, 20.0, 25.0), (22.0, 20.0, 25.0 + apart))
    assert count(values) == 4
    found = parted(values, 0.5, 30)
    assert count(found) == wanted
    assert ((found == values) | (found == 0)).all()
    np.testing.assert_array_equal(found[:, :, :20], values[:, :, :20])


def test_bodies_of_one_size_stay_whole():
    """A dip alone parts nothing."""
    rings = balls(*ALONE)
    rings[:, :, 7] *= 0.7
    np.testing.assert_array_equal(parted(rings, 0.5, 30), rings)
    one = balls((15.0, 14.0, 20.0))
    np.testing.assert_array_equal(parted(one, 0.5, 30), one)


@pytest.fixture(scope="module")
def cells():
    """Frames of red cells in three beams within 48°, and the cells."""
    views = Views.from_angles([0.0, 30.0, 48.0], (64, 60), 0.5e-6)
    meshes = random_cells(CELLS, (18e-6, 24e-6, 18e-6), 3, 8e-6)
    scene = MeshScene.of_one_material(meshes, MATERIAL)
    exposures = Exposures.of(views, 20.0, 0.1)
    return simulate(scene, exposures, photons_per_pixel=1000.0, is_test=np.zeros(3, dtype=bool)), meshes


def nearest(found, meshes) -> np.ndarray:
    """Distance [m] of each body to the middle of the nearest sighting of its size."""
    whole = [one.centre for one in found if one.volume > 0.6 * meshes[0].volume]
    return np.array([min(np.linalg.norm(at - mesh.vertices.mean(0)) for at in whole) for mesh in meshes])


def test_a_network_finds_no_fewer_cells_than_tomography(cells):
    scan, meshes = cells
    network, why = network_for(scan, MATERIAL, SightingOptions(), LearnedStart(), lambda stage, part: None)
    assert network is not None
    assert why.line.startswith("bodies at single times: network's guess (frames of one time: network's guess +")
    looks = [sightings(scan, MATERIAL, network=one) for one in (network, None)]
    by_network, by_tomography = ((nearest(found, meshes) < 1e-6).sum() for found in looks)
    assert by_network >= 4
    assert by_network >= by_tomography


def test_bodies_that_it_does_not_know_are_not_guessed():
    """Tomography explains as much."""
    scan = of_ellipsoids().at_instant(2)
    network, decision = network_for(scan, OTHER, SightingOptions(), LearnedStart(), lambda stage, part: None)
    assert network is None
    assert decision.choice == "tomography"
