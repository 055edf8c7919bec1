"""Closed, consistently wound meshes, without which chords through a mesh have no meaning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..checks import InputError
from ..mesh import TriangleMesh, part_of, vector_areas, winding_number
from ..units import LENGTH_UNITS, unit_factor


def closed(mesh: TriangleMesh, length_unit: str = "um") -> TriangleMesh:
    """`mesh` watertight and wound outwards (positive volume), or `InputError` saying what is open and where.

    Repairs: duplicate vertices merged, unused ones dropped (the others keep their order); triangles with a repeated
    vertex dropped, and slivers of no area where they prevent closing; winding made consistent within each shell; each
    outermost shell turned outwards. A shell inside another keeps its sense relative to it: a cavity wound inwards stays
    a cavity, a body wound outwards stays a body (its matter adds to its surroundings'). Where the inner shell's own
    winding was inconsistent, it has no sense to keep and becomes a cavity (a body again within a cavity).

    length_unit: the unit in which the error message gives positions (the mesh itself is in metres).
    """
    merged = mesh.merged()
    with_area = merged.faces[_areas(merged) > 0]
    if len(_faulty_edges(merged.faces)[0]) and not len(_faulty_edges(with_area)[0]) and len(with_area):
        merged = replace(merged, faces=with_area)
    _require_closed(merged, length_unit)
    faces, shells, was_consistent = _wound_consistently(merged)
    faces = _turned_outwards(merged, faces, shells, was_consistent)
    return part_of(merged, faces, merged.name)


def _areas(mesh: TriangleMesh) -> np.ndarray:
    """Triangle areas [F] in m², exact zeros below the rounding of the coordinates."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    area = np.linalg.norm(vector_areas(mesh), axis=1)
    longest = np.sqrt(np.max([((b - a) ** 2).sum(1), ((c - b) ** 2).sum(1), ((a - c) ** 2).sum(1)], axis=0))
    return np.where(area > 1e-12 * longest**2, area, 0.0)


def _half_edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges [3 F, 2]; edge `e` belongs to face `e mod F`."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _faulty_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges [E, 2] not shared by exactly two triangles, and how many triangles share each [E]."""
    edges, count = np.unique(np.sort(_half_edges(faces), axis=1), axis=0, return_counts=True)
    return edges[count != 2], count[count != 2]


def _require_closed(mesh: TriangleMesh, length_unit: str) -> None:
    edges, count = _faulty_edges(mesh.faces)
    if len(edges) == 0:
        return
    x, y, z = mesh.vertices[edges[0]].mean(0) / unit_factor("length_unit", length_unit, LENGTH_UNITS)
    faults = []
    if opened := int((count == 1).sum()):
        faults.append(f"{opened} open edge{'s'[: opened > 1]} (a hole or a torn seam)")
    if crowded := int((count > 2).sum()):
        faults.append(f"{crowded} non-manifold edge{'s'[: crowded > 1]} (of more than two triangles)")
    raise InputError(
        f"{mesh.name} must be a closed surface, but it has {' and '.join(faults)}, the first near "
        f"({x:.6g}, {y:.6g}, {z:.6g}) {length_unit}; close it in the program that made it."
    )


def _wound_consistently(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces wound alike within each shell: faces [F, 3], shell of each face [F], was consistent before [S].

    Faces and their reverses are the nodes of a graph (the double cover); neighbours that run along their
    common edge in opposite directions agree. A shell whose face meets its own reverse has one side only.
    """
    faces, count = mesh.faces, len(mesh.faces)
    directed = _half_edges(faces)
    undirected = np.sort(directed, axis=1)
    order = np.lexsort(undirected.T)  # the two half-edges of an edge become neighbours
    first, second = order[0::2], order[1::2]
    f, g = first % count, second % count
    disagree = directed[first, 0] == directed[second, 0]
    partner = np.where(disagree, g + count, g)
    rows = np.concatenate([f, f + count])
    columns = np.concatenate([partner, (partner + count) % (2 * count)])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * count, 2 * count))
    _, cover = connected_components(graph, directed=False)
    if np.any(cover[:count] == cover[count:]):
        raise InputError(
            f"{mesh.name} must have an inside and an outside, but its surface has one side only (like a "
            "Klein bottle); correct it in the program that made it."
        )
    pair = np.sort(np.stack([cover[:count], cover[count:]], axis=1), axis=1)
    _, shells = np.unique(pair[:, 0], return_inverse=True)
    shells = shells.reshape(-1)
    turned = cover[:count] != _majority(cover[:count], pair, shells)[shells]
    was_consistent = np.bincount(shells, weights=turned) == 0
    return np.where(turned[:, None], faces[:, ::-1], faces), shells, was_consistent


def _majority(side: np.ndarray, pair: np.ndarray, shells: np.ndarray) -> np.ndarray:
    """Per shell, the side of the double cover on which most of its faces lie [S]."""
    upper = np.bincount(shells, weights=side == pair[:, 1])
    _, example = np.unique(shells, return_index=True)
    return np.where(2 * upper > np.bincount(shells), pair[example, 1], pair[example, 0])


def _turned_outwards(
    mesh: TriangleMesh, faces: np.ndarray, shells: np.ndarray, was_consistent: np.ndarray
) -> np.ndarray:
    """Outermost shells turned to positive volume; inner ones as `closed` documents."""
    parts = [faces[shells == s] for s in range(len(was_consistent))]
    volumes = np.array([replace(mesh, faces=part).volume for part in parts])
    corners = [mesh.vertices[part] for part in parts]
    boxes = np.array([[corner.min((0, 1)), corner.max((0, 1))] for corner in corners])
    flat = np.abs(volumes) <= 1e-9 * np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=1) ** 3
    if flat.any():
        raise InputError(
            f"{mesh.name} must enclose a volume, but {int(flat.sum())} of its {len(parts)} shells enclose "
            "none; remove what is flat."
        )
    turn = volumes < 0
    around = [_shells_around(s, parts, boxes, mesh.vertices) for s in range(len(parts))]
    for s, outer in enumerate(around):
        if outer and was_consistent[s]:
            outermost = min(outer, key=lambda o: len(around[o]))
            turn[s] = volumes[outermost] < 0
        elif outer:
            turn[s] = (volumes[s] > 0) == (len(outer) % 2 == 1)
    return np.where(turn[shells][:, None], faces[:, ::-1], faces)


def _shells_around(s: int, parts: list[np.ndarray], boxes: np.ndarray, vertices: np.ndarray) -> list[int]:
    """The shells that contain shell `s`."""
    low, high = boxes[s]
    candidates = np.flatnonzero((boxes[:, 0] <= low).all(1) & (boxes[:, 1] >= high).all(1))
    point = vertices[parts[s][0]].mean(0)
    return [int(o) for o in candidates if o != s and winding_number(vertices[parts[o]], point) > 0.5]
