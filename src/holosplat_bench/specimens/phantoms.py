"""Balls in series of shrinking size, capsules of two materials, and foam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from holosplat.checks import InputError, finite, in_range, require, shaped
from holosplat.mesh import TriangleMesh
from holosplat.specimens.phantoms import Ball, checked_diameters, packed_balls, unit_ball
from holosplat.specimens.red_cells import whole_number


def star_of_balls(diameters: np.ndarray, seed: int | np.random.Generator = 0, spokes: int = 8) -> list[Ball]:
    """A three-dimensional star of balls: `2 · spokes` of each diameter [S] [m], on rings that shrink as they do.

    Balls of diameter d stand on two rings of radius `d / sin(π / spokes)` about y at the heights ±that radius, so
    that the gaps along a ring are as wide as the balls: whatever resolves d shows `spokes` of them, and, as the
    sectors of a Siemens star do, all sizes meet at the middle of the field. Each ring is turned at random (`seed`).
    The balls come size by size in the order of `diameters`. `InputError` where two neighbouring sizes would touch.
    """
    diameters = checked_diameters(diameters)
    whole_number("spokes", spokes, least=3)
    ring = diameters / np.sin(np.pi / spokes)
    order = np.sort(diameters)
    apart = np.sqrt(2) * np.diff(np.sort(ring)) - 0.5 * (order[1:] + order[:-1])
    if np.any(apart <= 0):
        i = int(np.argmax(apart <= 0))
        raise InputError(
            f"diameters must differ enough for their rings not to touch, but {1e6 * order[i]:.4g} and "
            f"{1e6 * order[i + 1]:.4g} µm do; take fewer sizes, or fewer spokes."
        )
    turns = np.random.default_rng(seed).uniform(0, 2 * np.pi, (len(diameters), 2, 1))
    angles = turns + 2 * np.pi / spokes * np.arange(spokes)
    height = np.broadcast_to(np.array([[-1.0], [1.0]]), angles.shape)
    centres = ring[:, None, None, None] * np.stack([np.cos(angles), height, np.sin(angles)], axis=-1)
    return [Ball(centre, d) for d, of_size in zip(diameters, centres.reshape(-1, 2 * spokes, 3)) for centre in of_size]


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

    def outer(self, subdivisions: int = 4, name: str = "capsule") -> TriangleMesh:
        """Closed mesh of the outer surface, enclosing exactly `volume`."""
        return self._ellipsoid(self.half_axes, subdivisions, name)

    def core(self, subdivisions: int = 4, name: str = "core") -> TriangleMesh:
        """Closed mesh of the core's surface, wound outwards, enclosing exactly 4π/3 (a - t)(b - t)(c - t)."""
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
    whole_number("the number of capsules", count)
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


CUT = 2.0
"""Diameters further than this from the median, in standard deviations of their logarithm, are not drawn."""


@dataclass(frozen=True, eq=False)
class Foam:
    """A drop about the origin, and the bubbles inside it, which touch neither each other nor its surface."""

    drop: Ball
    bubbles: tuple[Ball, ...]


def random_foam(
    drop: float,
    count: int,
    median: float,
    spread: float = 0.4,
    margin: float | None = None,
    seed: int | np.random.Generator = 0,
) -> Foam:
    """A spherical drop of diameter `drop` [m] with `count` bubbles of log-normal diameters at random in it.

    median: of the bubbles' diameters [m]; spread: standard deviation of their natural logarithm (drawn within two
    of them); margin: thinnest film of liquid [m], by default 5 % of the median. `InputError` when they do not fit.
    """
    whole_number("the number of bubbles", count)
    in_range("median diameter", median, 1e-9, 1.0, unit="metres")
    require(0 <= spread <= 1, f"spread must lie between 0 and 1, but it is {spread!r}.")
    rng = np.random.default_rng(seed)
    deviates = ndtri(rng.uniform(ndtr(-CUT), ndtr(CUT), count))
    margin = 0.05 * median if margin is None else margin
    bubbles = packed_balls(median * np.exp(spread * deviates), (drop, drop, drop), rng, margin, "ball")
    return Foam(Ball(np.zeros(3), drop), tuple(bubbles))
