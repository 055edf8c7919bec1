"""Red blood cells by their published shape, deformed mildly and placed at random without overlap.

The resting shape follows Evans & Fung (1972, Microvasc. Res. 4, 335): thickness at radius r, with t = (r/R)²,
`D(r) = sqrt(1 - t) (C0 + C1 t + C2 t²)`, R = 3.91 µm, (C0, C1, C2) = (0.81, 7.83, -4.39) µm at 300 mosmol: volume 94
µm³, area 135 µm², thickness 0.81 µm in the middle and 2.58 µm at most. Written as the image of the unit sphere,
`(X, Y, Z) -> (R X, R Y, Z (C0 + C1 t + C2 t²)/2)` with t = X² + Y², it is smooth at the rim, has a mesh without poles,
and its inverse tells exactly whether a point is inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated, Any

import numpy as np

from ..checks import InputError, finite, in_range, require, shaped
from ..mesh import TriangleMesh, normals
from ..ranges import Stretch, Within, ranged

RADIUS = 3.91e-6
THICKNESS = (0.81e-6, 7.83e-6, -4.39e-6)
DIAMETER = 2 * RADIUS
"""Mean diameter of a resting human red cell, 7.82 µm; cells of another diameter are scaled as a whole."""
MAX_DEFORM = 0.1
TRIES = 2000
MOST_FILLED = 0.71
"""Share of a channel that bodies fill which lie at random: that of flat ellipsoids, the densest of them (Donev et al.
2004, Science 303, 990)."""
SHUFFLES = 50
MOST_TRIES, TRIES_A_CELL = 50_000, 50
"""Places that are tried in all: so many, and so many more for each cell. A haematocrit of 20 % in a channel six cells
wide takes 140 a cell; where cells jam, the search ends within minutes instead of hours."""
STEP, TURN = 0.1, 0.2
"""Typical move of a cell in a shuffle: in diameters along each axis, in radians about each."""
CROWDED_MARGIN = 0.01
"""Clear distance between crowded cells, in diameters: 80 nm for cells of 8 µm."""
COARSE_POINTS, FINE_LEVEL = 162, 4
"""Overlap is tested on the vertices of a level-4 icosphere; the first 162 (its level 2) reject quickly."""


@dataclass(frozen=True, eq=False)
@ranged
class RedCell:
    """One cell: size, pose and bending. Bending and stretch keep the volume exactly (unit Jacobian)."""

    diameter: Annotated[float, Within(1e-9, 1, unit="metres")] = DIAMETER
    """Of the undeformed cell [m]."""
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    """[3, 3], with `x = rotation @ x_cell + centre` and the cell's axis along its own z."""
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """[3] [m]."""
    stretch: Stretch = 0.0
    """Logarithm of the stretch along the cell's x and of the shrinkage along its y."""
    bend: np.ndarray = field(default_factory=lambda: np.zeros(5))
    """[5] amplitudes of the mid-plane's bending [radii]: Zernike's bowl, two saddles, two trefoils, unit rms each."""

    def __post_init__(self) -> None:
        for name, shape in (("rotation", (3, 3)), ("centre", (3,)), ("bend", (5,))):
            array = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, finite(f"cell {name}", shaped(f"cell {name}", array, shape)))

    def surface(self, sphere: np.ndarray) -> np.ndarray:
        """Object-frame points [..., 3] (metres) of the unit-sphere points `sphere` [..., 3]."""
        x, y, z = np.moveaxis(sphere, -1, 0)
        z = z * half_thickness(x**2 + y**2)
        x, y = x * np.exp(self.stretch), y * np.exp(-self.stretch)
        bent = np.stack([x, y, z + _bending(x, y, self.bend)], axis=-1)
        return 0.5 * self.diameter * bent @ self.rotation.T + self.centre

    def level(self, points: np.ndarray) -> np.ndarray:
        """Level [...] of `points` [..., 3] (metres): below 1 inside, 1 on the surface, above 1 outside."""
        local = (points - self.centre) @ self.rotation / (0.5 * self.diameter)
        x, y, z = np.moveaxis(local, -1, 0)
        z = z - _bending(x, y, self.bend)
        x, y = x * np.exp(-self.stretch), y * np.exp(self.stretch)
        t = x**2 + y**2
        return np.sqrt(t + (z / half_thickness(np.minimum(t, 1.0))) ** 2)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether object-frame `points` [..., 3] (metres) lie inside the smooth cell: [...] bool."""
        return self.level(points) < 1

    def mesh(self, subdivisions: int = 3, name: str = "red cell") -> TriangleMesh:
        """Closed mesh, wound outwards, of 10·4^s + 2 vertices (642 for s = 3) on the smooth surface."""
        sphere, faces = icosphere(subdivisions)
        return TriangleMesh(self.surface(sphere), faces, name)


def evans_fung_cell(diameter: float = DIAMETER, subdivisions: int = 3) -> TriangleMesh:
    """A resting red cell of `diameter` [m], its axis along z: a closed mesh of 10·4^s + 2 vertices."""
    return RedCell(diameter).mesh(subdivisions)


def random_cells(
    count: int,
    box: tuple[float, float, float],
    seed: int | np.random.Generator = 0,
    diameter: float = DIAMETER,
    deform: float = 0.03,
    margin: float | None = None,
    shape: str = "cylinder",
    *,
    stretch: float | None = None,
) -> list[TriangleMesh]:
    """Meshes (642 vertices each, named cell00, cell01, …) of `place_cells`, which explains the arguments."""
    cells = place_cells(count, box, seed, diameter, deform, margin, shape, stretch=stretch)
    return [cell.mesh(name=f"cell{i:02d}") for i, cell in enumerate(cells)]


def place_cells(
    count: int,
    box: tuple[float, float, float],
    seed: int | np.random.Generator = 0,
    diameter: float = DIAMETER,
    deform: float = 0.03,
    margin: float | None = None,
    shape: str = "cylinder",
    *,
    shuffles: int = 0,
    stretch: float | None = None,
) -> list[RedCell]:
    """`count` cells, turned and placed uniformly at random in a channel about the origin, none touching.

    box: the channel's extents `(x, y, z)` [m]; seed: makes the result reproducible; diameter: of a cell [m];
    deform: typical root-mean-square bending, in diameters, from 0 (rigid) to 0.1; at 0.03 the area
    grows by 1 % on average and 5 % at most; margin: clear distance [m] between cells and to the walls,
    by default 2 % of the diameter; shape: "box", or "cylinder" about y of diameter min(x, z), which
    every tomographic view sees whole; shuffles: how often all cells placed may move a little to make room for the
    next; stretch: typical logarithm of the stretch of a cell along one of its diameters, by which it shrinks along the
    other (default: `deform`; in a fast flow it is 0.2 and more). `InputError` when the cells do not fit: after `TRIES`
    random tries for one cell (and after each shuffle), or `MOST_TRIES` and more for all.
    """
    margin = 0.02 * diameter if margin is None else margin
    _check_channel(count, box, diameter, deform, margin, shape)
    channel = _Channel(box, margin, shape)
    rng = np.random.default_rng(seed)
    placed: list[_Placed] = []
    left = MOST_TRIES + TRIES_A_CELL * count
    for _ in range(count):
        resting = _Placed.resting(diameter, margin, deform, rng, stretch)
        found, left = _inserted(resting, placed, channel, rng, left)
        for _ in range(shuffles if placed else 0):
            if found is not None or left <= 0:
                break
            _shuffle(placed, channel, rng)
            found, left = _inserted(resting, placed, channel, rng, left - len(placed))
        if found is None:
            raise InputError(
                f"{count} red cells of {1e6 * diameter:.4g} µm must fit into the {shape} of "
                f"{' x '.join(f'{1e6 * b:.4g}' for b in box)} µm, but only {len(placed)} found a place; "
                "take fewer or smaller cells, a larger box or a smaller margin."
            )
        placed.append(found)
    return [cell.cell for cell in placed]


def crowded_cells(
    haematocrit: float,
    box: tuple[float, float, float],
    seed: int | np.random.Generator = 0,
    diameter: float = DIAMETER,
    deform: float = 0.03,
) -> list[RedCell]:
    """As many cells as fill the fraction `haematocrit` of the cylinder in `box` (x, y, z) [m] about y, none touching.

    To the nearest whole cell, by the volume of its mesh (642 vertices). Cells put down one after the other jam at 18 %
    in a channel five cells wide: here they move over for the next, see `place_cells`.
    """
    in_range("haematocrit", haematocrit, 1e-6, 1.0)
    margin = CROWDED_MARGIN * diameter
    _check_channel(1, box, diameter, deform, margin, "cylinder")
    channel = 0.25 * np.pi * min(box[0], box[2]) ** 2 * box[1]
    count = max(1, round(haematocrit * channel / evans_fung_cell(diameter).volume))
    return place_cells(count, box, seed, diameter, deform, margin, shuffles=SHUFFLES)


@lru_cache(maxsize=8)
def icosphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [10·4^s + 2, 3] on the unit sphere and faces [20·4^s, 3], wound outwards (read-only arrays).

    The vertices of each coarser level come first. `InputError` unless `subdivisions` is in 0 … 7.
    """
    if not isinstance(subdivisions, (int, np.integer)) or not 0 <= subdivisions <= 7:
        raise InputError(f"subdivisions must be a whole number from 0 to 7, but it is {subdivisions!r}.")
    if subdivisions == 0:
        vertices, faces = _icosahedron()
    else:
        coarse, triangles = icosphere(subdivisions - 1)
        sides = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1), axis=-1)
        edges, index = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
        middles = coarse[edges].sum(1)
        vertices = np.concatenate([coarse, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
        (a, b, c), (ab, bc, ca) = triangles.T, len(coarse) + index.reshape(-1, 3).T
        faces = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]], axis=0)
        faces = faces.transpose(2, 0, 1).reshape(-1, 3)
    vertices.flags.writeable = faces.flags.writeable = False
    return vertices, faces


