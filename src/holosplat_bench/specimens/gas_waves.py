"""Waves of a compressible fluid in one dimension, planar or spherical, by finite volumes, and a shock of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np

from holosplat.checks import require
from holosplat.ranges import Positive, Share, Small, SomeShare, checked_dataclass
from holosplat.specimens.continuous import ContinuousScene, Soft, ellipsoid, random_direction
from holosplat.specimens.drawn import ChangingScene, Drawn, FieldKind, Named, Substances

from .shapes import SHARE

COURANT = 0.4
"""Part of a cell that the fastest wave crosses in a step; the scheme is stable up to a half."""


@dataclass(frozen=True)
class Fluid:
    """A stiffened gas, `p + γ p∞ = (γ - 1) ρ e`: an ideal one for `stiffness` p∞ = 0, and liquids such as water with
    γ = 4.4 (Harlow & Amsden 1971, LA-4700)."""

    gamma: float
    stiffness: float = 0.0

    def sound(self, density: np.ndarray, pressure: np.ndarray) -> np.ndarray:
        """Speed of sound."""
        return np.sqrt(self.gamma * (pressure + self.stiffness) / density)

    def conserved(self, state: np.ndarray) -> np.ndarray:
        """Density, momentum and energy [3, N] of density, velocity and pressure [3, N]."""
        density, speed, pressure = state
        energy = (pressure + self.gamma * self.stiffness) / (self.gamma - 1) + 0.5 * density * speed**2
        return np.stack([density, density * speed, energy])

    def primitive(self, of: np.ndarray) -> np.ndarray:
        """Density, velocity and pressure [3, N] of what is conserved [3, N]."""
        density, momentum, energy = of
        speed = momentum / density
        pressure = (self.gamma - 1) * (energy - 0.5 * momentum * speed) - self.gamma * self.stiffness
        return np.stack([density, speed, pressure])

    def flux(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Fluxes [3, N] between states [3, N] at both sides: HLLC (Toro, Spruce & Speares 1994, Shock Waves 4, 25)."""
        (rl, ul, pl), (rr, ur, pr) = left, right
        cl, cr = self.sound(rl, pl), self.sound(rr, pr)
        first, last = np.minimum(ul - cl, ur - cr), np.maximum(ul + cl, ur + cr)
        ml, mr = rl * (first - ul), rr * (last - ur)
        middle = (pr - pl + ml * ul - mr * ur) / (ml - mr)
        found = np.where(middle >= 0, self._star(left, first, middle), self._star(right, last, middle))
        return np.where(first >= 0, self._plain(left), np.where(last <= 0, self._plain(right), found))

    def _plain(self, state: np.ndarray) -> np.ndarray:
        (_, speed, pressure), (density, momentum, energy) = state, self.conserved(state)
        return np.stack([density * speed, momentum * speed + pressure, (energy + pressure) * speed])

    def _star(self, state: np.ndarray, wave: np.ndarray, middle: np.ndarray) -> np.ndarray:
        (density, speed, pressure), of = state, self.conserved(state)
        push = density * (wave - speed)
        energy = of[2] / density + (middle - speed) * (middle + pressure / push)
        star = push / (wave - middle) * np.stack([np.ones_like(middle), middle, energy])
        return self._plain(state) + wave * (star - of)


def waves(
    state: np.ndarray, edges: np.ndarray, fluid: Fluid, times: Sequence[float] | np.ndarray, spherical: bool
) -> np.ndarray:
    """Density, velocity and pressure [T, 3, N] at rising `times`, from those of `state` [3, N] in the cells of `edges`.

    Of second order where the flow is smooth: slopes by minmod, steps by Heun. The fluid leaves the last edge freely,
    and the first, too, unless it is the middle of a `spherical` flow.
    """
    area = edges**2 if spherical else np.ones_like(edges)
    volume = np.diff(edges**3) / 3 if spherical else np.diff(edges)
    width, bend = volume / np.maximum(area[1:], area[:-1]), np.diff(area) / volume

    def rate(of: np.ndarray) -> np.ndarray:
        now = fluid.primitive(of)
        steps = np.diff(now, axis=1, prepend=now[:, :1], append=now[:, -1:])
        before, after = steps[:, :-1], steps[:, 1:]
        slope = np.where(before * after > 0, np.where(abs(before) < abs(after), before, after), 0.0)
        left = np.concatenate([now[:, :1], now + 0.5 * slope], axis=1)
        right = np.concatenate([now - 0.5 * slope, now[:, -1:]], axis=1)
        change = -np.diff(area * fluid.flux(left, right), axis=1) / volume
        change[1] += bend * now[2]
        return change

    of, at, found = fluid.conserved(state), 0.0, []
    for time in times:
        while at < time:
            density, speed, pressure = fluid.primitive(of)
            step = COURANT * float((width / (abs(speed) + fluid.sound(density, pressure))).min())
            step = min(step, time - at)
            once = of + step * rate(of)
            of, at = 0.5 * (of + once + step * rate(once)), at + step
        found.append(fluid.primitive(of))
    return np.stack(found)


CELLS, SNAPSHOTS = 240, 64
"""Cells to the last front, and kept times, of a shock."""
BEYOND = 1.05
"""Radii of the front out to which it is drawn: the scheme smears it over some cells, and it is at half its height."""
WATER = Fluid(4.4, 1 / 4.4)
"""In units of the medium's density and speed of sound."""


