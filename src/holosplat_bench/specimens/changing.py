"""Matter that changes its shape or its topology in time: drops that merge, a bubble that collapses, a jet that breaks,
a lattice that is crushed, and what `carried` moves (in `gas_waves`, a shock that runs). Each kind is drawn anew at
every time.

As of `specimens.drawn`, lengths are shares of `size`. Times are shares of the course: 0 at the first frame, 1 at the
last; a `Drawn` is spread over seconds by `Drawn.over`.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import ClassVar

import numpy as np
from scipy.integrate import OdeSolution, solve_ivp
from scipy.optimize import root_scalar
from scipy.special import iv, logsumexp

from holosplat.checks import require
from holosplat.matter import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.ranges import Many, Positive, Share, Signed, Small, SomeShare, checked_dataclass
from holosplat.specimens.continuous import random_direction, random_rotation
from holosplat.specimens.drawn import ChangingScene, Drawn, FieldKind, Named, Substances
from holosplat.specimens.phantoms import Ball, unit_ball
from holosplat.specimens.scene import MeshScene

from .carried import collapsing_foam, stirred_blob
from .fluids import FASTEST
from .rods import Rod, RodScene
from .shapes import LONG, SHARE, lathe, meshed, region
from .solids import Lattice

ROWS = 193
"""Circles of a body of revolution."""


@checked_dataclass
class MergingDrops(FieldKind):
    """Two drops that approach, touch, and flow together into one ball, their volume and their centre kept.

    From contact on the surface is `Σ exp(-(|x - cᵢ| - Rᵢ)/k) = 1`, grown to the volume of both: k grows evenly, and so
    the neck with the root of the time, as where inertia resists (Eggers, Lister & Stone 1999, J. Fluid Mech. 401, 293).
    """

    kind: ClassVar[str] = "merging-drops"
    changes: ClassVar[bool] = True
    named: ClassVar[Named] = ("water", None, None)
    extent: ClassVar[float] = 0.8
    size: Small
    """Length of both drops with their gap at the first time [m]."""
    ratio: SomeShare = 0.8
    """Radius of the smaller drop over that of the larger one."""
    gap: Share = 0.2
    """Gap at the first time, in radii of the larger drop."""
    contact: SomeShare = 0.35
    """Share of the course at which they touch."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The drops on the line that `seed` gives."""
        turn = random_rotation(np.random.default_rng(seed))
        drops = ChangingScene(lambda share: meshed([(self._bodies(share, turn), substances.contrast)]))
        parts = {"drops": ChangingScene(lambda share: region(*self._bodies(share, turn)))}
        return Drawn(drops, f"two drops that merge, seed {seed}", parts)

    @property
    def radii(self) -> np.ndarray:
        """Of both drops [2] [m]."""
        return self.size / (2 + 2 * self.ratio + self.gap) * np.array([1.0, self.ratio])

    def _bodies(self, share: float, turn: np.ndarray) -> list[TriangleMesh]:
        radii = self.radii
        after = min((share - self.contact) / (1 - self.contact), 1.0)
        apart = radii.sum() * (1 - max(after, 0.0) ** 2) + radii[0] * self.gap * max(1 - share / self.contact, 0.0)
        places = np.array([-1.0, 1.0]) * apart * radii[::-1] ** 3 / (radii**3).sum()
        if after <= 0:
            pairs = enumerate(zip(places, radii))
            return [Ball(turn[1] * at, 2 * radius).mesh(4, f"drop{n}") for n, (at, radius) in pairs]
        body = _united(places, radii, 0.3 * after * radii.mean())
        grown = (4 / 3 * np.pi * (radii**3).sum() / body.volume) ** (1 / 3)
        corners = body.vertices[body.faces]  # each triangle makes a tetrahedron with the origin
        middle = np.linalg.det(corners) @ corners.sum(axis=1) / (24 * body.volume)
        return [body.transformed(grown * turn.T, -grown * turn.T @ middle)]


