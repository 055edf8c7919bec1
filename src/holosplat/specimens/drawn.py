"""What the kinds of matter of `specimens.fluids` and `specimens.solids` are made of: shapes, substances, and a draw.

Each kind is a frozen dataclass: its parameters are the fields, with `size` [m] first and all others shares of it unless
they say otherwise, and `drawn(substances, seed)` gives a `Drawn`. Its class has what `SpecimenKind` says, and `named`,
the names of the usual material, core and medium (None: no core; vacuum), and `extent`, the usual size, in units of the
shorter side of the field of view.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from ..checks import InputError, require
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..mesh import TriangleMesh
from ..volume import LineIntegrals, Volume
from .continuous import ContinuousScene
from .phantoms import packed_balls
from .rods import RodScene
from .scene import MeshScene

Still = MeshScene | ContinuousScene | RodScene


class SpecimenKind:
    """What a kind of specimen says of itself. kind: its name; has_core: whether something else is inside the material;
    goes_on: whether its matter, or the medium around it, goes on beyond the field of view."""

    kind: ClassVar[str]
    has_core: ClassVar[bool] = False
    goes_on: ClassVar[bool] = False


@dataclass(frozen=True, eq=False)
class ChangingScene:
    """A truth that is drawn anew at every time. drawn: the scene at a share of the course, 0 at the first time and 1 at
    the last, which are `duration` [s] apart."""

    drawn: Callable[[float], Still]
    duration: float = 1.0

    def at(self, time: float) -> Still:
        """The scene at `time` [s]."""
        return self.drawn(time / self.duration)

    def project(self, views: Views) -> LineIntegrals:
        """Line integrals at the first time."""
        return self.drawn(0.0).project(views)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β at the first time."""
        return self.drawn(0.0).voxelise(grid)

    def missing_field(self, views: Views) -> float:
        """How far [m] the scene reaches beyond the detector in the worst view of the first, middle and last time."""
        return max(self.drawn(share).missing_field(views) for share in (0.0, 0.5, 1.0))


Scene = Still | ChangingScene
"""The truths that a kind may give."""
LONG = 16.0
"""Length of what goes on beyond the field at its top or bottom, in units of the size."""
VACUUM = DeltaBeta(0.0, 0.0)
SHARE = DeltaBeta(1.0, 0.0)
"""The matter of a region, whose δ is then the share of a voxel that it fills."""


@dataclass(frozen=True)
class Substances:
    """δ and β of the material, of what is inside it (None: of the kinds without), and of the medium around."""

    material: DeltaBeta
    core: DeltaBeta | None = None
    medium: DeltaBeta = VACUUM

    @property
    def contrast(self) -> DeltaBeta:
        """The material against the medium."""
        return self.material.against(self.medium)

    def within(self, kind: str) -> DeltaBeta:
        """What is inside; `InputError` where `kind` has none."""
        if self.core is None:
            raise InputError(f"the specimen, {kind}, needs the material that is inside; give it as its core.")
        return self.core


@dataclass(frozen=True)
class Drawn:
    """scene: the truth, against the medium; text: what it is in words; regions: scenes of named parts, filled with
    `SHARE`, so that they voxelise to the share of each voxel that the part fills."""

    scene: Scene
    text: str
    regions: Mapping[str, Scene] = field(default_factory=dict)

    def over(self, duration: float) -> Drawn:
        """The same, with the course of what changes spread over `duration` [s]."""

        def spread(scene: Scene) -> Scene:
            return replace(scene, duration=duration) if isinstance(scene, ChangingScene) else scene

        return replace(self, scene=spread(self.scene), regions={k: spread(one) for k, one in self.regions.items()})


def meshed(parts: Sequence[tuple[Sequence[TriangleMesh], DeltaBeta]]) -> MeshScene:
    """The scene of meshes, each group filled with what it adds to that which is around it."""
    bodies = [(mesh, matter) for meshes, matter in parts for mesh in meshes]
    return MeshScene(tuple(mesh for mesh, _ in bodies), tuple(matter for _, matter in bodies))


def region(*meshes: TriangleMesh, without: Sequence[TriangleMesh] = ()) -> MeshScene:
    """The part of space in `meshes`, and not in those `without`, which lie inside."""
    return meshed([(meshes, SHARE), (without, DeltaBeta(-1.0, 0.0))])


def ball_meshes(
    count: int,
    radii: tuple[float, float],
    size: float,
    box: tuple[float, float, float],
    seed: int | np.random.Generator,
    shape: str,
) -> list[TriangleMesh]:
    """`count` balls in the container `box` [m] of `shape`, none touching, of radii evenly between shares of `size`."""
    low, high = (2 * r * size for r in radii)
    require(low <= high, f"radii must be (smallest, largest), but they are {radii[0]:g} and {radii[1]:g}.")
    if not count:
        return []
    balls = packed_balls(np.linspace(high, low, count), box, seed, margin=0.05 * low, shape=shape)
    return [ball.mesh(4, f"bubble{i:03d}") for i, ball in enumerate(balls)]


def box_mesh(low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray, name: str = "box") -> TriangleMesh:
    """The box between two corners `(x, y, z)` [m]."""
    outline = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return prism(outline, (low[2], high[2]), name)


