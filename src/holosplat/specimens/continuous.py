"""Matter given as functions of space: sums of ellipsoids with soft edges, gradients and bumps, of exact line integrals.

An element is an ellipsoid, `s = |A (x - c)|`, filled with a profile f(s) times `1 + g·(x - c)`. Along a straight line
`s² = b² + L² (t - t₀)²`, so that its line integral is a closed form, or a quadrature of one smooth piece to rounding:
no voxels, no interpolation, and so no numerics that a reconstruction has. Where elements overlap they add up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Protocol

import numpy as np
import torch
from scipy import special

from ..checks import finite, in_range, require, shaped
from ..frames import block_means
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..ranges import Within, checked_dataclass
from ..volume import LineIntegrals, Unmoved, Volume

NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
"""Quadrature of a soft edge along a ray: 1e-9 of the line integral through the middle."""
RAYS = 2
"""`RAYS`² rays a pixel are averaged, as for meshes."""
PER_VOXEL = 5
"""Points a voxel's edge for the mean over a voxel: of sharp spheres of 10 voxels it is right to 0.3 % (rms)."""
CHUNK = 1 << 22
"""Points that are evaluated at once."""


class Profile(Protocol):
    """How matter falls with `s`, the distance from an ellipsoid's centre in units of its semi-axes."""

    @property
    def reach(self) -> float:
        """The `s` from which on there is nothing."""
        ...

    @property
    def core(self) -> float:
        """The `s` up to which f is 1; 0 where it falls from the middle on."""
        ...

    @property
    def mass(self) -> float:
        """`∫ f(s) 4π s² ds`."""
        ...

    def density(self, s2: np.ndarray) -> np.ndarray:
        """f at the squares `s2` of `s`."""
        ...

    def chord(self, b2: np.ndarray) -> np.ndarray:
        """`∫ f(√(b² + t²)) dt` over all t, at the squares `b2` of the distance `b` of a line from the centre."""
        ...


@checked_dataclass
class Soft:
    """One inside, zero outside, and half a period of a cosine between: from `1 - width / 2` to `1 + width / 2`."""

    width: Annotated[float, Within(0, 2)] = 0.0
    """Width of the edge in units of the semi-axes, 0 (sharp) to 2 (a raised cosine from the middle on)."""

    @property
    def reach(self) -> float:
        """1 and half the edge."""
        return 1 + 0.5 * self.width

    @property
    def core(self) -> float:
        """1 less half the edge."""
        return 1 - 0.5 * self.width

    @property
    def mass(self) -> float:
        """`4π/3 (1 + w² (3/4 - 6/π²))`, from integrating `s²` times the cosine by parts."""
        return 4 / 3 * math.pi * (1 + self.width**2 * (0.75 - 6 / math.pi**2))

    def density(self, s2: np.ndarray) -> np.ndarray:
        """The profile."""
        if self.width == 0:
            return np.where(s2 < 1, 1.0, 0.0)
        at = np.clip((np.sqrt(s2) - 1) / self.width, -0.5, 0.5)
        return 0.5 - 0.5 * np.sin(np.pi * at)

    def chord(self, b2: np.ndarray) -> np.ndarray:
        """The full inside by Pythagoras, the edge by Gauss and Legendre along the ray."""
        inner = np.sqrt(np.maximum(self.core**2 - b2, 0))
        if self.width == 0:
            return 2 * inner
        half = 0.5 * (np.sqrt(np.maximum(self.reach**2 - b2, 0)) - inner)
        total = 2 * inner
        for node, weight in zip(NODES, WEIGHTS):
            total += 2 * weight * half * self.density(b2 + (inner + half * (1 + node)) ** 2)
        return total


