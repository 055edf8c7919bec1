"""Fluids that may fill the field: bubbles, a cuvette, a jet, its break-up, and a shock, each drawn from a seed.

Lengths named `size` are in metres; all others are shares of it. Matter is said against the medium.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from holosplat.checks import InputError, require
from holosplat.mesh import TriangleMesh
from holosplat.ranges import Many, ManyOrNone, Share, Small, SomeShare, checked_dataclass
from holosplat.specimens.continuous import NODES, WEIGHTS, ContinuousScene, Soft, ellipsoid
from holosplat.specimens.drawn import Drawn, FieldKind, Named, Substances
from holosplat.specimens.phantoms import Ball

from .rods import RodScene, random_bubbles
from .shapes import LONG, SHARE, ball_meshes, column, lathe, meshed, region

PIECES = 8
"""Pieces of a ray that are integrated one by one: with a tail of a twentieth, right to 1e-6 of the largest integral."""


@checked_dataclass
class Blast:
    """Friedlander's wave, `(1 - x) exp(-x)` with `x = (1 - s) / tail`, behind a front at `s = 1`.

    One at the front and nothing before it (the jump), compression as far as `tail` behind it, and then rarefaction,
    of at most e⁻² of the jump (Friedlander 1946, Proc. R. Soc. A 186, 322; of pressure, and so of density where the
    shock is weak). Within `core_radius` there is nothing. `InputError` where that reaches the front.
    """

    tail: SomeShare = 0.15
    """Length behind the front after which compression ends, in units of the front's radius."""
    core_radius: Share = 0.0
    """Radius within which there is nothing, in units of the front's radius."""
    reach, core = 1.0, 0.0

    def __post_init__(self) -> None:
        require(
            self.core_radius < 1, f"core_radius must be below 1, the front's radius, but it is {self.core_radius:g}."
        )

    @property
    def mass(self) -> float:
        """By Gauss and Legendre, piece by piece."""
        edges = np.linspace(self.core_radius, 1, PIECES + 1)
        half = 0.5 * np.diff(edges)[:, None]
        s = edges[:-1, None] + half * (1 + NODES)
        return float((half * WEIGHTS * self._wave(s) * 4 * math.pi * s**2).sum())

    def density(self, s2: np.ndarray) -> np.ndarray:
        """The profile."""
        return np.where((s2 < 1) & (s2 >= self.core_radius**2), self._wave(np.sqrt(s2)), 0.0)

    def chord(self, b2: np.ndarray) -> np.ndarray:
        """By Gauss and Legendre along the ray, from the core to the front in pieces."""
        inner = np.sqrt(np.maximum(self.core_radius**2 - b2, 0))
        half = 0.5 * (np.sqrt(np.maximum(1 - b2, 0)) - inner) / PIECES
        total = np.zeros_like(inner)
        for piece in range(PIECES):
            for node, weight in zip(NODES, WEIGHTS):
                total += 2 * weight * half * self._wave(np.sqrt(b2 + (inner + half * (2 * piece + 1 + node)) ** 2))
        return total

    def _wave(self, s: np.ndarray) -> np.ndarray:
        x = (1 - s) / self.tail
        return (1 - x) * np.exp(-np.maximum(x, 0))


FASTEST = 9.02
"""Wavelength of the disturbance of a jet that grows fastest, in radii (Rayleigh 1878, Proc. Lond. Math. Soc. 10, 4)."""
SATELLITE = 0.03
"""Share of a wave's volume in the small drop that a breaking jet leaves between two large ones."""
SLIP = 2.0
"""How far threads of a spray may be shifted along the axis, in radii of a thread."""
TRIES = 10_000
"""Random places that are tried for one thread of a spray."""


