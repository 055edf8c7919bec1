"""Distances of surfaces against closed forms: points about one triangle, spheres in each other, meshes that slide."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from holosplat.mesh import TriangleMesh
from holosplat.metrics.volumes import distances, normal_distance
from holosplat.specimens.red_cells import icosphere


def test_points_about_one_triangle():
    """Above its inside, beside a side, beyond a corner, and in its plane."""
    triangle = TriangleMesh(np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0]]), np.array([[0, 1, 2]]))
    points = np.array([[1, 1, 2.0], [2, -1.5, 0], [-3, -4, 0], [1, 0.5, 0], [6, 0, 1], [2 + 0.6, 1.5 + 0.8, 0]])
    assert distances(points, triangle) == pytest.approx([2, 1.5, 5, 0, 5**0.5, 1])


def test_every_triangle_is_asked():
    """Long thin triangles, whose middles are far from points near their ends, against the least of all distances."""
    random = np.random.default_rng(3)
    mesh = TriangleMesh(
        random.normal(size=(30, 3)) * [10, 1, 1], random.permuted(np.tile(np.arange(30), (41, 1)), axis=1)[:, :3]
    )
    points = random.normal(size=(57, 3)) * [10, 2, 2]
    each = [distances(points, TriangleMesh(mesh.vertices, mesh.faces[[k]])) for k in range(len(mesh.faces))]
    assert distances(points, mesh) == pytest.approx(np.min(each, axis=0))


def test_spheres_in_each_other_and_slid():
    """Distance of radii; a turn of a sphere in itself costs what its facets leave."""
    sphere, faces = icosphere(3)
    one = TriangleMesh(2e-6 * sphere, faces)
    other = TriangleMesh(2.3e-6 * sphere @ Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix(), faces)
    assert normal_distance(one, other) == pytest.approx(0.3e-6, rel=0.04, abs=0)
    turned = TriangleMesh(2e-6 * sphere @ Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix(), faces)
    assert normal_distance(one, turned) < 0.01e-6
    moved = TriangleMesh(one.vertices + [0.1e-6, 0, 0], faces)  # the mean square of cos² is a third
    assert normal_distance(one, moved) == pytest.approx(0.1e-6 / 3**0.5, rel=0.06, abs=0)
