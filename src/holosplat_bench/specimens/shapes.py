"""Shapes that kinds of matter are made of: meshes of balls, boxes, prisms, lathes and lenses, and regions of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holosplat.checks import require
from holosplat.matter import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.specimens.phantoms import packed_balls
from holosplat.specimens.scene import MeshScene

LONG = 16.0
"""Length of what goes on beyond the field at its top or bottom, in units of the size."""
SHARE = DeltaBeta(1.0, 0.0)
"""The matter of a region, whose δ is then the share of a voxel that it fills."""


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
