"""Continuous matter that a motion carries along: truth objects of series, right at any time.

A motion is a chain of maps in closed form, each with its inverse: matter at x at the time t is what was where the
inverse takes x. Nothing is integrated over time, and no spline, lattice or voxel takes part, so that a
reconstruction shares no numerics with it. Line integrals are sums of many points along each ray.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch

from holosplat.checks import finite, in_range, require
from holosplat.geometry import Grid, Views
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
from holosplat.volume import LineIntegrals, Volume

from .phantoms import random_foam

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
    elements = [
        ellipsoid(np.zeros(3), semi, Soft(0.3), scaled(material, 0.6), body, 0.3 / radius * random_direction(rng))
    ]
    for k in range(14):
        size = radius * rng.uniform(0.16, 0.28)
        place = random_direction(rng) * rng.uniform(0.1, 0.8) ** (1 / 3) * (semi - size) @ body.T
        level = (0.9, -0.45)[k % 2] * rng.uniform(0.6, 1)
        lengths = size * np.array([1.0, *rng.uniform(0.7, 1.0, 2)])
        elements.append(ellipsoid(place, lengths, Bump(2), scaled(material, level), random_rotation(rng)))
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
        elements.append(ellipsoid(ball.centre, np.full(3, r), Soft(edge / r), scaled(material, -1.0)))
        x, y, z = ball.centre.tolist()
        sinks.append(Sink((x, y, z), CORE * (r - 0.5 * edge), float(share) / duration * ball.volume))
    return CarriedScene(ContinuousScene(tuple(elements)), Sinks(tuple(sinks)), radius, edge / EDGE_POINTS)


CHUNK = 1 << 15
"""Points that are evaluated at once, which caches hold."""
RAYS = 256
"""Rays of a pixel row that are summed at once."""
PER_VOXEL = 3
"""Points a voxel's edge for the mean over a voxel."""


class Motion(Protocol):
    """A map of space that grows with time from the identity at time 0."""

    def back(self, points: np.ndarray, time: float) -> np.ndarray:
        """Trace `points` [3, P] [m] from `time` [s] back to time 0."""
        ...

    def forth(self, points: np.ndarray, time: float) -> np.ndarray:
        """Trace `points` [3, P] [m] from time 0 to `time` [s]."""
        ...