def _icosahedron() -> tuple[np.ndarray, np.ndarray]:
    """The 12 vertices (0, ±1, ±golden ratio) and cyclic, and the 20 faces, wound outwards."""
    golden = (1 + 5**0.5) / 2
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * [1.0, golden]
    flat = np.concatenate([np.zeros((4, 1)), signs], axis=1)
    vertices = np.concatenate([np.roll(flat, shift, axis=1) for shift in range(3)])
    triples = np.stack(np.meshgrid(*[np.arange(12)] * 3, indexing="ij"), -1).reshape(-1, 3)
    corners = vertices[triples]
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    outward = np.linalg.det(corners) > 0
    rotated = triples[:, 0] == triples.min(1)  # one of the three cyclic orders
    faces = triples[np.isclose(sides, 2).all(1) & outward & rotated]
    return vertices / np.linalg.norm(vertices[0]), faces


def half_thickness(t: Any) -> Any:
    """(C0 + C1 t + C2 t²)/2 in radii: half the thickness of Evans & Fung without its root (arrays or tensors)."""
    c0, c1, c2 = (0.5 * c / RADIUS for c in THICKNESS)
    return c0 + t * (c1 + t * c2)


def _bending(x: np.ndarray, y: np.ndarray, bend: np.ndarray) -> np.ndarray:
    """Height of the bent mid-plane at `(x, y)`, in radii: Zernike's Z4, Z5, Z6, Z9, Z10 in Noll's order."""
    if not bend.any():
        return np.zeros_like(x)
    xx, yy = x * x, y * y
    bowl = 3**0.5 * (2 * (xx + yy) - 1)
    saddles = 6**0.5 * (bend[1] * 2 * x * y + bend[2] * (xx - yy))
    trefoils = 8**0.5 * (bend[3] * (3 * xx - yy) * y + bend[4] * (xx - 3 * yy) * x)
    return bend[0] * bowl + saddles + trefoils


