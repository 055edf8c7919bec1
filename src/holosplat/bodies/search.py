"""The search for bodies of a known rest shape in frames, on pixels that are large enough for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..fit.run import Run
from ..matter import DeltaBeta
from ..mesh import TriangleMesh, ball_radius
from ..scan import Scan
from .neighbourhood_search import Heard, pursued
from .poses import FREER, Explained, Pose
from .rest_shape import KnownBody, moments, stretched_like
from .shadows import Shadows

SEARCH_RADIUS = 2.8
"""Radius of the ball of a body's volume in pixels of the search, whose frames are binned to about that."""
SIZES, SIZE_STEPS = 9, 8
"""Sizes that are tried for all bodies, and steps to better poses at the best one."""


@dataclass(frozen=True)
class BodySearch:
    """The problem of a search. body: known shape of all; seen: shadows in the frames, binned; bin: so many pixels of
    the frames are one of the search, in whose pixels `mesh` has the rest shape."""

    body: KnownBody
    seen: Shadows
    bin: int
    mesh: TriangleMesh

    @classmethod
    def of(cls, frames: Scan, material: DeltaBeta, body: KnownBody, ends: tuple[float, float]) -> BodySearch:
        """In `frames` of one pixel size and of some times between `ends` [s]. Errors: those of `KnownBody.mesh`."""
        coarse = body.mesh(frames.views.pixel_size, coarse=True)
        radius = ball_radius(coarse.volume)
        factor = max(1, round(radius / SEARCH_RADIUS))
        return cls(body, Shadows.of(frames, material, *ends).binned(factor), factor, sized(coarse, 1 / factor))

    def poses(
        self,
        velocities: np.ndarray,
        like: Sequence[Pose] = (),
        size: float = 1.0,
        seed: int = 0,
        on_progress: Heard = lambda share: None,
        run: Run | None = None,
    ) -> tuple[list[Pose], bool]:
        """Poses of bodies `size` times as large, on paths near `velocities` [K, 3], and whether the search began with
        bodies in the poses `like` (`pursued`); all in pixels of the search."""
        return pursued(sized(self.mesh, size), self.seen, velocities, like, seed, on_progress, run)

    def of_best_size(
        self, poses: Sequence[Pose], size: float = 1.0, run: Run | None = None
    ) -> tuple[float, list[Pose]]:
        """The size of all bodies within `body.uncertain` of `size` that explains most in `poses`, and better poses."""
        mesh = sized(self.mesh, size)
        size *= best_size(mesh, self.seen, poses, self.body.uncertain)
        return size, Explained(sized(self.mesh, size), self.seen, FREER, run).improved(poses, SIZE_STEPS)

    def like(self, mesh: TriangleMesh, pixel: float) -> Pose:
        """A body at rest that is stretched like `mesh` [m], and has its middle; pixel: of the frames [m]."""
        still = np.zeros(3)
        return Pose(stretched_like(mesh, self.mesh), moments(mesh)[1] / (pixel * self.bin), still, still)


def best_size(mesh: TriangleMesh, seen: Shadows, poses: Sequence[Pose], uncertain: float) -> float:
    """The factor within 1 ± `uncertain` by which all bodies of rest shape `mesh` in `poses` explain `seen` best."""
    factors = np.linspace(1 - uncertain, 1 + uncertain, SIZES)
    explained = [Explained(sized(mesh, float(factor)), seen) for factor in factors]
    width = explained[SIZES // 2]
    costs = np.array([float(width.cost(width.target - torch.from_numpy(one.images(poses)))) for one in explained])
    k = int(np.clip(costs.argmin(), 1, SIZES - 2))
    before, here, after = costs[k - 1 : k + 2]
    bent = before - 2 * here + after
    step = 0.5 * (before - after) / bent if bent > 0 else 0.0
    return float(np.clip(factors[k] + step * (factors[1] - factors[0]), factors[0], factors[-1]))


def sized(mesh: TriangleMesh, factor: float) -> TriangleMesh:
    """`mesh` about the origin, `factor` times as large."""
    return TriangleMesh(mesh.vertices * factor, mesh.faces, mesh.name)