@dataclass(frozen=True)
class Twist:
    """Turns about an axis, by less the further from it: a vortex, whose velocity has no divergence.

    centre, axis: `(x, y, z)`, a point [m] of the axis and its direction; rate: of the turning on the axis [rad/s];
    width: distance w [m] from the axis ρ, of `exp(-ρ²/2w²)`, by which it falls.
    """

    centre: tuple[float, float, float]
    axis: tuple[float, float, float]
    rate: float
    width: float

    def back(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`."""
        return self.forth(points, -time)

    def forth(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`; by Rodrigues' formula, at a distance from the axis that does not change."""
        along = np.asarray(self.axis, dtype=np.float64)[:, None]
        along = along / np.linalg.norm(along)
        centre = np.asarray(self.centre)[:, None]
        x, y, z = away = points - centre
        height = (along * away).sum(0)
        angle = self.rate * time * np.exp((height**2 - (away * away).sum(0)) / (2 * self.width**2))
        c, s = np.cos(angle), np.sin(angle)
        (u, v, w), shift = along, height * (1 - c)
        crossed = np.stack([v * z - w * y, w * x - u * z, u * y - v * x])
        return away * c + crossed * s + along * shift + centre


@dataclass(frozen=True)
class Sink:
    """Draws matter towards a point, where it vanishes in a ball about it; beyond the ball no volume changes.

    centre: `(x, y, z)` [m]; core: radius [m] of the ball at time 0; loss: of its volume [m³/s], which goes on until
    `least` of it is left. Beyond the core `r³` falls by `3/4π` of the lost volume; inside, lengths shrink alike.
    """

    centre: tuple[float, float, float]
    core: float
    loss: float
    least: float = 0.02

    def _lost(self, time: float) -> float:
        """`r³` that is lost [m³]."""
        most = (1 - self.least) * self.core**3
        return float(np.clip(3 * self.loss * time / (4 * np.pi), 0.0, most))

    def back(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`."""
        lost = self._lost(time)
        return self._grown(points, lost, self.core**3 - lost)

    def forth(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`."""
        return self._grown(points, -self._lost(time), self.core**3)

    def _grown(self, points: np.ndarray, more: float, inner: float) -> np.ndarray:
        """Points whose `r³` about the centre is by `more` larger, within `inner` in proportion."""
        centre = np.asarray(self.centre)[:, None]
        away = points - centre
        cube = np.power((away * away).sum(0), 1.5)
        return centre + away * np.cbrt(1 + more / np.maximum(cube, inner))


@dataclass(frozen=True)
class Chain:
    """Motions one after another: matter goes through the first one first."""

    motions: tuple[Motion, ...]

    def back(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`."""
        for motion in reversed(self.motions):
            points = motion.back(points, time)
        return points

    def forth(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`."""
        for motion in self.motions:
            points = motion.forth(points, time)
        return points


@dataclass(frozen=True)
class Sinks:
    """Sinks in turn, each about the point to which those before it have drawn its centre.

    A ball about a later centre becomes slightly oval by the pull of earlier ones, and its sink does not.
    """

    sinks: tuple[Sink, ...]

    def back(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`."""
        return Chain(tuple(self.placed(time))).back(points, time)

    def forth(self, points: np.ndarray, time: float) -> np.ndarray:
        """See `Motion`."""
        return Chain(tuple(self.placed(time))).forth(points, time)

    def placed(self, time: float) -> list[Sink]:
        """The sinks about the points that they have at `time` [s]."""
        found: list[Sink] = []
        for sink in self.sinks:
            centre = np.array([sink.centre]).T
            for before in found:
                centre = before.forth(centre, time)
            x, y, z = centre[:, 0].tolist()
            found.append(replace(sink, centre=(x, y, z)))
        return found


@dataclass(frozen=True)
class Fades:
    """How δ and β of matter change with time, whatever its place: linearly, by `lost` of them a `duration` [s]; at a
    time at which none would be left, there is none. Errors: `InputError` for numbers out of range."""

    lost: float
    duration: float = 1.0

    def __post_init__(self) -> None:
        require(self.lost <= 1, f"lost must be 1 at most, all matter, but it is {self.lost:g}.")
        in_range("duration", self.duration, 1e-12, 1e9, unit="seconds")

    def left(self, time: float) -> float:
        """The share that is left at `time` [s]."""
        return max(1 - self.lost * time / self.duration, 0.0)


@dataclass(frozen=True)
class CarriedScene:
    """A continuous scene that a motion carries along; as it stands, that of time 0.

    scene: at time 0; motion: how it goes on; reach: radius [m] of the ball about the origin that matter never leaves;
    step: from point to point along a ray [m], a sixth of the narrowest edge; moment: [s] the time of this object;
    fades: the remaining share of all matter with time.
    Errors: `InputError` for lengths out of range.
    """

    scene: ContinuousScene
    motion: Motion
    reach: float
    step: float
    moment: float = 0.0
    fades: Fades = Fades(0.0)

    def __post_init__(self) -> None:
        in_range("reach", self.reach, 1e-9, 1.0, unit="metres")
        in_range("step", self.step, 1e-12, self.reach, unit="metres")
        finite("moment", np.array([self.moment]))

    def at(self, time: float) -> CarriedScene:
        """The scene as it is at `time` [s]."""
        return replace(self, moment=float(time))

    def missing_field(self, views: Views) -> float:
        """How far [m] the ball that holds the scene reaches beyond the detector in the worst view."""
        return float((np.abs(views.shifts) + self.reach - 0.5 * views.fields).max())

    def shares(self, points: np.ndarray) -> np.ndarray:
        """δ and β [2, P] at `points` [3, P] `(x, y, z)` [m]."""
        found = np.zeros((2, points.shape[1]))
        for start in range(0, points.shape[1], CHUNK):
            part = slice(start, start + CHUNK)
            before = self.motion.back(points[:, part], self.moment)
            for element in self.scene.elements:
                _add(found[:, part], element, before)
        return found * self.fades.left(self.moment)

    def project(self, views: Views) -> LineIntegrals:
        """Line integrals of each of the scene's `kinds`, float64: sums of points `step` apart on the pixels' rays."""
        views.parallel("a specimen carried by a flow")
        kinds = self.scene.kinds
        channels = np.zeros((len(views), len(kinds), *views.shape))
        count = int(np.ceil(2 * self.reach / self.step))
        depths = (np.arange(count) + 0.5) * (2 * self.reach / count) - self.reach
        for v, of_view in enumerate(channels.reshape(len(views), len(kinds), -1)):
            (h, w), (sx, sy), p = views.shape, views.shifts[v], float(views.pixel_sizes[v])
            x, y = (np.arange(w) + 0.5 - w / 2) * p + sx, (np.arange(h) + 0.5 - h / 2) * p + sy
            flat = np.stack([one.ravel() for one in np.broadcast_arrays(x[None, :], y[:, None])])
            inside = np.flatnonzero((flat * flat).sum(0) < self.reach**2)
            for at in np.array_split(inside, max(1, len(inside) // RAYS)):
                found = self._lines(flat[:, at], depths, views.rotations[v])
                of_view[:, at] = found[:1] / kinds[0].delta if len(kinds) == 1 else found
        return LineIntegrals(torch.from_numpy(channels), tuple((k.delta, k.beta) for k in kinds))

    def _lines(self, rays: np.ndarray, depths: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """∫δ and ∫β [2, R] [m] on `rays` [2, R] of a view."""
        half = np.sqrt(self.reach**2 - (rays * rays).sum(0))
        ray, depth = np.nonzero(np.abs(depths) < half[:, None])
        points = rotation.T @ np.stack([*rays[:, ray], depths[depth]])
        values = self.shares(points) * (depths[1] - depths[0])
        return np.stack([np.bincount(ray, one, rays.shape[1]) for one in values])

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β averaged over voxels, from `PER_VOXEL`³ points of each that the ball touches."""
        x, y, z = grid.axes()
        middles = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1]).reshape(3, -1)
        near = np.flatnonzero(np.linalg.norm(middles, axis=0) < self.reach + np.linalg.norm(grid.voxel_size))
        values, size = np.zeros((2, middles.shape[1])), np.array(grid.voxel_size)
        ticks = (np.arange(PER_VOXEL) + 0.5) / PER_VOXEL - 0.5
        for offset in np.stack(np.meshgrid(ticks, ticks, ticks), -1).reshape(-1, 3):
            values[:, near] += self.shares(middles[:, near] + (offset * size)[:, None]) / PER_VOXEL**3
        delta, beta = values.reshape(2, *grid.shape)
        return Volume(delta, beta, grid)


def _add(found: np.ndarray, element: Element, points: np.ndarray) -> None:
    """Add δ and β of an element at `points` [3, P] to `found` [2, P]."""
    away = points - element.centre[:, None]
    within = np.flatnonzero(
        (away * away).sum(0) < (element.profile.reach * np.linalg.norm(element.axes, axis=1).max()) ** 2
    )
    if len(within):
        near = away[:, within]
        share = element.profile.density(np.square(element.inverse @ near).sum(0)) * (1 + element.gradient @ near)
        found[0, within] += element.matter.delta * share
        found[1, within] += element.matter.beta * share