@dataclass(frozen=True, eq=False)
class _Placed:
    """A cell with the points that test it against others: on its surface, and a margin outside it."""

    cell: RedCell
    points: np.ndarray
    outer: np.ndarray
    reach: float

    @classmethod
    def resting(
        cls, diameter: float, margin: float, deform: float, rng: np.random.Generator, stretch: float | None = None
    ) -> _Placed:
        """A randomly deformed cell at the origin."""
        weights = np.array([1, 1, 1, 0.5, 0.5]) / 3.5**0.5
        bend = 2 * deform * weights * rng.standard_normal(5)
        typical = deform if stretch is None else stretch
        cell = RedCell(diameter, stretch=typical * rng.standard_normal(), bend=bend)
        mesh = cell.mesh(FINE_LEVEL)
        outer = mesh.vertices + margin * normals(mesh)
        reach = float(np.linalg.norm(np.concatenate([mesh.vertices, outer]), axis=1).max())
        return cls(cell, mesh.vertices, outer, reach)

    @property
    def coarse(self) -> _Placed:
        """The same with the points that reject quickly."""
        return replace(self, points=self.points[:COARSE_POINTS], outer=self.outer[:COARSE_POINTS])

    def moved(self, rotation: np.ndarray, translation: np.ndarray) -> _Placed:
        """Turned about the origin, then shifted."""
        cell = self.cell
        cell = replace(cell, rotation=rotation @ cell.rotation, centre=rotation @ cell.centre + translation)
        points, outer = (p @ rotation.T + translation for p in (self.points, self.outer))
        return _Placed(cell, points, outer, self.reach)


