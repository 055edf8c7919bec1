"""Continuous specimens: a round cell, tissue, a head phantom, coated droplets, a soft body with an absorber.

Each is a `ContinuousScene` about the origin, reproducible by its seed. Materials are δ and β against the medium around;
lengths are in metres. Numbers below are shares of the material's δ and β, or of a body's size.
"""

from __future__ import annotations

import math

import numpy as np

from holosplat.checks import in_range, require
from holosplat.matter import DeltaBeta
from holosplat.specimens.continuous import (
    Bump,
    ContinuousScene,
    Element,
    Soft,
    ellipsoid,
    random_direction,
    random_rotation,
    scaled,
)
from holosplat.specimens.phantoms import packed_balls
from holosplat.specimens.soft_matter import Box, graded_body, part_of

SHEPP_LOGAN = (
    (1.0, (0.6900, 0.920, 0.810), (0.0, 0.0, 0.0), (0, 0)),
    (-0.8, (0.6624, 0.874, 0.780), (0.0, -0.0184, 0.0), (0, 0)),
    (-0.2, (0.1100, 0.310, 0.220), (0.22, 0.0, 0.0), (-18, 10)),
    (-0.2, (0.1600, 0.410, 0.280), (-0.22, 0.0, 0.0), (18, 10)),
    (0.1, (0.2100, 0.250, 0.410), (0.0, 0.35, -0.15), (0, 0)),
    (0.1, (0.0460, 0.046, 0.050), (0.0, 0.1, 0.25), (0, 0)),
    (0.1, (0.0460, 0.046, 0.050), (0.0, -0.1, 0.25), (0, 0)),
    (0.1, (0.0460, 0.023, 0.050), (-0.08, -0.605, 0.0), (0, 0)),
    (0.1, (0.0230, 0.023, 0.020), (0.0, -0.606, 0.0), (0, 0)),
    (0.1, (0.0230, 0.046, 0.020), (0.06, -0.605, 0.0), (0, 0)),
)
"""Level, semi-axes, centre, and Euler angles φ, ψ about the head's axis [degrees] of each ellipsoid.

Shepp & Logan (1974, IEEE Trans. Nucl. Sci. 21, 21), in three dimensions and with Toft's levels, as `phantom3d` of
Schabel (2006) has them."""


def round_cell(diameter: float, material: DeltaBeta, seed: int = 0) -> ContinuousScene:
    """One nearly round cell: a graded body, a nucleus with two nucleoli, five vacuoles and eighty granules.

    diameter: of the ball that holds it [m]; its largest δ is about 1.6 times the material's.
    """
    radius = 0.5 * in_range("cell diameter", diameter, 1e-9, 1.0, unit="metres")
    rng = np.random.default_rng(seed)
    body = graded_body(rng, np.zeros(3), radius, material, 0.12 * radius, (0.94, 1.0), 0.15)
    sizes = np.concatenate([[0.9], rng.uniform(0.18, 0.3, 5), rng.uniform(0.06, 0.14, 80)])
    elements = [body]
    for i, ball in enumerate(packed_balls(sizes, (1.6, 1.6, 1.6), rng, margin=0.01, shape="ball")):
        level = 0.35 if i == 0 else -0.35 if i < 6 else 0.6 * rng.uniform(0.3, 1)
        profile = Soft(0.4) if i < 6 else Bump(2)
        elements.append(part_of(rng, body, ball.centre, 0.5 * ball.diameter * 0.85, level, profile))
        if i == 0:
            elements += [part_of(rng, body, ball.centre + s * 0.16, 0.12, 0.3, Soft(0.6)) for s in (-1, 1)]
    return ContinuousScene(tuple(elements))


def tissue(box: Box, material: DeltaBeta, seed: int = 0, cells: int = 40, granules: int = 300) -> ContinuousScene:
    """A piece of tissue that fills the ellipsoid in `box`: a graded ground, cells of many levels with nuclei, three
    vessels, four fibres, and texture.

    cells: their number; granules: bumps that make the texture, of either sign and of two sizes, so that its
    correlation has two lengths.
    """
    require(cells >= 1, f"cells must be at least 1, but it is {cells}.")
    require(granules >= 0, f"granules must not be negative, but it is {granules}.")
    semi = 0.5 * np.array([in_range("box extent", b, 1e-9, 10.0, unit="metres") for b in box])
    rng, least = np.random.default_rng(seed), float(semi.min())
    ground = ellipsoid(np.zeros(3), semi / 1.05, Soft(0.1), material, gradient=0.15 / least * random_direction(rng))
    elements = [ground]
    for ball in packed_balls(rng.uniform(0.2, 0.36, cells), (1.7, 1.7, 1.7), rng, margin=0.01, shape="ball"):
        level, radius = rng.uniform(-0.12, 0.35), 0.5 * ball.diameter * least
        elements += _grain(rng, ball.centre * semi, radius, level, material)
    for kind in range(7):
        level, width = (-0.55, 0.07) if kind < 3 else (0.45, 0.04)
        centre = 0.35 * rng.uniform(-1, 1, 3) * semi
        lengths = least * np.array([0.5, width, width * rng.uniform(0.7, 1)])
        matter = scaled(material, level)
        elements.append(ellipsoid(centre, lengths, Soft(0.4), matter, random_rotation(rng)))
    for i in range(granules):
        radius = least * (0.12 if i % 4 == 0 else 0.05)
        level = rng.choice([-1, 1]) * rng.uniform(0.03, 0.1)
        place = random_direction(rng) * rng.uniform() ** (1 / 3) * (0.9 * semi - radius)
        elements.append(ellipsoid(place, np.full(3, radius), Bump(2), scaled(material, level)))
    return ContinuousScene(tuple(elements))


