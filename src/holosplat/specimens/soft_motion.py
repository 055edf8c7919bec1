"""Continuous specimens in motion: a soft blob that is stirred, and a foam that collapses.

Each is a `CarriedScene` about the origin, reproducible by its seed, right at any time. Lengths are in metres, times in
seconds; numbers below are shares of the material's δ and β, or of a body's size.
"""

from __future__ import annotations

import math

import numpy as np

from ..checks import in_range, require
from ..matter import DeltaBeta
from .carried import CarriedScene, Chain, Sink, Sinks, Twist
from .continuous import Bump, ContinuousScene, Soft, ellipsoid, random_rotation
from .foam import random_foam

CORE = 0.93
"""Share of a bubble's radius within which gas is lost: its sharp inside, less what other bubbles distort it by."""
MOST_LOST = 0.75
"""Share of a bubble's gas that can be lost at most, somewhat less than `CORE`³."""
EDGE_POINTS = 4
"""Points along a ray that the narrowest edge has: sums over soft edges are then right to 1e-3."""


def stirred_blob(
    diameter: float, material: DeltaBeta, seed: int = 0, turn: float = math.radians(60), duration: float = 1.0
) -> CarriedScene:
    """A graded body with fourteen soft lumps and hollows, stirred by two vortices at right angles.

    diameter: of the ball that it never leaves [m]; turn: by how much the middle of the first vortex turns in `duration`
    [rad], of the second two thirds of that; duration: [s]. The first is about the y axis, the second about a
    horizontal one, both through the middle and a third of the diameter wide: volumes never change.
    """
    radius = 0.5 * in_range("diameter", diameter, 1e-9, 1.0, unit="metres")
    in_range("duration", duration, 1e-12, 1e9, unit="seconds")
    require(abs(turn) <= 4 * math.pi, f"turn must be at most two turns, 12.57 rad, but it is {turn:g}.")
    rng = np.random.default_rng(seed)
    semi = radius * np.array([0.85, *rng.uniform(0.62, 0.8, 2)])
    body = random_rotation(rng)
    elements = [ellipsoid(np.zeros(3), semi, Soft(0.3), _times(material, 0.6), body, 0.3 / radius * _direction(rng))]
    for k in range(14):
        size = radius * rng.uniform(0.16, 0.28)
        place = _direction(rng) * rng.uniform(0.1, 0.8) ** (1 / 3) * (semi - size) @ body.T
        level = (0.9, -0.45)[k % 2] * rng.uniform(0.6, 1)
        lengths = size * np.array([1.0, *rng.uniform(0.7, 1.0, 2)])
        elements.append(ellipsoid(place, lengths, Bump(2), _times(material, level), random_rotation(rng)))
    angle, rate = rng.uniform(0, math.pi), turn / duration
    first = Twist((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), rate, diameter / 3)
    second = Twist((0.0, 0.0, 0.0), (math.cos(angle), 0.0, math.sin(angle)), 2 / 3 * rate, diameter / 3)
    step = 0.16 * 0.7 * radius / EDGE_POINTS
    return CarriedScene(ContinuousScene(tuple(elements)), Chain((first, second)), radius, step)


def collapsing_foam(
    diameter: float,
    material: DeltaBeta,
    seed: int = 0,
    loss: float = 0.5,
    duration: float = 1.0,
    count: int = 9,
    edge: float = 0.0,
) -> CarriedScene:
    """A drop of liquid with round bubbles that lose their gas: they shrink, and the liquid closes in, its volume kept.

    diameter: of the drop at time 0 [m], which is the largest; loss: share of all gas that is lost in `duration` [s],
    0 to 0.75, by each bubble at its own rate; count: of bubbles; edge: width of every edge [m] (0: a thirtieth of the
    diameter).
    """
    radius = 0.5 * in_range("diameter", diameter, 1e-9, 1.0, unit="metres")
    in_range("loss", loss, 0.0, MOST_LOST)
    in_range("duration", duration, 1e-12, 1e9, unit="seconds")
    edge = edge or diameter / 30
    require(0 < edge <= diameter / 12, f"edge must be at most {diameter / 12:g} m, but it is {edge:g}.")
    rng = np.random.default_rng(seed)
    inner = 2 * (radius - edge)
    foam = random_foam(inner, count, 0.26 * inner, 0.2, 1.2 * edge, rng)
    drop = radius - 0.5 * edge
    elements = [ellipsoid(np.zeros(3), np.full(3, drop), Soft(edge / drop), material)]
    shares = rng.uniform(0.6, 1.4, count)
    shares *= loss / float(np.average(shares, weights=[ball.volume for ball in foam.bubbles]))
    sinks: list[Sink] = []
    for ball, share in zip(foam.bubbles, np.minimum(shares, MOST_LOST)):
        r = 0.5 * ball.diameter
        elements.append(ellipsoid(ball.centre, np.full(3, r), Soft(edge / r), _times(material, -1.0)))
        x, y, z = ball.centre.tolist()
        sinks.append(Sink((x, y, z), CORE * (r - 0.5 * edge), float(share) / duration * ball.volume))
    return CarriedScene(ContinuousScene(tuple(elements)), Sinks(tuple(sinks)), radius, edge / EDGE_POINTS)


def _direction(rng: np.random.Generator) -> np.ndarray:
    found = rng.normal(size=3)
    return found / np.linalg.norm(found)


def _times(matter: DeltaBeta, factor: float) -> DeltaBeta:
    return DeltaBeta(factor * matter.delta, factor * matter.beta)