def _united(places: np.ndarray, radii: np.ndarray, width: float) -> TriangleMesh:
    """Two balls about `places` [2] on the y axis, joined smoothly over `width` [m]."""

    def level(y: np.ndarray, r: np.ndarray) -> np.ndarray:
        away = np.hypot(np.subtract.outer(y, places), r[..., None]) - radii
        return -width * logsumexp(-away / width, axis=-1)

    far = 2 * radii.sum()
    sides = zip(places, (-far, far))
    ends = [root_scalar(lambda y: level(np.array(y), np.zeros(())), bracket=(at, at + way)).root for at, way in sides]
    y = ends[0] + (ends[1] - ends[0]) * 0.5 * (1 - np.cos(np.pi * np.linspace(0, 1, ROWS)))
    low, high = np.zeros(ROWS), np.full(ROWS, far)
    for _ in range(48):
        middle = 0.5 * (low + high)
        inside = level(y, middle) < 0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return lathe(y, np.where(low < 1e-9 * far, 0.0, low), "drops")


ADIABATIC = 1.4
"""Exponent of the gas in a bubble."""
RAYLEIGH = 0.914681
"""Time in which an empty bubble collapses, in R √(ρ/p) (Rayleigh 1917, Phil. Mag. 34, 94)."""


@lru_cache(maxsize=8)
def bubble_radius(gas: float, mach: float, until: float, least: float = 1e-3) -> OdeSolution:
    """Radius and its rate of a bubble that collapses from rest, in units of its radius R and R √(ρ/p), up to `until`.

    By Keller & Miksis (1980, J. Acoust. Soc. Am. 68, 628); with `mach` 0 that is Rayleigh & Plesset's. gas: pressure in
    it at first over the pressure p around it; mach: √(p/ρ) over the speed of sound. It ends at the radius `least`.
    """

    def rates(_: float, state: np.ndarray) -> list[float]:
        r, v = state
        inside = gas * r ** (-3 * ADIABATIC)
        push = (1 + mach * v) * (inside - 1) - 3 * ADIABATIC * mach * inside * v
        return [v, (push - 1.5 * v * v * (1 - mach * v / 3)) / (r * (1 - mach * v))]

    def gone(_: float, state: np.ndarray) -> float:
        return state[0] - least

    gone.terminal = True  # type: ignore[attr-defined]
    found = solve_ivp(rates, (0, until), [1.0, 0.0], "LSODA", dense_output=True, events=gone, rtol=1e-9, atol=1e-12)
    return found.sol


@checked_dataclass
class Collapse(FieldKind):
    """A bubble in a liquid jet along the rotation axis that collapses, pierced by a jet of its own from one side.

    Its volume is that of Keller & Miksis' bubble. The liquid keeps its volume: the jet bulges where the bubble is.
    """

    kind: ClassVar[str] = "collapse"
    changes: ClassVar[bool] = True
    named: ClassVar[Named] = ("water", None, None)
    goes_on: ClassVar[bool] = True
    extent: ClassVar[float] = 0.55
    size: Small
    """Diameter of the jet without the bubble [m]."""
    bubble: SomeShare = 0.6
    """Diameter of the bubble at first."""
    course: Positive = 1.0
    """From the first time to the last, in times of Rayleigh's collapse."""
    gas: Share = 0.02
    """Pressure in the bubble at first over that around it."""
    mach: Share = 0.05
    """√(p/ρ) over the speed of sound: what a rebound loses."""
    dent: Share = 0.6
    """How deep its own jet is when the bubble is gone, in radii of the bubble."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The bubble, off the axis and pierced as `seed` says."""
        require(self.bubble <= 0.8, f"bubble must be at most 0.8 of the size, but it is {self.bubble:g}.")
        require(self.dent <= 0.9, f"dent must be at most 0.9 of the radius, but it is {self.dent:g}.")
        rng = np.random.default_rng(seed)
        way, angle = random_direction(rng), rng.uniform(0, 2 * np.pi)
        off = 0.5 * rng.uniform(0, 0.9 - self.bubble) * self.size
        centre = off * np.array([np.cos(angle), 0.0, np.sin(angle)])
        gas = substances.medium.against(substances.material)

        def jet(share: float) -> tuple[TriangleMesh, TriangleMesh]:
            radius, first = self.radius(share), 0.5 * self.bubble * self.size
            vertices, faces = unit_ball(4)
            turned = np.arccos(np.clip(vertices @ way, -1, 1))
            depth = self.dent * (1 - (radius / first) ** 3)
            shape = TriangleMesh(vertices * (1 - depth * np.exp(-((turned / 0.6) ** 2)))[:, None], faces, "bubble")
            grown = radius * (4 / 3 * np.pi / shape.volume) ** (1 / 3)
            bubble = shape.transformed(grown * np.eye(3), centre)
            return self._column(bubble.volume), bubble

        def scene(share: float) -> MeshScene:
            outer, bubble = jet(share)
            return meshed([([outer], substances.contrast), ([bubble], gas)])

        parts = {"bubbles": ChangingScene(lambda share: region(jet(share)[1]))}
        return Drawn(ChangingScene(scene), f"a bubble that collapses in a jet, seed {seed}", parts)

    def radius(self, share: float) -> float:
        """Radius [m] of the ball of the bubble's volume at a share of the course; before the first time as after it."""
        until = 1.5 * self.course * RAYLEIGH
        found = bubble_radius(self.gas, self.mach, until)
        at = min(abs(share) * self.course * RAYLEIGH, float(found.t_max))
        return 0.5 * self.bubble * self.size * max(float(found(at)[0]), 1e-3)

    def _column(self, volume: float) -> TriangleMesh:
        a = 0.5 * self.size
        y = a * np.sort(np.concatenate([np.linspace(-4, 4, ROWS), [-LONG, LONG]]))
        bulge = volume * np.exp(-0.5 * (y / a) ** 2) / (np.sqrt(2 * np.pi) * a)
        return lathe(y, np.sqrt(a**2 + bulge / np.pi), "jet")


