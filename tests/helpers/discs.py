"""A ball, its line integrals, and small solvers, for the tests of tomographies."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from holosplat.geometry import Grid, Views, rotation_y

PITCH = 2.5e-6
SHAPE = (7, 25)
"""Rows and columns of the detector: rectangular and odd."""
ANGLES = [0.0, 17.0, 31.0, 60.0, 75.0, 90.0, 121.0, 133.0, 149.0, 166.0]
"""Uneven ones."""
BALL = (2.0, 0.4, -3.0, 5.0)
"""x, y, z and radius [pixels]."""


def quiet(fraction: float) -> None:
    """No progress to show."""


def turned(angles=ANGLES, shape=SHAPE, shifts=None, pitch=PITCH) -> Views:
    """Views about y, with detector shifts (in pixels)."""
    offsets = np.zeros((len(angles), 2)) if shifts is None else np.asarray(shifts)
    return Views(rotation_y(angles), pitch * offsets, shape, pitch)


def anyhow(count=8, shape=(21, 25)) -> Views:
    """Views without a common axis, with shifts of their own."""
    shifts = np.random.default_rng(0).uniform(-1, 1, (count, 2))
    return Views(Rotation.random(count, random_state=5).as_matrix(), PITCH * shifts, shape, PITCH)


def ball_lines(views: Views, ball=BALL, fine=6) -> Tensor:
    """Thickness [V, H, W] in metres of a ball: chords, averaged over pixels."""
    pitch, (h, w) = views.pitch, views.shape
    i, j = ((np.arange(n * fine) + 0.5) / fine - n / 2 for n in (h, w))
    images = []
    for rotation, shift, edge in zip(views.rotations, views.shifts / pitch, views.relative):
        x, y = (rotation @ np.array(ball[:3]))[:2] - shift
        chord = 2 * np.sqrt(np.clip(ball[3] ** 2 - (edge * j - x) ** 2 - (edge * i[:, None] - y) ** 2, 0, None))
        images.append(chord.reshape(h, fine, w, fine).mean((1, 3)))
    return torch.from_numpy(pitch * np.stack(images)).float()


def ball_truth(grid: Grid, pitch=PITCH, ball=BALL) -> np.ndarray:
    """Whether voxels [Z, Y, X] lie inside the ball."""
    x, y, z = (axis / pitch for axis in grid.axes())
    return (x - ball[0]) ** 2 + (y[:, None] - ball[1]) ** 2 + (z[:, None, None] - ball[2]) ** 2 < ball[3] ** 2