@checked_dataclass
class Bump:
    """`(1 - s²)^power` inside, which is smooth at its edge to the order `power - 1`."""

    power: Annotated[int, Within(1, 20)] = 3
    """Exponent, 1 to 20."""
    reach, core = 1.0, 0.0

    @property
    def mass(self) -> float:
        """`2π B(3/2, power + 1)`."""
        return 2 * math.pi * float(special.beta(1.5, self.power + 1))

    def density(self, s2: np.ndarray) -> np.ndarray:
        """The profile."""
        return np.maximum(1 - s2, 0) ** self.power

    def chord(self, b2: np.ndarray) -> np.ndarray:
        """`B(1/2, power + 1) (1 - b²)^(power + 1/2)`."""
        return special.beta(0.5, self.power + 1) * np.maximum(1 - b2, 0) ** (self.power + 0.5)


@dataclass(frozen=True, eq=False)
class Element:
    """An ellipsoid of matter.

    centre: [3] `(x, y, z)` [m]; axes: [3, 3], the semi-axes [m] in its rows, at right angles to each other;
    profile: how matter falls from the middle outwards; matter: δ and β where the profile is 1 and at the centre;
    gradient: [3] relative change of δ and β over a metre along x, y, z. Errors: `InputError` for other shapes, and for
    axes that are none.
    """

    centre: np.ndarray
    axes: np.ndarray
    profile: Profile
    matter: DeltaBeta
    gradient: np.ndarray

    def __post_init__(self) -> None:
        for name, shape in (("centre", (3,)), ("axes", (3, 3)), ("gradient", (3,))):
            array = shaped(f"{name} of an element", np.asarray(getattr(self, name), dtype=np.float64), shape)
            object.__setattr__(self, name, finite(f"{name} of an element", array))
        lengths = np.linalg.norm(self.axes, axis=1)
        for length in lengths:
            in_range("semi-axis of an element", float(length), 1e-10, 1.0, unit="metres")
        unit = self.axes / lengths[:, None]
        square = np.allclose(unit @ unit.T, np.eye(3), atol=1e-6)
        require(square, "axes of an element must be at right angles to each other, but they are not.")

    @property
    def inverse(self) -> np.ndarray:
        """A [3, 3] of `s = |A (x - c)|` [1/m]."""
        return self.axes / (np.linalg.norm(self.axes, axis=1) ** 2)[:, None]

    @property
    def half_extents(self) -> np.ndarray:
        """Half the edges [3] [m] of the box along x, y, z that holds the element."""
        return self.profile.reach * np.linalg.norm(self.axes, axis=0)

    @property
    def mass(self) -> DeltaBeta:
        """`∫δ dV` and `∫β dV` [m³]."""
        volume = self.profile.mass * float(np.prod(np.linalg.norm(self.axes, axis=1)))
        return DeltaBeta(self.matter.delta * volume, self.matter.beta * volume)

    def density(self, points: np.ndarray) -> np.ndarray:
        """Share of δ and β [P] at `points` [P, 3] `(x, y, z)` [m]."""
        away = points - self.centre
        s2 = np.square(away @ self.inverse.T).sum(-1)
        return self.profile.density(s2) * (1 + away @ self.gradient)


