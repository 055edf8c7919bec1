"""Bodies that stand for several others, which have been found beside them since."""

from __future__ import annotations

import numpy as np

from ..geometry import Grid
from ..representations import MovingSurfaces
from .remainder import only

MOST, LEAST = 0.5, 0.1
"""Shares of a body that lie in others: in all of them together, and in each of two at least, of a merger."""
LOOKS = 4
"""Times that are looked at, about."""
VOXELS = 20_000
"""Of the grid on which a body and those in it are compared, at most."""


def without_merger(bodies: MovingSurfaces, times: np.ndarray) -> MovingSurfaces:
    """`bodies` without the one that lies in others most, if that is a merger: most of it is in two others or more.

    Few beams show two bodies that touch as one between them. Each is then found beside it, in the shadow that it
    leaves, and none of the three can become what it is as long as the merger takes the middle.
    """
    seen = times[:: max(1, len(times) // LOOKS)]
    shares = np.mean([shared(bodies, float(time)) for time in seen], axis=0)
    shares[shares < LEAST] = 0
    merged = np.where((shares > 0).sum(1) >= 2, shares.sum(1), 0.0)
    worst = int(merged.argmax())
    return bodies if merged[worst] < MOST else only(bodies, [k for k in range(bodies.count) if k != worst])


def shared(bodies: MovingSurfaces, time: float) -> np.ndarray:
    """[B, B] the share of each body's volume that lies in each other one at `time` [s]."""
    meshes, found = bodies.bodies(time), np.zeros((bodies.count, bodies.count))
    low, high = (np.array([reach(mesh.vertices, axis=0) for mesh in meshes]) for reach in (np.min, np.max))
    meet = np.all((low[:, None] <= high[None]) & (low[None] <= high[:, None]), axis=2)
    for i in np.flatnonzero(meet.sum(1) > 1):
        grid = Grid.around(meshes[i].vertices / bodies.unit_length, bodies.unit_length, VOXELS)
        own = _occupied(bodies, int(i), time, grid)
        for j in (int(j) for j in np.flatnonzero(meet[i]) if j != i):
            found[i, j] = (own * _occupied(bodies, j, time, grid)).sum() / own.sum()
    return found


def _occupied(bodies: MovingSurfaces, number: int, time: float, grid: Grid) -> np.ndarray:
    return only(bodies, [number]).at(time).voxelise(grid).delta / bodies.matter.delta
