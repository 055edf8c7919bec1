"""Shaded pictures of closed meshes, each of its own colour, seen along the beam or from any side.

Triangles that face the viewer are painted from far to near, so that nothing but matplotlib is needed. The camera is a
view, as in `surface.py`: it looks along +z_lab, with columns to the right and rows down.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb

from ..mesh import TriangleMesh
from .style import CYCLE
from .surface import FILL_LIGHT, KEY_LIGHT

UNIT = 1e6
"""Pictures are drawn in micrometres."""


def body_colours(count: int) -> list[tuple[float, float, float]]:
    """A colour for each body: those of the palette, then lighter and darker ones of them, over and over."""
    made = []
    for k in range(count):
        base, turn = np.array(to_rgb(CYCLE[k % len(CYCLE)])), k // len(CYCLE) % 3
        mixed = base if turn == 0 else 0.5 * base + 0.5 if turn == 1 else 0.6 * base
        made.append((float(mixed[0]), float(mixed[1]), float(mixed[2])))
    return made


def paint_bodies(
    axes: Axes,
    meshes: Sequence[TriangleMesh],
    rotation: np.ndarray,
    shift: np.ndarray,
    colours: Sequence[tuple[float, float, float]],
) -> PolyCollection:
    """Draw `meshes` in `axes`, whose unit is the micrometre; rotation [3, 3], shift [2] [m]: of the view."""
    corners, paints, depths = [], [], []
    for mesh, colour in zip(meshes, colours):
        points = UNIT * (mesh.vertices @ np.asarray(rotation).T - np.array([*shift, 0.0]))
        normals = _vertex_normals(points, mesh.faces)[mesh.faces].mean(1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        a, b, c = np.moveaxis(points[mesh.faces], 1, 0)
        seen = np.cross(b - a, c - a)[:, 2] < 0
        corners.append(points[mesh.faces][seen])
        paints.append(_shaded(np.array(colour), normals[seen]))
        depths.append(corners[-1][:, :, 2].mean(1))
    order = np.argsort(-np.concatenate(depths))
    faces, paint = np.concatenate(corners)[order], np.concatenate(paints)[order]
    drawn = PolyCollection(list(faces[:, :, :2]), facecolors=paint, edgecolors=paint, linewidths=0.25)
    axes.add_collection(drawn, autolim=False)
    return drawn


def _vertex_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[P, 3], the sums of the vector areas of the triangles around."""
    a, b, c = np.moveaxis(points[faces], 1, 0)
    across = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    return np.stack([np.bincount(faces.ravel(), across[:, axis], len(points)) for axis in range(3)], axis=1)


def _shaded(colour: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """RGB [F, 3] of faces with unit `normals` [F, 3] in the lab frame: two lights, a gloss, a dark rim."""
    key, fill = (np.array(light) / np.linalg.norm(light) for light in (KEY_LIGHT, FILL_LIGHT))
    halfway = (key + [0.0, 0.0, -1.0]) / np.linalg.norm(key + [0.0, 0.0, -1.0])
    bright = 0.42 + 0.62 * np.clip(normals @ key, 0, 1) + 0.18 * np.clip(normals @ fill, 0, 1)
    bright *= 1 - 0.45 * (1 - np.clip(-normals[:, 2], 0, 1)) ** 3
    gloss = 0.12 * np.clip(normals @ halfway, 0, 1) ** 30
    return np.clip(colour * bright[:, None] + gloss[:, None], 0, 1)
