"""Properties of the two mesh projectors for whatever closed bodies: mass, sums, order, whole steps and turns."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.strategies import numbers, rotations, vectors
from holosplat.geometry import Grid, Views
from holosplat.mesh import TriangleMesh
from holosplat.projectors.mesh import mesh_line_integrals, voxelise_meshes
from holosplat.projectors.surface import surface_occupancy, surface_thickness
from holosplat.specimens.red_cells import icosphere

SHAPE = (29, 34)
FEW = settings(max_examples=30)
VERTICES, FACES = (array.copy() for array in icosphere(2))


@st.composite
def bodies(draw: st.DrawFn) -> TriangleMesh:
    """A star-shaped body with radii of 3 to 7 pixels about a centre near the middle; lengths in pixels."""
    radii = draw(vectors(0.0, 1.0, len(VERTICES))) * draw(numbers(0.0, 2.0)) + draw(numbers(3.0, 5.0))
    return TriangleMesh(VERTICES * radii[:, None] + draw(vectors(-3.0, 3.0, 3)), FACES)


def rays(body: TriangleMesh, turns: np.ndarray, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    views = Views(turns, np.repeat([shift], len(turns), axis=0), SHAPE, 1.0)
    return mesh_line_integrals(body.vertices, body.faces, np.ones((1, len(body.faces))), views)[:, 0].numpy()


def areas(body: TriangleMesh, turns: np.ndarray, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    shifts = torch.tensor([shift] * len(turns), dtype=torch.float64)
    vertices, faces = torch.from_numpy(body.vertices), torch.from_numpy(body.faces)
    return surface_thickness(vertices, faces, torch.from_numpy(turns), shifts, SHAPE).numpy()


projectors = pytest.mark.parametrize("thickness", [rays, areas])


@FEW
@given(body=bodies(), turns=rotations(2))
def test_every_view_holds_the_volume(body, turns):
    """To what two lines or rays a pixel resolve of bodies so small and rough (0.6 % in 300 drawn at random)."""
    for image in (*areas(body, turns), *rays(body, turns)):
        assert image.sum() == pytest.approx(body.volume, rel=0.015)


@projectors
@FEW
@given(body=bodies(), other=bodies(), turns=rotations(1))
def test_bodies_add_up(thickness, body, other, turns):
    faces = np.concatenate([body.faces, other.faces + len(body.vertices)])
    both = TriangleMesh(np.concatenate([body.vertices, other.vertices]), faces)
    wanted = thickness(body, turns) + thickness(other, turns)
    np.testing.assert_allclose(thickness(both, turns), wanted, rtol=0, atol=1e-9)


@projectors
@FEW
@given(body=bodies(), turns=rotations(1), random=st.randoms(use_true_random=False))
def test_the_order_of_the_faces_does_not_matter(thickness, body, turns, random):
    order = list(range(len(body.faces)))
    random.shuffle(order)
    shuffled = TriangleMesh(body.vertices, np.roll(body.faces[order], random.randrange(3), axis=1))
    np.testing.assert_allclose(thickness(shuffled, turns), thickness(body, turns), rtol=0, atol=1e-9)


@projectors
@FEW
@given(body=bodies(), turns=rotations(1), step=st.tuples(st.integers(-3, 3), st.integers(-3, 3)))
def test_a_shift_of_whole_pixels_shifts_the_image(thickness, body, turns, step):
    moved = thickness(body, turns, (float(step[0]), float(step[1])))[:, 3:-3, 3:-3]
    wanted = np.roll(thickness(body, turns), (-step[1], -step[0]), (-2, -1))[:, 3:-3, 3:-3]
    np.testing.assert_allclose(moved, wanted, rtol=0, atol=1e-7)


@projectors
@FEW
@given(body=bodies(), turn=rotations(1), turns=rotations(1))
def test_turning_the_body_is_turning_the_views(thickness, body, turn, turns):
    turned = TriangleMesh(body.vertices @ turn[0].T, body.faces)
    np.testing.assert_allclose(thickness(turned, turns), thickness(body, turns @ turn[0]), rtol=0, atol=1e-6)


@projectors
@FEW
@given(body=bodies(), turns=rotations(1))
def test_a_surface_turned_inside_out_is_a_cavity(thickness, body, turns):
    hollow = TriangleMesh(body.vertices, body.faces[:, ::-1])
    np.testing.assert_allclose(thickness(hollow, turns), -thickness(body, turns), rtol=0, atol=1e-9)


@FEW
@given(body=bodies())
def test_voxels_hold_the_volume_and_never_more_than_all(body):
    grid = Grid.centred((30, 29, 34), 1.0)
    by_rays = voxelise_meshes(body.vertices, body.faces, np.ones((1, len(body.faces))), grid)[0]
    vertices = torch.from_numpy(body.vertices - np.array(grid.origin))
    by_lines = surface_occupancy(vertices, torch.from_numpy(body.faces), grid.shape).numpy()
    for occupancy in (by_rays, by_lines):
        assert occupancy.sum() == pytest.approx(body.volume, rel=5e-3)
        assert occupancy.min() >= -1e-9
        assert occupancy.max() <= 1 + 1e-9