def growth_rate(wave_number: float) -> float:
    """Rate at which a disturbance of a jet grows, in √(σ/ρa³), of the wave number in 1/a (Rayleigh 1878)."""
    k = wave_number
    return float(np.sqrt(max(k * (1 - k * k) * iv(1, k) / iv(0, k), 0.0)))


@checked_dataclass
class PinchingJet(FieldKind):
    """A jet along the rotation axis that Rayleigh and Plateau's disturbance breaks into drops, its volume kept.

    The fastest wave grows from rest as `cosh ωt` until its necks close; each wave's liquid then draws together into a
    ball, by the end of the course. It goes on above and below.
    """

    kind: ClassVar[str] = "pinching-jet"
    changes: ClassVar[bool] = True
    named: ClassVar[Named] = ("water", None, None)
    goes_on: ClassVar[bool] = True
    extent: ClassVar[float] = 0.16
    size: Small
    """Diameter of the undisturbed jet [m]."""
    amplitude: SomeShare = 0.15
    """Of the disturbance at the first time, in radii of the jet."""
    pinch: SomeShare = 0.6
    """Share of the course at which necks close."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The jet, with the phase of the disturbance that `seed` gives."""
        require(self.amplitude < 0.7, f"amplitude must be below 0.7 of the radius, but it is {self.amplitude:g}.")
        wave = 0.5 * self.size * FASTEST
        first = wave * np.random.default_rng(seed).uniform(-0.5, 0.5)

        def bodies(share: float) -> list[TriangleMesh]:
            return self._thread(share, first) if share < self.pinch else self._drops(share, first)

        scene = ChangingScene(lambda share: meshed([(bodies(share), substances.contrast)]))
        parts = {"liquid": ChangingScene(lambda share: region(*bodies(share)))}
        return Drawn(scene, f"a jet that breaks up, seed {seed}", parts)

    def swelling(self, share: float) -> float:
        """Amplitude of the disturbance, in radii that keep the volume, at a share of the course up to `pinch`."""
        rate = growth_rate(2 * np.pi / FASTEST)
        closes = np.arccosh(1 / self.amplitude) / rate
        return self.amplitude * float(np.cosh(rate * closes * share / self.pinch))

    def _thread(self, share: float, first: float) -> list[TriangleMesh]:
        a, swelling = 0.5 * self.size, self.swelling(share)
        y = first + FASTEST * a * np.linspace(-4.5, 4.5, 9 * 48 + 1)
        radii = a / np.sqrt(1 + 0.5 * swelling**2) * (1 + swelling * np.cos(2 * np.pi * (y - first) / (FASTEST * a)))
        return [lathe(y, radii, "jet")]

    def _drops(self, share: float, first: float) -> list[TriangleMesh]:
        a = 0.5 * self.size
        wave, ball = FASTEST * a, a * (0.75 * FASTEST) ** (1 / 3)
        round_ = min((share - self.pinch) / (1 - self.pinch), 1.0)
        u = -np.cos(np.pi * np.linspace(0, 1, ROWS))
        y = (1 - round_) * 0.5 * wave * u + round_ * ball * u
        closed = a / np.sqrt(1.5) * (1 + np.cos(np.pi * u))
        radii = (1 - round_) * closed + round_ * ball * np.sqrt(np.maximum(1 - u**2, 0))
        radii[[0, -1]] = 0.0
        drop = lathe(y, radii, "drop")
        grown = (np.pi * a**2 * wave / drop.volume) ** (1 / 3)
        return [drop.transformed(grown * np.eye(3), np.array([0, first + n * wave, 0])) for n in range(-4, 5)]


