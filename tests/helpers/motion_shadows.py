"""Shadows of red cells in known poses, on a raster of odd sides."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from holosplat.bodies.poses import Explained, Pose
from holosplat.bodies.rest_shape import KnownBody
from holosplat.bodies.shadows import Shadows
from holosplat.geometry import rotation_y
from holosplat.mesh import TriangleMesh

SHAPE, STEPS = (47, 33), (-1.0, 0.0, 1.0)
RADIUS = 4.5
FLOW = np.array([0.0, 4.0, 0.0])
TURN = Rotation.from_rotvec([0.9, 0.3, 0.4]).as_matrix()
OTHER = Rotation.from_rotvec([-0.2, 0.5, 1.3]).as_matrix()


@cache
def cell() -> TriangleMesh:
    """A red cell about its centre [pixels]."""
    return KnownBody().mesh(3.91e-6 / RADIUS, coarse=True)


def shadows(poses: list[Pose], angles: tuple[float, ...] = (0.0, 90.0), mesh: TriangleMesh | None = None) -> Shadows:
    """What beams at `angles` [degrees] see of bodies at three times, with a little noise."""
    count = len(angles) * len(STEPS)
    times = np.repeat(STEPS, len(angles))
    rotations = torch.from_numpy(np.tile(rotation_y(np.array(angles)), (len(STEPS), 1, 1)))
    empty = Shadows(
        np.zeros((count, *SHAPE)), rotations, torch.zeros(count, 2, dtype=torch.float64), times, 0.0,
        np.full(count, 25.0), np.full(count, 3.0),
    )  # fmt: skip
    images = Explained(mesh or cell(), empty).images(poses)
    return replace(empty, thickness=images + 0.1 * np.random.default_rng(0).normal(size=images.shape))


def pose(turn: np.ndarray, centre: tuple[float, float, float], speed: float = 1.0) -> Pose:
    """A cell at `centre` [pixels] at `speed` times `FLOW`."""
    return Pose(turn, np.array(centre), speed * FLOW, np.zeros(3))