def column(wide: float, deep: float, high: float, name: str = "column") -> TriangleMesh:
    """A box about the origin, `wide` along x, `high` along y and `deep` along z [m]."""
    half = np.array([wide, high, deep]) / 2
    return box_mesh(-half, half, name)


def prism(outline: np.ndarray, depths: tuple[float, float], name: str = "prism") -> TriangleMesh:
    """A convex polygon `outline` [N, 2] in (x, y) [m], from x towards y, extruded along z between `depths` [m]."""
    count = len(outline)
    front, back = (np.column_stack([outline, np.full(count, z)]) for z in depths)
    k, after = np.arange(count), (np.arange(count) + 1) % count
    sides = [np.column_stack([k, after, after + count]), np.column_stack([k, after + count, k + count])]
    fan = np.column_stack([np.zeros(count - 2, dtype=int), k[1:-1], k[2:]])
    return TriangleMesh(np.concatenate([front, back]), np.concatenate([*sides, fan[:, ::-1], fan + count]), name)


def _band(low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """Triangles, two times [N, 3], between two rings of N vertices each."""
    below, above = np.roll(low, -1), np.roll(high, -1)
    return [np.column_stack([low, high, above]), np.column_stack([low, above, below])]


def lathe(
    heights: np.ndarray, radii: np.ndarray, name: str = "lathe", path: np.ndarray | None = None, segments: int = 96
) -> TriangleMesh:
    """A body of circular sections across y, with flat ends: `radii` [N] at the rising `heights` [N] [m].

    path: the sections' middles (x, z) [N, 2] [m] (default: on the axis); segments: corners of a section, whose area is
    the circle's, so that the body's volume is `Σ π (r₁² + r₁r₂ + r₂²) (y₂ - y₁)/3`.
    """
    middles = np.zeros((len(heights), 2)) if path is None else np.asarray(path)
    turn = 2 * np.pi / segments
    grown = np.asarray(radii) * np.sqrt(turn / np.sin(turn))
    angles = turn * np.arange(segments)
    x = middles[:, :1] + grown[:, None] * np.cos(angles)
    z = middles[:, 1:] + grown[:, None] * np.sin(angles)
    rings = np.stack([x, np.broadcast_to(np.asarray(heights)[:, None], x.shape), z], axis=-1).reshape(-1, 3)
    caps = [[middles[end, 0], heights[end], middles[end, 1]] for end in (0, -1)]
    first, k = len(rings), np.arange(segments)
    after = (k + 1) % segments
    faces = []
    for n in range(len(heights) - 1):
        faces += _band(segments * n + k, segments * (n + 1) + k)
    top = segments * (len(heights) - 1)
    faces += [
        np.column_stack([np.full(segments, first), k, after]),
        np.column_stack([np.full(segments, first + 1), top + after, top + k]),
    ]
    return TriangleMesh(np.concatenate([rings, caps]), np.concatenate(faces), name).merged()


def rough_lens(
    radius: float, opening: float, modes: np.ndarray, frame: np.ndarray, name: str = "lens", rings: int = 96
) -> TriangleMesh:
    """A penny-shaped gap of `radius` [m], `opening` wide in its middle [m], whose middle surface is rough.

    The gap is an ellipsoid, `opening √(1 - (r / radius)²)` wide (Sneddon 1946, Proc. R. Soc. A 187, 229), sheared along
    its normal by the sum of `modes` [M, 4], each (wave number along the first and the second axis [1/m], phase, height
    [m]), which keeps its volume `2π/3 radius² opening`. frame: [3, 3] its two axes and its normal in its rows.
    """
    sectors = 4 * rings
    angles, k = 2 * np.pi / sectors * np.arange(sectors), np.arange(sectors)
    reach = np.sin(0.5 * np.pi * np.arange(1, rings + 1) / rings)  # rings lie close where the gap closes
    grown = np.sqrt(2 * np.pi / sectors / np.sin(2 * np.pi / sectors))
    points = radius * grown * reach[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    flat = np.concatenate([np.zeros((1, 2)), points.reshape(-1, 2)])
    middle = (np.sin(flat @ modes[:, :2].T + modes[:, 2]) * modes[:, 3]).sum(axis=1)
    half = 0.5 * opening * np.concatenate([[1.0], np.repeat(np.sqrt(np.maximum(1 - reach**2, 0)), sectors)])
    upper, lower = (np.column_stack([flat, middle + side * half]) for side in (1, -1))
    inner = len(flat) - sectors  # the last ring belongs to both sides
    places = np.concatenate([upper, lower[:inner]]) @ frame
    above, below = np.arange(len(flat)), np.concatenate([len(flat) + np.arange(inner), np.arange(inner, len(flat))])
    after, faces = (k + 1) % sectors, []
    for index, turned in ((above, 1), (below, -1)):
        sheet = [np.column_stack([np.zeros(sectors, dtype=int), 1 + k, 1 + after])]
        for n in range(rings - 1):
            sheet += _band(1 + sectors * n + k, 1 + sectors * (n + 1) + k)
        faces.append(index[np.concatenate(sheet)][:, ::turned])
    return TriangleMesh(places, np.concatenate(faces), name)