@dataclass(frozen=True)
class ContinuousScene(Unmoved):
    """Elements that add up: a truth that `simulate` takes, without voxels; `InputError` if there are none."""

    elements: tuple[Element, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "elements", tuple(self.elements))
        require(len(self.elements) > 0, "a continuous scene needs at least one element.")

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner `(x, y, z)` [m] of all elements together."""
        low = [e.centre - e.half_extents for e in self.elements]
        return np.min(low, axis=0), np.max([e.centre + e.half_extents for e in self.elements], axis=0)

    @property
    def mass(self) -> DeltaBeta:
        """`∫δ dV` and `∫β dV` [m³], in closed form."""
        masses = [element.mass for element in self.elements]
        return DeltaBeta(math.fsum(m.delta for m in masses), math.fsum(m.beta for m in masses))

    @property
    def kinds(self) -> tuple[DeltaBeta, ...]:
        """The matter of the channels of `project`: one if all elements have one ratio of δ and β, else δ and β."""
        first = max((e.matter for e in self.elements), key=lambda m: abs(m.delta))
        crossed = [abs(m.delta * first.beta - m.beta * first.delta) for m in (e.matter for e in self.elements)]
        one = first.delta != 0 and max(crossed) <= 1e-9 * abs(first.delta) * max(map(abs, first))
        return (first,) if one else (DeltaBeta(1.0, 0.0), DeltaBeta(0.0, 1.0))

    def missing_field(self, views: Views) -> float:
        """How far [m] the scene reaches beyond the detector in the worst view (0 or less: it fits)."""
        half = 0.5 * views.fields
        worst = -math.inf
        for element in self.elements:
            low, high = _shadow(element, views)
            worst = max(worst, float(np.maximum(high - views.shifts - half, views.shifts - half - low).max()))
        return worst

    def project(self, views: Views) -> LineIntegrals:
        """Line integrals of each of `kinds`, float64: the mean of `RAYS`² exact ones a pixel.

        Errors: `InputError` where a cone's source lies in an element's depth or before it.
        """
        fine, kinds = views.refined(RAYS), self.kinds
        channels = np.zeros((len(views), len(kinds), *fine.shape))
        for v in range(len(views)):
            for element in self.elements:
                _add_lines(channels[v], element, _shares(element.matter, kinds), fine[[v]])
        return LineIntegrals(torch.from_numpy(block_means(channels, RAYS)), tuple((k.delta, k.beta) for k in kinds))

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β averaged over voxels, from `PER_VOXEL`³ points of each."""
        delta, beta = np.zeros(grid.shape), np.zeros(grid.shape)
        for element in self.elements:
            box = _box(grid.axes(), element.centre, element.half_extents, grid.voxel_size)
            if any(s.stop <= s.start for s in box):
                continue
            share = _voxel_means(element, grid, box)
            delta[box[::-1]] += element.matter.delta * share
            beta[box[::-1]] += element.matter.beta * share
        return Volume(delta, beta, grid)


def ellipsoid(
    centre: Sequence[float] | np.ndarray,
    semi_axes: Sequence[float] | np.ndarray,
    profile: Profile,
    matter: DeltaBeta,
    turn: np.ndarray | None = None,
    gradient: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
) -> Element:
    """An element of `semi_axes` [3] [m] along x, y, z, then turned by the rotation `turn` [3, 3]; see `Element`."""
    axes = np.diag(np.asarray(semi_axes, dtype=np.float64))
    turned = axes if turn is None else axes @ np.asarray(turn, dtype=np.float64).T
    return Element(np.asarray(centre, dtype=np.float64), turned, profile, matter, np.asarray(gradient))


def random_direction(rng: np.random.Generator) -> np.ndarray:
    """A unit vector [3], all directions equally likely."""
    found = rng.normal(size=3)
    return found / np.linalg.norm(found)


def scaled(matter: DeltaBeta, factor: float) -> DeltaBeta:
    """The same ratio of δ to β, `factor` times denser."""
    return DeltaBeta(factor * matter.delta, factor * matter.beta)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """A rotation matrix [3, 3], all of them equally likely (Shoemake 1992, Graphics Gems III, 124)."""
    from scipy.spatial.transform import Rotation  # which takes long to load

    return Rotation.from_quat(np.roll(rng.normal(size=4), -1)).as_matrix()


def _shares(matter: DeltaBeta, kinds: tuple[DeltaBeta, ...]) -> tuple[float, ...]:
    return (matter.delta / kinds[0].delta,) if len(kinds) == 1 else (matter.delta, matter.beta)


def _box(axes: Sequence[np.ndarray], centre: np.ndarray, half: np.ndarray, pitch: Sequence[float]) -> tuple[slice, ...]:
    """Along each of `axes` (coordinates of cells of `pitch`) the cells that touch `centre ± half`."""
    return tuple(
        slice(*np.searchsorted(at, [c - h - 0.5 * d, c + h + 0.5 * d]))
        for at, c, h, d in zip(axes, centre, half, pitch)
    )


