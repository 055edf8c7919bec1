"""The energy of bodies beside their shape at rest, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.moving_ellipsoids import MATERIAL, PIXEL
from holosplat.checks import InputError
from holosplat.matter import Matter
from holosplat.mesh import TriangleMesh
from holosplat.motion.elastic import strain_energy
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.membrane.model import Elasticity
from holosplat.specimens.red_cells import icosphere

TIMES = np.array([0.0, 0.5, 1.0])


def moving(*ends: tuple[np.ndarray, np.ndarray]) -> MovingSurfaces:
    """Bodies that go on straight lines from one set of vertices [m] to another."""
    faces = icosphere(2)[1]
    basis = TimeBasis(0.0, 1.0, 1)
    return MovingSurfaces.of_bodies(
        [np.array(e) for e in ends], [faces] * len(ends), basis, PIXEL, Matter.one(*MATERIAL)
    )


def test_a_body_at_rest_has_no_energy_in_any_pose_and_one_that_grows_has():
    """Evenly by λ, Skalak's energy is A G/4 (I₁² + 2 I₁ - 2 I₂ + C I₂²) with I₁ = 2 (λ² - 1) and I₂ = λ⁴ - 1."""
    sphere, faces = icosphere(2)
    rest = TriangleMesh(4e-6 * sphere, faces)
    turned = rest.vertices @ Rotation.from_rotvec([0.4, -1.0, 0.2]).as_matrix().T + 7e-6
    only_skalak = Elasticity(skalak_shear=2e-6, skalak_dilation=3.0, bending=0.0, global_area=0.0, volume=0.0)
    found = strain_energy(moving((turned, turned), (rest.vertices, 1.2 * rest.vertices)), TIMES, rest, only_skalak)
    assert found.shape == (3, 2)
    corners = rest.vertices[rest.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    square = (1 + 0.2 * TIMES) ** 2
    first, second = 2 * (square - 1), square**2 - 1
    wanted = area * 2e-6 / 4 * (first**2 + 2 * first - 2 * second + 3.0 * second**2)
    assert found[:, 1] == pytest.approx(wanted, rel=1e-9, abs=1e-24)
    assert found[:, 0] == pytest.approx(np.zeros(3), abs=1e-9 * wanted[-1])
    assert strain_energy(moving((rest.vertices, 1.2 * rest.vertices)), TIMES, rest)[2, 0] > 0


def test_other_triangles_are_refused():
    sphere, faces = icosphere(1)
    with pytest.raises(InputError, match="triangles of the shape at rest, 80 each"):
        strain_energy(moving((icosphere(2)[0], icosphere(2)[0])), TIMES, TriangleMesh(sphere, faces))
