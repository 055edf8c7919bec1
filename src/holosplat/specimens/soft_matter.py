"""Cells of graded index: a `ContinuousScene` about the origin, reproducible by its seed.

Materials are δ and β against the medium around; lengths are in metres. Numbers below are shares of the material's δ and
β, or of a body's size.
"""

from __future__ import annotations

import numpy as np

from ..checks import in_range, require
from ..matter import DeltaBeta
from .continuous import Bump, ContinuousScene, Element, Soft, ellipsoid, random_direction, random_rotation, scaled
from .phantoms import packed_balls

Box = tuple[float, float, float]
"""Extents `(x, y, z)` [m]."""


def soft_cells(
    count: int,
    diameters: tuple[float, float],
    box: Box,
    material: DeltaBeta,
    seed: int = 0,
    edge: float = 0.0,
) -> ContinuousScene:
    """`count` rounded cells whose index has gradients, with a denser nucleus and two to four vacuoles each.

    diameters: the smallest and the largest [m]; box: the cells lie in a cylinder about y of these extents, and do not
    touch; edge: width of every edge [m], at most a quarter of the smallest diameter (0: sharp). A cell has `material`
    times 0.9 to 1.1, rising by 15 % of it from its centre to one side; nuclei have 1.35 times a cell's, vacuoles 0.6.
    """
    require(count >= 1, f"count must be at least 1, but it is {count}.")
    low, high = (in_range("cell diameter", d, 1e-9, 1.0, unit="metres") for d in diameters)
    require(low <= high, f"diameters must be (smallest, largest), but they are {low:g} and {high:g} m.")
    require(0 <= edge <= low / 4, f"edge must lie between 0 and {low / 4:g} m, but it is {edge:g}.")
    rng = np.random.default_rng(seed)
    sizes = np.linspace(high, low, count)
    elements: list[Element] = []
    for ball in packed_balls(sizes, box, rng, margin=0.02 * low):
        elements += _cell(rng, ball.centre, 0.5 * ball.diameter, material, edge)
    return ContinuousScene(tuple(elements))


def _cell(
    rng: np.random.Generator, centre: np.ndarray, radius: float, material: DeltaBeta, edge: float
) -> list[Element]:
    """A graded cell in the ball of `radius`, its nucleus and its vacuoles."""
    level = rng.uniform(0.9, 1.1)
    body = graded_body(rng, centre, radius, scaled(material, level), edge, (0.8, 1.0), 0.15)
    sizes = np.concatenate([[rng.uniform(0.75, 0.95)], rng.uniform(0.3, 0.45, rng.integers(2, 5))])
    parts = [body]
    for i, ball in enumerate(packed_balls(sizes, (1.65, 1.65, 1.65), rng, shape="ball")):
        width = min(1.0, edge / (0.5 * ball.diameter * radius))
        r = 0.5 * ball.diameter / (1 + 0.5 * width)
        parts.append(part_of(rng, body, ball.centre, r, 0.35 if i == 0 else -0.4, Soft(width)))
    return parts


def graded_body(
    rng: np.random.Generator,
    centre: np.ndarray,
    radius: float,
    material: DeltaBeta,
    edge: float,
    shares: tuple[float, float],
    slope: float,
) -> Element:
    """An ellipsoid in the ball of `radius`, edge included, that rises by `slope` from its centre to one side."""
    semi = (radius - 0.5 * edge) * np.array([shares[1], *rng.uniform(*shares, 2)])
    width = edge / float(semi.max())
    return ellipsoid(centre, semi, Soft(width), material, random_rotation(rng), slope / radius * random_direction(rng))


def part_of(
    rng: np.random.Generator, body: Element, place: np.ndarray, radius: float, level: float, profile: Soft | Bump
) -> Element:
    """An ellipsoid at `place` [3] of `radius`, both in units of the body's semi-axes, of the body's matter × level."""
    semi = np.linalg.norm(body.axes, axis=1)
    centre = body.centre + place @ body.axes
    return ellipsoid(centre, radius * semi, profile, scaled(body.matter, level), (body.axes / semi[:, None]).T)
