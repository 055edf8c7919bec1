"""Balls, packed at random."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..checks import InputError, finite, in_range, require, shaped
from ..mesh import TriangleMesh
from .red_cells import icosphere

BATCHES = (16, 128, 1024) + (2048,) * 50
"""A ball's place is looked for among so many random points at a time: few as long as there is room."""
SHAPES = ("box", "cylinder", "ball")


@dataclass(frozen=True, eq=False)
class Ball:
    """A ball. centre: [3] `(x, y, z)` [m]; diameter [m]."""

    centre: np.ndarray
    diameter: float

    def __post_init__(self) -> None:
        centre = shaped("ball centre", np.asarray(self.centre, dtype=np.float64), (3,))
        object.__setattr__(self, "centre", finite("ball centre", centre))
        object.__setattr__(self, "diameter", in_range("ball diameter", self.diameter, 1e-9, 1.0, unit="metres"))

    @property
    def volume(self) -> float:
        """π d³/6 [m³]."""
        return np.pi / 6 * self.diameter**3

    def mesh(self, subdivisions: int = 3, name: str = "ball") -> TriangleMesh:
        """Closed mesh of 10·4^s + 2 vertices and exactly the ball's volume, see `unit_ball`."""
        vertices, faces = unit_ball(subdivisions)
        return TriangleMesh(0.5 * self.diameter * vertices + self.centre, faces, name)


def unit_ball(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [10·4^s + 2, 3] and faces [20·4^s, 3] of an icosphere that encloses the unit ball's volume, 4π/3.

    Its vertices lie outside the unit sphere, by 0.3 % of the radius for s = 3 and a quarter of that for each more, as
    its faces lie inside: a ball of the right mass, where a polyhedron inscribed in it would lack 1 %.
    """
    vertices, faces = icosphere(subdivisions)
    grown = (4 / 3 * np.pi / TriangleMesh(vertices, faces).volume) ** (1 / 3)
    return grown * vertices, faces


def packed_balls(
    diameters: np.ndarray,
    box: tuple[float, float, float],
    seed: int | np.random.Generator = 0,
    margin: float = 0.0,
    shape: str = "cylinder",
) -> list[Ball]:
    """Balls of the given `diameters` [N] [m], in their order, at random in a container about the origin, none touching.

    box: the container's extents `(x, y, z)` [m]; seed: makes the result reproducible; margin: clear distance [m]
    between balls and to the walls; shape: "box", "cylinder" about y of diameter min(x, z), or "ball" of diameter
    min(x, y, z). The largest is placed first. `InputError` when one finds no place among 100 000 random points.
    """
    diameters = checked_diameters(diameters)
    require(len(box) == 3, f"box must be three extents (x, y, z) in metres, but it is {box!r}.")
    half = 0.5 * np.array([in_range(f"box extent {axis}", b, 1e-9, 10.0, unit="metres") for axis, b in zip("xyz", box)])
    require(margin >= 0, f"margin must not be negative, but it is {margin!r} m.")
    require(shape in SHAPES, f"shape must be one of {', '.join(SHAPES)}, but it is {shape!r}.")
    rng = np.random.default_rng(seed)
    centres, radii = np.empty((0, 3)), np.empty(0)
    order = np.argsort(-diameters, kind="stable")
    for count, radius in enumerate(0.5 * diameters[order]):
        for points in BATCHES:
            tries = rng.uniform(-half, half, (points, 3))
            tries = tries[_within(tries, half - radius - margin, shape)]
            distance = np.linalg.norm(tries[:, None] - centres, axis=-1)
            free = np.flatnonzero((distance >= radii + (radius + margin)).all(axis=1))
            if len(free):
                break
        else:
            raise InputError(
                f"{len(diameters)} balls must fit into the {shape} of {' x '.join(f'{1e6 * b:.4g}' for b in box)} µm, "
                f"but only {count} found a place; take fewer or smaller ones, a larger box or a smaller margin."
            )
        centres, radii = np.concatenate([centres, tries[free[:1]]]), np.append(radii, radius)
    return [Ball(centres[i], float(2 * radii[i])) for i in np.argsort(order)]


def _within(points: np.ndarray, half: np.ndarray, shape: str) -> np.ndarray:
    """Which `points` [P, 3] lie in the container of the clear half extents `half` [3] (none where one is negative)."""
    x, y, z = np.abs(points).T
    inside = np.full(len(points), bool(np.all(half >= 0)))
    if shape == "ball":
        return inside & (np.linalg.norm(points, axis=1) <= half.min())
    if shape == "cylinder":
        return inside & (np.hypot(x, z) <= min(half[0], half[2])) & (y <= half[1])
    return inside & (np.abs(points) <= half).all(axis=1)


def checked_diameters(diameters: np.ndarray) -> np.ndarray:
    """Diameters [N] [m], at least one. Errors: `InputError` for one out of range."""
    diameters = shaped("ball diameters", np.asarray(diameters, dtype=np.float64), (None,))
    require(len(diameters) > 0, "ball diameters must be at least one, but the list is empty.")
    return np.array([in_range("ball diameter", d, 1e-9, 1.0, unit="metres") for d in diameters])