def _add_lines(channels: np.ndarray, element: Element, shares: Sequence[float], view: Views) -> None:
    """Add an element's line integrals in one view to `channels` [C, H, W]."""
    rotation, (sx, sy), (h, w), p = view.rotations[0], view.shifts[0], view.shape, view.pixel_size
    a = element.inverse @ rotation.T  # s = |a (x_lab - c_lab)|
    centre, gradient = rotation @ element.centre, rotation @ element.gradient
    x, y = (np.arange(w) + 0.5 - w / 2) * p + sx, (np.arange(h) + 0.5 - h / 2) * p + sy
    low, high = (end[0] for end in _shadow(element, view))
    columns, rows = _box((x, y), 0.5 * (low + high), 0.5 * (high - low), (p, p))
    if columns.stop <= columns.start or rows.stop <= rows.start:
        return
    place = np.stack(np.broadcast_arrays(x[columns][None, :], y[rows][:, None], 0.0))  # of pixels
    way = np.array([0.0, 0.0, 1.0])[:, None, None]  # of rays
    if view.sources is not None:
        way = place + view.sources[0] * way
        way = way / np.linalg.norm(way, axis=0)
    away = place - centre[:, None, None]
    from_centre, ahead = np.tensordot(a, away, 1), np.tensordot(a, way, 1)
    along = np.square(ahead).sum(0)
    nearest = -(from_centre * ahead).sum(0) / along  # the ray's point that is nearest to the centre
    b2 = np.square(from_centre + nearest * ahead).sum(0)
    lines = element.profile.chord(b2) / np.sqrt(along) * (1 + np.tensordot(gradient, away + nearest * way, 1))
    for channel, share in zip(channels, shares):
        channel[rows, columns] += share * lines


def _shadow(element: Element, views: Views) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corners [V, 2] `(x, y)` [m] of what holds an element in the plane of the pixels."""
    centre = views.rotations @ element.centre
    half = element.profile.reach * np.linalg.norm(element.axes @ views.rotations.transpose(0, 2, 1), axis=1)
    corners = np.stack([centre - half, centre + half])
    if views.sources is None:
        return corners[0, :, :2], corners[1, :, :2]
    depth = 1 + corners[:, :, 2:] / views.sources[:, None]
    require(
        bool((depth > 0).all()), "the source must lie before the specimen, but it is beside or behind a part of it."
    )
    seen = (corners[:, None, :, :2] / depth).reshape(4, -1, 2)
    return seen.min(0), seen.max(0)


def _voxel_means(element: Element, grid: Grid, box: tuple[slice, ...]) -> np.ndarray:
    """Means [Z, Y, X] of an element over the voxels in `box`, slices of x, y, z.

    Voxels in the core are linear, so that their middle is their mean; those that touch the edge take many points.
    """
    a, size, profile = element.inverse, np.array(grid.voxel_size), element.profile
    x, y, z = (at[part] - c for at, part, c in zip(grid.axes(), box, element.centre))
    plane = a[:, 0, None, None] * x + a[:, 1, None, None] * y[:, None]  # [3, Y, X]
    tilt = 1 + element.gradient[0] * x + element.gradient[1] * y[:, None]
    reach = 0.5 * float(np.linalg.norm(np.abs(a) @ size))  # of a voxel, in s
    inside = (np.stack(np.meshgrid(*[np.arange(PER_VOXEL)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) / PER_VOXEL
    points = (inside - 0.5) * size
    moved, tilted = points @ a.T, points @ element.gradient  # [P, 3], [P]
    out = np.zeros((len(z), len(y), len(x)))
    for k, dz in enumerate(z):
        away = plane + (a[:, 2] * dz)[:, None, None]
        s, slope = np.sqrt(np.square(away).sum(0)), tilt + element.gradient[2] * dz
        core = s + reach <= profile.core
        out[k][core] = slope[core]
        rows, columns = np.nonzero(~core & (s - reach < profile.reach))
        step = max(1, CHUNK // len(points))
        for start in range(0, len(rows), step):
            at = rows[start : start + step], columns[start : start + step]
            s2 = np.square(away[:, *at].T[:, None] + moved).sum(-1)  # [N, P]
            out[k][at] = (profile.density(s2) * (slope[at][:, None] + tilted)).mean(1)
    return out