@checked_dataclass
class Bubbles(FieldKind):
    """Gas bubbles in a medium that fills the field and goes on beyond it."""

    kind: ClassVar[str] = "bubbles"
    goes_on: ClassVar[bool] = True
    named: ClassVar[Named] = ("air", None, "water")
    extent: ClassVar[float] = 0.85
    size: Small
    """Diameter and height of the cylinder about the rotation axis in which they lie [m]."""
    count: Many = 9
    """Their number."""
    radii: tuple[SomeShare, SomeShare] = (0.05, 0.14)
    """Radii of the smallest and of the largest; the others lie evenly between them."""
    overlap: bool = False
    """Whether bubbles may overlap, as those that merge."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The bubbles that `seed` gives."""
        low, high = self.radii
        radii, box = (low * self.size, high * self.size), (self.size, self.size, self.size)
        scene = random_bubbles(self.count, radii, box, substances.contrast, seed, overlapping=self.overlap)
        return Drawn(scene, f"{self.count} bubbles, seed {seed}", {"bubbles": RodScene(scene.rods, SHARE)})


@checked_dataclass
class Flotation(FieldKind):
    """Gas bubbles and solid beads, the core, in a liquid that fills the field and goes on beyond it."""

    kind: ClassVar[str] = "flotation"
    has_core: ClassVar[bool] = True
    goes_on: ClassVar[bool] = True
    named: ClassVar[Named] = ("air", "glass", "water")
    extent: ClassVar[float] = 0.85
    size: Small
    """Diameter and height of the cylinder about the rotation axis in which they lie [m]."""
    count: Many = 5
    """Number of bubbles."""
    beads: Many = 4
    """Number of beads."""
    radii: tuple[SomeShare, SomeShare] = (0.06, 0.13)
    """Radii of the smallest and of the largest; the others lie evenly between them."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The bubbles and beads that `seed` gives."""
        rng, solid = np.random.default_rng(seed), substances.within(self.kind).against(substances.medium)
        whole = (self.size, self.size, self.size)
        balls = ball_meshes(self.count + self.beads, self.radii, self.size, whole, rng, "cylinder")
        order = rng.permutation(len(balls))
        bubbles, beads = ([balls[k] for k in chosen] for chosen in (order[: self.count], order[self.count :]))
        parts = {"bubbles": region(*bubbles), "beads": region(*beads)}
        text = f"{self.count} bubbles and {self.beads} beads, seed {seed}"
        return Drawn(meshed([(bubbles, substances.contrast), (beads, solid)]), text, parts)


@checked_dataclass
class Cuvette(FieldKind):
    """A square tube about the rotation axis, which goes on above and below: its wall, a liquid, bubbles in that.

    The material is the wall's, the core is the liquid, and bubbles hold what is around the tube.
    """

    kind: ClassVar[str] = "cuvette"
    has_core: ClassVar[bool] = True
    goes_on: ClassVar[bool] = True
    named: ClassVar[Named] = ("glass", "water", None)
    extent: ClassVar[float] = 0.6
    size: Small
    """Outer width [m]."""
    count: Many = 5
    """Number of bubbles."""
    wall: SomeShare = 0.08
    """Thickness of the wall."""
    radii: tuple[SomeShare, SomeShare] = (0.05, 0.15)
    """Radii of the smallest and of the largest bubble."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The bubbles that `seed` gives, in the tube."""
        require(self.wall < 0.4, f"wall must be below 0.4 of the size, but it is {self.wall:g}.")
        wide, liquid = self.size * (1 - 2 * self.wall), substances.within(self.kind)
        bubbles = ball_meshes(self.count, self.radii, self.size, (wide, 1.4 * self.size, wide), seed, "box")
        outer, inner = (column(width, width, LONG * self.size) for width in (self.size, wide))
        fillings = [([outer], substances.contrast), ([inner], liquid.against(substances.material))]
        scene = meshed([*fillings, (bubbles, substances.medium.against(liquid))])
        parts = {"wall": region(outer, without=[inner]), "bubbles": region(*bubbles)}
        return Drawn(scene, f"a cuvette with {self.count} bubbles, seed {seed}", parts)


