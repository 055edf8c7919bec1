"""Voxels on the images of parallel views: lifting, its adjoint, and shadows of a ball."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holosplat.geometry import Grid, Views, rotation_tilted
from holosplat.learning.network import Taps

SHAPES = [(16, 16), (13, 19)]


def views_of(shape: tuple[int, int]) -> Views:
    views = Views.from_rotations(rotation_tilted([10.0, 75.0, 130.0], [0.0, 20.0, -30.0]), shape, 1.0)
    return Views(views.rotations, np.array([[0.0, 0.0], [1.5, -0.5], [-1.0, 0.25]]), shape, 1.0)


@pytest.mark.parametrize("shape", SHAPES)
def test_projecting_is_the_adjoint_of_lifting(shape):
    taps, random = Taps.of(Grid.centred((9, 11, 7), 1.0), views_of(shape)), torch.Generator().manual_seed(0)
    images = torch.randn(3, 1, *shape, generator=random)
    values = torch.randn(9 * 11 * 7, generator=random)

    lifted, projected = taps.lift(images), taps.project(values)

    left, right = (lifted[:, 0] * values).double().sum(), (images[:, 0] * projected).double().sum()
    assert float(left) == pytest.approx(float(right), rel=1e-4)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_ball_throws_its_chords_where_it_is(shape):
    views, grid = views_of(shape), Grid.centred((12, 12, 12), 1.0)
    x, y, z = np.meshgrid(*grid.axes(), indexing="ij")
    centre, radius = np.array([1.0, -0.5, 0.75]), 4.0
    ball = np.hypot(np.hypot(x - centre[0], y - centre[1]), z - centre[2]) < radius
    shadows = Taps.of(grid, views).project(torch.from_numpy(ball.transpose(2, 1, 0).astype(np.float32)).flatten())

    row, column = (np.arange(n) - 0.5 * (n - 1) for n in shape)
    for rotation, shift, shadow in zip(views.rotations, views.shifts, shadows.numpy()):
        where = (rotation @ centre)[:2] - shift
        away = np.hypot(row[:, None] - where[1], column[None, :] - where[0])
        chords = 2 * np.sqrt(np.maximum(radius**2 - away**2, 0))
        assert np.abs(shadow - chords).mean() < 0.25
        assert shadow.sum() == pytest.approx(chords.sum(), rel=0.06)


def test_what_lies_beyond_the_images_is_not_seen():
    taps = Taps.of(Grid.centred((3, 3, 21), 1.0), Views.from_angles([0.0], (5, 7), 1.0))

    lifted = taps.lift(torch.ones(1, 1, 5, 7))[0, 0].reshape(3, 3, 21)

    assert (lifted[..., :6] == 0).all()
    assert (lifted[..., 7:14] == 1).all()
    assert (lifted[..., 15:] == 0).all()
