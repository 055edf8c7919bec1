"""Capsules: a core in a shell, each an ellipsoid, the core filled with another material or hollow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..checks import finite, in_range, require, shaped
from ..mesh import TriangleMesh
from .phantoms import packed_balls, unit_ball

MAX_FLATTENING = 0.5
REACH = 1.004
"""How far a capsule's mesh may reach, in half axes: `unit_ball` grows by 0.3 % at three subdivisions."""


@dataclass(frozen=True, eq=False)
class Capsule:
    """Two ellipsoids about one centre: the outer has `half_axes`, the inner, filled by the core, `half_axes - shell`.

    centre: [3] `(x, y, z)` [m].
    half_axes: [3] of the outer surface [m].
    shell: thickness at the axes [m].
    rotation: [3, 3], with `x = rotation @ x_capsule + centre`.
    """

    centre: np.ndarray
    half_axes: np.ndarray
    shell: float
    rotation: np.ndarray

    def __post_init__(self) -> None:
        for name, shape in (("centre", (3,)), ("half_axes", (3,)), ("rotation", (3, 3))):
            array = shaped(f"capsule {name}", np.asarray(getattr(self, name), dtype=np.float64), shape)
            object.__setattr__(self, name, finite(f"capsule {name}", array))
        least = float(self.half_axes.min())
        require(
            0 < self.shell < least,
            f"the shell's thickness must lie between 0 and the shortest half axis, {1e6 * least:.4g} µm, but it is "
            f"{1e6 * self.shell:.4g} µm.",
        )

    @property
    def volume(self) -> float:
        """Of shell and core together, 4π/3 abc [m³]."""
        return 4 / 3 * np.pi * float(np.prod(self.half_axes))

    @property
    def core_volume(self) -> float:
        """Of the core, 4π/3 (a - t)(b - t)(c - t) [m³] with the shell's thickness t."""
        return 4 / 3 * np.pi * float(np.prod(self.half_axes - self.shell))

    def outer(self, subdivisions: int = 4, name: str = "capsule") -> TriangleMesh:
        """Closed mesh of the outer surface, enclosing exactly `volume`."""
        return self._ellipsoid(self.half_axes, subdivisions, name)

    def core(self, subdivisions: int = 4, name: str = "core") -> TriangleMesh:
        """Closed mesh of the core's surface, wound outwards, enclosing exactly `core_volume`."""
        return self._ellipsoid(self.half_axes - self.shell, subdivisions, name)

    def _ellipsoid(self, half_axes: np.ndarray, subdivisions: int, name: str) -> TriangleMesh:
        vertices, faces = unit_ball(subdivisions)
        return TriangleMesh(half_axes * vertices @ self.rotation.T + self.centre, faces, name)


def place_capsules(
    diameters: tuple[float, float],
    count: int,
    box: tuple[float, float, float],
    shell: float,
    seed: int | np.random.Generator = 0,
    flattening: float = 0.2,
) -> list[Capsule]:
    """`count` capsules, turned and placed at random in a cylinder about y, none touching.

    diameters: smallest and largest longest axis [m], uniformly between; box: extents `(x, y, z)` [m] about the origin,
    the cylinder's diameter being min(x, z); shell: thickness [m]; flattening: the other two axes are shorter than the
    longest by up to this fraction, from 0 (balls) to 0.5. Each keeps to a ball of its own. `InputError` when they do
    not fit.
    """
    whole = isinstance(count, (int, np.integer)) and count >= 1
    require(whole, f"the number of capsules must be a whole number of at least 1, but it is {count!r}.")
    small, large = (in_range("capsule diameter", d, 1e-9, 1.0, unit="metres") for d in diameters)
    require(
        small <= large, f"diameters must be the smallest and the largest, but they are {diameters!r}; exchange them."
    )
    require(
        0 <= flattening <= MAX_FLATTENING,
        f"flattening must lie between 0 and {MAX_FLATTENING}, but it is {flattening!r}.",
    )
    rng = np.random.default_rng(seed)
    longest = rng.uniform(small, large, count)
    ratios = np.concatenate([np.ones((count, 1)), rng.uniform(1 - flattening, 1, (count, 2))], axis=1)
    rotations = Rotation.from_quat(rng.standard_normal((count, 4))).as_matrix()
    balls = packed_balls(REACH * longest, box, rng)
    half_axes = 0.5 * longest[:, None] * ratios
    return [Capsule(b.centre, axes, shell, turn) for b, axes, turn in zip(balls, half_axes, rotations)]