def _overlaps_any(candidate: _Placed, placed: list[_Placed], counts: Sequence[int | None] = (None,)) -> bool:
    """Whether `candidate` comes closer than the margin to any cell of `placed`, by the first points (None: all) of each
    in `counts`, one after the other.

    Where two smooth bodies come closest they share the normal, so a point of one, moved the margin outwards,
    lies inside the other if they are closer than that; level-4 vertices are 1/50 of a diameter apart.
    """
    if not placed:
        return False
    distance = np.linalg.norm([p.cell.centre - candidate.cell.centre for p in placed], axis=1)
    near = [p for p, d in zip(placed, distance) if d < p.reach + candidate.reach]
    for count in counts:
        for other in near:
            for a, b in ((candidate, other), (other, candidate)):
                probes = np.concatenate([a.points[:count], a.outer[:count]])
                if b.cell.contains(probes).any():
                    return True
    return False


@dataclass(frozen=True)
class _Channel:
    """Where cells may be: the extents `(x, y, z)` [m] about the origin, the clear distance [m], box or cylinder."""

    box: tuple[float, float, float]
    margin: float
    shape: str

    @property
    def half(self) -> np.ndarray:
        """Half the clear extents [3]."""
        return np.asarray(self.box, dtype=np.float64) / 2 - self.margin

    def holds(self, points: np.ndarray) -> bool:
        """Whether all `points` [P, 3] keep clear of the walls."""
        half = self.half
        if self.shape == "box":
            return bool((np.abs(points) <= half).all())
        x, y, z = points.T
        return bool(np.max(x**2 + z**2) <= min(half[0], half[2]) ** 2 and np.max(np.abs(y)) <= half[1])

    def random_centre(self, points: np.ndarray, turn: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
        """A uniform random place [3] that keeps `points` [P, 3], turned, inside the channel, or None (try again)."""
        half = self.half
        if self.shape == "box":
            points = points @ turn.T
            low, high = -half - points.min(0), half - points.max(0)
            return rng.uniform(low, high) if np.all(low <= high) else None
        radius = min(half[0], half[2])
        centre = rng.uniform([-radius, -half[1], -radius], [radius, half[1], radius]) if radius > 0 else None
        if centre is None or half[1] <= 0:
            return None
        held = (self.holds(some @ turn.T + centre) for some in (points[:COARSE_POINTS], points))
        return centre if all(held) else None


def _inserted(
    resting: _Placed, placed: list[_Placed], channel: _Channel, rng: np.random.Generator, left: int
) -> tuple[_Placed | None, int]:
    """`resting` at a random place where it touches nothing, or None after `TRIES` tries or the `left` ones; and how
    many tries are left then."""
    few = resting.coarse
    for tried in range(1, min(left, TRIES) + 1):
        rotation = _random_rotation(rng)
        centre = channel.random_centre(resting.points, rotation, rng)
        if centre is None or _overlaps_any(few.moved(rotation, centre), placed, (COARSE_POINTS,)):
            continue
        candidate = resting.moved(rotation, centre)
        if not _overlaps_any(candidate, placed):
            return candidate, left - tried
    return None, left - min(left, TRIES)


def _shuffle(placed: list[_Placed], channel: _Channel, rng: np.random.Generator) -> None:
    """Moves and turns every cell a little where that is allowed: hard bodies in equilibrium, which leave more room
    than bodies put down for good (Metropolis et al. 1953, J. Chem. Phys. 21, 1087)."""
    from scipy.spatial.transform import Rotation  # which takes long to load

    for i, old in enumerate(placed):
        turn = Rotation.from_rotvec(TURN * rng.standard_normal(3)).as_matrix()
        centre = old.cell.centre
        shift = centre - turn @ centre + STEP * old.cell.diameter * rng.standard_normal(3)
        moved = old.moved(turn, shift)
        if channel.holds(moved.points) and not _overlaps_any(
            moved, placed[:i] + placed[i + 1 :], (COARSE_POINTS, None)
        ):
            placed[i] = moved


def _random_rotation(rng: np.random.Generator) -> np.ndarray:
    """A uniformly distributed rotation [3, 3] (a normalised 4D Gaussian is a uniform unit quaternion)."""
    from scipy.spatial.transform import Rotation  # which takes long to load

    return Rotation.from_quat(rng.standard_normal(4)).as_matrix()


def whole_number(name: str, value: int, least: int = 1) -> None:
    """`InputError` naming what is no whole number, or below the `least`."""
    whole = isinstance(value, (int, np.integer)) and value >= least
    require(whole, f"{name} must be a whole number of at least {least}, but it is {value!r}.")


def _check_channel(
    count: int, box: tuple[float, float, float], diameter: float, deform: float, margin: float, shape: str
) -> None:
    whole_number("the number of red cells", count)
    require(len(box) == 3, f"box must be three extents (x, y, z) in metres, but it is {box!r}.")
    for axis, extent in zip("xyz", box):
        in_range(f"box extent {axis}", extent, 1e-9, 10.0, unit="metres")
    in_range("cell diameter", diameter, 1e-9, 1.0, unit="metres")
    room = box[0] * box[1] * box[2] if shape == "box" else 0.25 * np.pi * min(box[0], box[2]) ** 2 * box[1]
    filled = count * evans_fung_cell(diameter).volume / room
    require(
        filled <= MOST_FILLED,
        f"{count} red cells of {1e6 * diameter:.4g} µm must fit into the {shape} of "
        f"{' x '.join(f'{1e6 * b:.4g}' for b in box)} µm, but they would fill {filled:.0%} of it, and lie at random in "
        f"{MOST_FILLED:.0%} at most; take fewer or smaller cells, or a larger box.",
    )
    require(0 <= deform <= MAX_DEFORM, f"deform must lie between 0 and {MAX_DEFORM}, but it is {deform!r}.")
    require(0 <= margin < diameter, f"margin must lie between 0 and the cell diameter, but it is {margin!r} m.")
    require(shape in ("box", "cylinder"), f"shape must be 'box' or 'cylinder', but it is {shape!r}.")