@checked_dataclass
class ExpandingShock(FieldKind):
    """A spherical shock in a medium that fills the field, from a core that is suddenly hot, as by a laser's focus.

    Euler's equations of a stiffened gas, whose waves are those of water: the front, what it compresses, and the
    rarefied core behind. Nothing else is in the field: the material is the medium.
    """

    kind: ClassVar[str] = "expanding-shock"
    changes: ClassVar[bool] = True
    goes_on: ClassVar[bool] = True
    named: ClassVar[Named] = ("water", None, "water")
    extent: ClassVar[float] = 0.85
    size: Small
    """Diameter of the front at the last time [m]."""
    first: SomeShare = 0.35
    """Its diameter at the first time."""
    core: SomeShare = 0.15
    """Diameter of the hot core."""
    pressure: Positive = 5.0
    """Pressure in it, in units of ρc² of the medium (2.2 GPa of water)."""
    shift: Share = 0.05
    """Distance of its centre from the middle of the field, in a random direction."""

    def drawn(self, substances: Substances, seed: int) -> Drawn:
        """The shock about the place that `seed` gives."""
        medium = substances.medium
        require(medium.delta != 0, "a shock needs a medium that it compresses; name it, such as water.")
        require(self.core < self.first, f"core must be below first, {self.first:g}, but it is {self.core:g}.")
        centre = self.shift * self.size * random_direction(np.random.default_rng(seed))

        def shock(share: float) -> ContinuousScene:
            half = [BEYOND * self.radius(share)] * 3
            return ContinuousScene((ellipsoid(centre, half, self._profile(share), medium),))

        def within(share: float) -> ContinuousScene:
            return ContinuousScene((ellipsoid(centre, [self.radius(share)] * 3, Soft(0.0), SHARE),))

        return Drawn(ChangingScene(shock), f"a shock that expands, seed {seed}", {"within": ChangingScene(within)})

    def radius(self, share: float) -> float:
        """Radius [m] of the front at a share of the course."""
        _, fronts, _ = burst(self.core, self.pressure, self.first)
        return 0.5 * self.size * float(np.interp(share, np.linspace(0, 1, SNAPSHOTS), fronts))

    def _profile(self, share: float) -> Radial:
        """Density over the medium's, less one, out to `BEYOND`."""
        edges, _, density = burst(self.core, self.pressure, self.first)
        at = min(max(share, 0.0), 1.0) * (SNAPSHOTS - 1)
        k = min(int(at), SNAPSHOTS - 2)
        return Radial(edges / BEYOND, (1 - at + k) * density[k] + (at - k) * density[k + 1])


RADII = 4096
"""Distances of rays from the middle at which line integrals of shells are tabled."""


@dataclass(frozen=True, eq=False)
class Radial:
    """Shells of even density, out to 1: a `Profile`. edges: [N + 1] from 0 to 1; values: [N] in them."""

    edges: np.ndarray
    values: np.ndarray
    reach: float = 1.0
    core: float = 0.0

    @property
    def mass(self) -> float:
        """In closed form."""
        return float(4 / 3 * np.pi * (self.values * np.diff(self.edges**3)).sum())

    def density(self, s2: np.ndarray) -> np.ndarray:
        """The value of the shell."""
        shell = np.searchsorted(self.edges, np.sqrt(s2), side="right") - 1
        return np.where(s2 < 1, self.values[np.minimum(shell, len(self.values) - 1)], 0.0)

    def chord(self, b2: np.ndarray) -> np.ndarray:
        """By Pythagoras, shell by shell, between rays of a table."""
        away = np.linspace(0, 1, RADII)
        halves = np.sqrt(np.maximum(self.edges[:, None] ** 2 - away**2, 0))
        return np.interp(np.sqrt(b2), away, 2 * self.values @ np.diff(halves, axis=0), right=0.0)


@cache
def burst(core: float, pressure: float, first: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A hot core of radius `core` in a medium at rest: edges of shells [N + 1] in radii of the front, radii of the
    front [T] at even times from `first` to 1, and density over the medium's, less one, [T, N] in the shells."""
    shells = np.linspace(0, BEYOND, round(BEYOND * CELLS) + 1)
    edges = np.concatenate([[0.0], np.arange(3, 1.2 * CELLS) / CELLS])  # a short first cell would need short steps
    middles, inner = (0.5 * (each[1:] + each[:-1]) for each in (edges, shells))
    state = np.stack([np.ones_like(middles), 0 * middles, pressure * np.exp(-((middles / core) ** 4))])
    times = np.linspace(0, 1, 2 * SNAPSHOTS)  # the front is faster than sound
    density = waves(state, edges, WATER, times, spherical=True)[:, 0] - 1
    fronts = np.array([_outermost(row, middles) for row in density])
    when = np.linspace(np.interp(first, fronts, times), np.interp(1.0, fronts, times), SNAPSHOTS)
    radii, kept = np.interp(when, times, fronts), list[np.ndarray]()
    for time in when:
        k = min(int(np.searchsorted(times, time, side="right")) - 1, len(times) - 2)
        near = (time - times[k]) / (times[k + 1] - times[k])
        pair = (np.interp(inner * front, middles, row) for front, row in zip(fronts[k : k + 2], density[k : k + 2]))
        kept.append((1 - near) * next(pair) + near * next(pair))
    return shells, radii, np.stack(kept)


def _outermost(density: np.ndarray, middles: np.ndarray) -> float:
    """Where density [N] falls through half of its largest value for the last time; 0 where none is above zero."""
    half = 0.5 * float(density.max())
    if half <= 0:
        return 0.0
    k = min(int(np.flatnonzero(density > half)[-1]), len(density) - 2)
    return float(np.interp(half, density[[k + 1, k]], middles[[k + 1, k]]))