@checked_dataclass
class Jet(FieldKind):
    """A liquid jet along the rotation axis, which swells and narrows as Rayleigh's disturbance makes it, with bubbles.

    It goes on above and below. Bubbles hold what is around the jet.
    """

    kind: ClassVar[str] = "jet"
    goes_on: ClassVar[bool] = True
    named: ClassVar[Named] = ("water", None, None)
    extent: ClassVar[float] = 0.45
    size: Small
    """Diameter of the undisturbed jet [m]."""
    count: ManyOrNone = 4
    """Number of bubbles."""
    radii: tuple[SomeShare, SomeShare] = (0.06, 0.15)
    """Radii of the smallest and of the largest bubble."""
    amplitude: Share = 0.25
    """Of the disturbance, in radii of the jet."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The phase of the disturbance and the bubbles that `seed` gives."""
        require(self.amplitude < 0.7, f"amplitude must be below 0.7 of the radius, but it is {self.amplitude:g}.")
        rng = np.random.default_rng(seed)
        radius, start = 0.5 * self.size, rng.uniform(0, 2 * np.pi)
        wave = FASTEST * radius
        heights = 2 * wave * np.linspace(-1, 1, 257)
        swelling = 1 + self.amplitude * np.cos(2 * np.pi * heights / wave + start)
        # the disturbance takes volume from necks to swellings: the mean section stays that of the jet
        outer = lathe(heights, radius / np.sqrt(1 + 0.5 * self.amplitude**2) * swelling, "jet")
        narrow = 0.95 * self.size * (1 - self.amplitude) / np.sqrt(1 + 0.5 * self.amplitude**2)
        box = (narrow, 2 * self.size, narrow)
        bubbles = ball_meshes(self.count, self.radii, self.size, box, rng, "cylinder")
        scene = meshed([([outer], substances.contrast), (bubbles, substances.medium.against(substances.material))])
        parts = {"bubbles": region(*bubbles)} if bubbles else {}
        return Drawn(scene, f"a jet with {self.count} bubbles, seed {seed}", parts)