def shepp_logan(height: float, material: DeltaBeta, edge: float = 0.0) -> ContinuousScene:
    """The head phantom of Shepp and Logan in three dimensions, its axis along y, `SHEPP_LOGAN`.

    height: of the skull's longest axis [m]; material: of the skull (level 1), of which the brain has 0.2 and the
    ventricles nothing; edge: width of every edge [m] (0: sharp), of small ellipsoids at most their mean semi-axis.
    """
    half = 0.5 * in_range("height", height, 1e-9, 1.0, unit="metres") / 0.92
    require(0 <= edge <= 0.1 * half, f"edge must lie between 0 and {0.1 * half:g} m, but it is {edge:g}.")
    upright = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # the head's axis z to y
    elements = []
    for level, semi, centre, (phi, psi) in SHEPP_LOGAN:
        c, s = math.cos(math.radians(phi + psi)), math.sin(math.radians(phi + psi))
        turn = upright @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        lengths = half * np.array(semi)
        width = min(edge / float(lengths.mean()), 1.0)
        elements.append(
            ellipsoid(upright @ (half * np.array(centre)), lengths, Soft(width), scaled(material, level), turn)
        )
    return ContinuousScene(tuple(elements))


def coated_droplets(
    count: int,
    diameters: tuple[float, float],
    coating: float,
    box: Box,
    materials: tuple[DeltaBeta, DeltaBeta],
    seed: int = 0,
) -> ContinuousScene:
    """`count` round droplets of the first material under a coating of the second, whose thickness differs.

    diameters: the smallest and the largest, coating included [m]; coating: its mean thickness [m]; each droplet's own
    is 0.7 to 1.3 times that, and its core sits off the middle by up to half of it. box: as for `soft_cells`.
    """
    require(count >= 1, f"count must be at least 1, but it is {count}.")
    low, high = (in_range("droplet diameter", d, 1e-9, 1.0, unit="metres") for d in diameters)
    require(low <= high, f"diameters must be (smallest, largest), but they are {low:g} and {high:g} m.")
    require(0 < coating <= low / 4, f"coating must lie between 0 and {low / 4:g} m, but it is {coating:g}.")
    core, shell = materials
    rng = np.random.default_rng(seed)
    elements = []
    for ball in packed_balls(np.linspace(high, low, count), box, rng, margin=0.02 * low):
        radius, thick = 0.5 * ball.diameter, coating * rng.uniform(0.7, 1.3)
        away = random_direction(rng) * rng.uniform(0, 0.5) * thick
        elements.append(ellipsoid(ball.centre, np.full(3, radius), Soft(0.0), shell))
        elements.append(ellipsoid(ball.centre + away, np.full(3, radius - thick), Soft(0.0), core.against(shell)))
    return ContinuousScene(tuple(elements))


def body_with_absorber(
    size: Box, soft: DeltaBeta, absorber: DeltaBeta, bead: float, seed: int = 0, beads: int = 1
) -> ContinuousScene:
    """A soft ellipsoid of extents `size` with gradients, ten bubbles and lumps, and sharp `beads` of an absorber.

    soft, absorber: δ and β against the medium around; bead: diameter of a bead [m]. Beads lie inside, and touch
    neither each other nor what else is in the body.
    """
    semi = 0.5 * np.array([in_range("size", b, 1e-9, 1.0, unit="metres") for b in size])
    radius = 0.5 * in_range("bead", bead, 1e-9, float(semi.min()), unit="metres")
    require(beads >= 1, f"beads must be at least 1, but it is {beads}.")
    rng, least = np.random.default_rng(seed), float(semi.min())
    elements = [ellipsoid(np.zeros(3), semi / 1.03, Soft(0.06), soft, gradient=0.15 / least * random_direction(rng))]
    sizes = np.concatenate([np.full(beads, 2 * radius / least), rng.uniform(0.15, 0.4, 10)])
    for i, ball in enumerate(packed_balls(sizes, (1.7, 1.7, 1.7), rng, margin=0.02, shape="ball")):
        if i < beads:
            elements.append(ellipsoid(ball.centre * semi, np.full(3, radius), Soft(0.0), absorber.against(soft)))
        else:
            elements += _grain(rng, ball.centre * semi, 0.5 * ball.diameter * least, (-0.7, 0.4)[i % 2], soft, None)
    return ContinuousScene(tuple(elements))


def _grain(
    rng: np.random.Generator,
    centre: np.ndarray,
    radius: float,
    level: float,
    material: DeltaBeta,
    nucleus: float | None = 0.3,
) -> list[Element]:
    """A soft ellipsoid of the material × level in the ball of `radius`, with a nucleus or without."""
    semi = radius / 1.1 * np.array([1.0, *rng.uniform(0.7, 1.0, 2)])
    turn = random_rotation(rng)
    parts = [ellipsoid(centre, semi, Soft(0.2), scaled(material, level), turn)]
    if nucleus is not None:
        parts.append(ellipsoid(centre, 0.5 * semi, Soft(0.5), scaled(material, nucleus), turn))
    return parts