@checked_dataclass
class CrushedLattice(Lattice):
    """A lattice that is crushed along the rotation axis, most in a band in its middle, which bulges; struts keep their
    volume."""

    kind: ClassVar[str] = "crushed-lattice"
    changes: ClassVar[bool] = True
    strain: SomeShare = 0.25
    """Share of its height that it loses over the course."""
    bulge: Share = 0.2
    """Share by which it widens in its middle."""
    band: SomeShare = 0.25
    """Half width of the band."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The lattice without the struts that `seed` takes."""
        require(self.strain <= 0.4, f"strain must be at most 0.4, but it is {self.strain:g}.")
        still = super().drawn(substances, seed)
        assert isinstance(still.scene, RodScene)
        scene, struts = (self._crushed(still.scene.rods, matter) for matter in (substances.contrast, SHARE))
        return Drawn(scene, f"{still.text}, crushed", {"struts": struts})

    def moved(self, points: np.ndarray, share: float) -> np.ndarray:
        """Where matter at `points` [..., 3] (x, y, z) [m] is at a share of the course."""
        height, width = 0.5 * self.size, self.band * self.size
        strain, (x, y, z) = self.strain * share, np.moveaxis(points, -1, 0)
        wider = 1 + self.bulge * share / np.cosh(y / width) ** 2
        down = strain * height * np.tanh(y / width) / np.tanh(height / width)
        return np.stack([x * wider, y - down, z * wider], axis=-1)

    def _crushed(self, rods: tuple[Rod, ...], matter: DeltaBeta) -> ChangingScene:
        def rod(one: Rod, share: float) -> Rod:
            ends = self.moved(np.stack([one.start, one.end]), share)
            longer = np.linalg.norm(ends[1] - ends[0]) / np.linalg.norm(one.end - one.start)
            return Rod(ends[0], ends[1], one.radius / float(np.sqrt(longer)))

        return ChangingScene(lambda share: RodScene(tuple(rod(one, share) for one in rods), matter))


@checked_dataclass
class StirredBlob(FieldKind):
    """`carried.stirred_blob`: a graded body with soft lumps, stirred by two vortices."""

    kind: ClassVar[str] = "stirred-blob"
    changes: ClassVar[bool] = True
    named: ClassVar[Named] = (None, None, None)
    extent: ClassVar[float] = 0.85
    size: Small
    """Diameter of the ball that it never leaves [m]."""
    motion: Signed = 60.0
    """Turn of the middle of the first vortex over the course [degrees]."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The blob that `seed` gives."""
        scene = stirred_blob(self.size, substances.contrast, seed, math.radians(self.motion))
        return Drawn(ChangingScene(scene.at), f"a stirred blob, seed {seed}")


@checked_dataclass
class CollapsingFoam(FieldKind):
    """`carried.collapsing_foam`: a drop whose bubbles lose gas."""

    kind: ClassVar[str] = "collapsing-foam"
    changes: ClassVar[bool] = True
    named: ClassVar[Named] = (None, None, None)
    extent: ClassVar[float] = 0.85
    size: Small
    """Diameter of the drop at the first time [m]."""
    count: Many = 9
    """Bubbles."""
    edge: SomeShare = 0.04
    """Width of the edges."""
    motion: Share = 0.5
    """Share of the gas that is lost over the course."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The foam that `seed` gives."""
        edge = self.edge * self.size
        scene = collapsing_foam(self.size, substances.contrast, seed, self.motion, 1.0, self.count, edge)
        return Drawn(ChangingScene(scene.at), f"a foam of {self.count} bubbles that lose gas, seed {seed}")