@checked_dataclass
class BreakUp(FieldKind):
    """Threads of liquid along the rotation axis that broke up into drops, satellites and ligaments.

    A thread of radius a breaks at `waves` wavelengths of λ = 9.02 a. Each wave's volume π a² λ becomes a drop,
    flattened or drawn out, with a satellite before the next; some pairs are joined in a ligament yet.
    """

    kind: ClassVar[str] = "break-up"
    named: ClassVar[Named] = ("water", None, None)
    extent: ClassVar[float] = 0.82
    size: Small
    """Height and diameter of the spray [m]."""
    count: Many = 4
    """Number of threads."""
    waves: Many = 3
    """Wavelengths of a thread."""
    ligaments: Share = 0.4
    """Chance that two waves that follow each other are joined yet."""

    @property
    def radius(self) -> float:
        """Of a thread before it broke [m]."""
        return self.size / (FASTEST * self.waves + 2 * SLIP)

    @property
    def volume(self) -> float:
        """Of all threads [m³], before and after."""
        return self.count * self.waves * FASTEST * np.pi * self.radius**3

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The spray that `seed` gives."""
        rng = np.random.default_rng(seed)
        groups: dict[str, list[TriangleMesh]] = {"drops": [], "satellites": [], "ligaments": []}
        for place in self._places(rng):
            self._break(rng, place, groups)
        bodies = [mesh for meshes in groups.values() for mesh in meshes]
        parts = {name: region(*meshes) for name, meshes in groups.items() if meshes}
        text = ", ".join(f"{len(meshes)} {name}" for name, meshes in groups.items())
        return Drawn(meshed([(bodies, substances.contrast)]), f"{text}, seed {seed}", parts)

    def _places(self, rng: np.random.Generator) -> np.ndarray:
        """Axes (x, z) [count, 2] [m] of the threads, so far apart that their drops cannot touch."""
        a, found = self.radius, np.empty((0, 2))
        reach, apart = 0.5 * self.size - 2.5 * a, 5 * a
        for _ in range(self.count):
            tries = rng.uniform(-reach, reach, (TRIES, 2))
            away = np.linalg.norm(tries[:, None] - found, axis=-1)
            free = tries[(np.hypot(*tries.T) <= reach) & (away >= apart).all(axis=1)]
            if not len(free):
                raise InputError(
                    f"{self.count} threads must fit beside each other, but only {len(found)} do; take fewer, or more "
                    "waves, of which threads are thinner."
                )
            found = np.concatenate([found, free[:1]])
        return found

    def _break(self, rng: np.random.Generator, place: np.ndarray, groups: dict[str, list[TriangleMesh]]) -> None:
        """Add the bodies of one thread."""
        a, wave = self.radius, FASTEST * self.radius
        volume, n = np.pi * a**2 * wave, 0
        begin = -0.5 * self.waves * wave + SLIP * a * rng.uniform(-1, 1)
        while n < self.waves:
            joined = n + 1 < self.waves and rng.random() < self.ligaments
            last = n + (2 if joined else 1) == self.waves
            centre = np.array([place[0], begin + (n + (1.0 if joined else 0.5)) * wave, place[1]])
            centre[[0, 2]] += 0.3 * a * rng.uniform(-1, 1, 2)
            share = 1.0 if last else 1 - SATELLITE
            if joined:
                groups["ligaments"].append(_ligament(centre, 1.5 * wave, (1 + share) * volume))
            else:
                groups["drops"].append(_drop(centre, share * volume, rng.uniform(0.9, 1.12)))
            n += 2 if joined else 1
            if not last:
                small = Ball(np.array([place[0], begin + n * wave, place[1]]), _diameter(SATELLITE * volume))
                groups["satellites"].append(small.mesh(4, "satellite"))


@checked_dataclass
class Shock(FieldKind):
    """A decaying spherical shock in a medium that fills the field: a jump, compression, rarefaction, and its bubble.

    δ and β of the medium rise by `jump` at the front (`specimens.fluids`); the material fills the bubble in its middle.
    """

    kind: ClassVar[str] = "shock"
    goes_on: ClassVar[bool] = True
    named: ClassVar[Named] = ("air", None, "water")
    extent: ClassVar[float] = 0.8
    size: Small
    """Diameter of the front [m]."""
    jump: SomeShare = 0.1
    """By how much the density rises at the front, in units of the medium's."""
    tail: SomeShare = 0.15
    """Length behind the front after which compression ends, in radii of the front."""
    bubble: Share = 0.2
    """Radius of the bubble, in radii of the front (0: none)."""
    shift: Share = 0.05
    """Distance of its centre from the middle of the field, in a random direction."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The shock about the place that `seed` gives."""
        medium = substances.medium
        require(medium.delta != 0, "a shock needs a medium that it compresses; name it, such as water.")
        way = np.random.default_rng(seed).normal(size=3)
        centre, radius = self.shift * self.size * way / np.linalg.norm(way), 0.5 * self.size
        wave = Blast(self.tail, self.bubble)
        denser = type(medium)(self.jump * medium.delta, self.jump * medium.beta)
        elements, parts = [ellipsoid(centre, (radius,) * 3, wave, denser)], {}
        if self.bubble > 0:
            inner = (self.bubble * radius,) * 3
            elements.append(ellipsoid(centre, inner, Soft(0.0), substances.contrast))
            parts["bubbles"] = ContinuousScene((ellipsoid(centre, inner, Soft(0.0), SHARE),))
        text = f"a shock {'about a bubble' if self.bubble else 'without a bubble'}, seed {seed}"
        return Drawn(ContinuousScene(tuple(elements)), text, parts)


def _drop(centre: np.ndarray, volume: float, aspect: float) -> TriangleMesh:
    """A spheroid of `volume` [m³] whose axis along y is `aspect` times its diameter across."""
    ball = Ball(np.zeros(3), _diameter(volume)).mesh(4, "drop")
    across = aspect ** (-1 / 3)
    return ball.transformed(np.diag([across, aspect * across, across]), centre)


def _ligament(centre: np.ndarray, length: float, volume: float) -> TriangleMesh:
    """Two bulbs joined by a thin neck, of `length` along y and `volume` [m³]."""
    u = -np.cos(np.pi * np.linspace(0, 1, 97))
    radii = np.sqrt(np.maximum(1 - u**8, 0)) * (0.25 + 0.75 * u**2)
    heights = 0.5 * length * u
    scale = np.sqrt(volume / lathe(heights, radii * length, "ligament").volume) * length
    return lathe(heights, scale * radii, "ligament").transformed(np.eye(3), centre)


def _diameter(volume: float) -> float:
    """Of the ball of `volume` [m³]."""
    return float((6 * volume / np.pi) ** (1 / 3))
