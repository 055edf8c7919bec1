"""Rays through meshes by torch, as on a GPU, against those by numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from holosplat.projectors.mesh import on_device, reference
from holosplat.specimens.phantoms import unit_ball

PIXEL = 1e-6
SHAPE = (17, 22)


def three_balls() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [P, 3] [m], faces [F, 3] and two values of each face: bodies that overlap, one is cut."""
    ball, faces = unit_ball(2)
    places = ((0.0, 0.0, 0.0, 6.0), (4.0, -3.0, 2.0, 3.5), (11.0, 2.0, -5.0, 4.0))
    vertices = np.concatenate([PIXEL * (radius * ball + np.array(at)) for *at, radius in places])
    corners = np.concatenate([faces + k * len(ball) for k in range(3)])
    values = np.repeat(np.array([[1.0, 2.0, 0.5], [0.0, 1.0, 3.0]]), len(faces), axis=1)
    return vertices, corners, values


def seen(view: int, rays: int) -> tuple[np.ndarray, np.ndarray]:
    """The depths [C, H, W] by numpy and by torch in a view about no axis in particular."""
    vertices, faces, values = three_balls()
    lab = vertices @ Rotation.random(4, rng=0).as_matrix()[view].T - [0.3 * PIXEL, -0.7 * PIXEL, 0.0]
    arrays = (torch.from_numpy(a) for a in (lab, faces, values))
    true = reference.mean_depths(lab, faces, values, SHAPE, PIXEL, rays)
    return true, on_device.mean_depths(*arrays, SHAPE, PIXEL, rays).numpy()


@pytest.mark.parametrize("rays", [1, 3])
@pytest.mark.parametrize("view", range(4))
def test_depths_are_those_of_numpy(view, rays):
    true, found = seen(view, rays)
    assert np.abs(found - true).max() < 1e-12 * np.abs(true).max()


def test_batches_change_nothing(monkeypatch):
    _, whole = seen(1, 2)
    monkeypatch.setattr(on_device, "MAX_HITS", 100)
    _, parts = seen(1, 2)
    np.testing.assert_allclose(parts, whole, atol=1e-12 * np.abs(whole).max())


def test_faces_along_the_beam_and_an_empty_field_are_no_trouble():
    corners = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
                      [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
    values = np.ones((1, len(faces)))
    for offset in (0.0, 1e3):
        lab = PIXEL * (3 * corners + [offset, 0, 0])
        true = reference.mean_depths(lab, faces, values, SHAPE, PIXEL, 2)
        found = on_device.mean_depths(*(torch.from_numpy(a) for a in (lab, faces, values)), SHAPE, PIXEL, 2).numpy()
        assert np.abs(found - true).max() <= 1e-12 * PIXEL
        assert (np.abs(true).max() > 0) == (offset == 0)
