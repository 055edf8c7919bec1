"""Meshes of simple shapes: closed, outward, and of their volumes in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.mesh import TriangleMesh
from holosplat_bench.specimens.shapes import box_mesh, column, lathe, prism, rough_lens

HEIGHTS = np.array([-3e-6, 1e-6, 2e-6])
MODES = np.array([[3e5, 1e5, 0.3, 2e-6], [-1e5, 4e5, 1.0, 1e-6]])
FRAME = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])
SHAPES = {
    "box": (box_mesh((-1e-6, -2e-6, 0.0), (2e-6, 1e-6, 5e-6)), 45e-18),
    "column": (column(2e-6, 3e-6, 4e-6), 24e-18),
    "prism": (prism(1e-6 * np.array([[0, 0], [4, 0], [0, 3]]), (-1e-6, 1e-6)), 12e-18),
    "frustum": (
        lathe(HEIGHTS, np.array([1e-6, 2e-6, 2e-6])),
        np.pi * (4e-6 * (1e-12 + 2e-12 + 4e-12) / 3 + 1e-6 * 4e-12),
    ),
    "cone": (lathe(HEIGHTS[:2], np.array([0.0, 3e-6]), path=1e-6 * np.array([[0, 0], [2, 1]])), np.pi * 12e-18),
}


def is_closed(mesh: TriangleMesh) -> bool:
    """Whether each edge is run along once in either direction."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    ways, counts = np.unique(edges, axis=0, return_counts=True)
    back, _ = np.unique(edges[:, ::-1], axis=0, return_counts=True)
    return bool((counts == 1).all() and np.array_equal(ways, back))


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_closed_and_have_their_volume(name):
    mesh, volume = SHAPES[name]
    assert is_closed(mesh)
    assert mesh.volume == pytest.approx(volume, rel=1e-9, abs=0)


def test_a_turned_ball_converges_at_second_order():
    errors = []
    for count in (17, 33, 65):
        u = -np.cos(np.pi * np.linspace(0, 1, count))
        mesh = lathe(5e-6 * u, 5e-6 * np.sqrt(1 - u**2))
        assert is_closed(mesh)
        errors.append(abs(mesh.volume / (4 / 3 * np.pi * 125e-18) - 1))
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(2, abs=0.2)


def test_a_lens_has_its_volume_and_its_opening_however_rough():
    radius, opening, errors = 20e-6, 2e-6, []
    for rings in (12, 24, 48):
        mesh = rough_lens(radius, opening, MODES, FRAME, rings=rings)
        assert is_closed(mesh)
        errors.append(abs(mesh.volume / (2 / 3 * np.pi * radius**2 * opening) - 1))
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(2, abs=0.2)
    flat = rough_lens(radius, opening, 0 * MODES, FRAME)
    along = flat.vertices @ FRAME.T
    assert np.ptp(along[:, 2]) == pytest.approx(opening)
    assert np.hypot(*along[:, :2].T).max() == pytest.approx(radius, rel=1e-3, abs=0)
    rough = rough_lens(radius, opening, MODES, FRAME).vertices @ FRAME.T
    assert rough[:, :2] == pytest.approx(along[:, :2])
    assert np.ptp(rough[:, 2]) > 2 * opening
