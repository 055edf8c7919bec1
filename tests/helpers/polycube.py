"""A solid of cubes without symmetry, as a closed mesh."""

from __future__ import annotations

import numpy as np

from holosplat.mesh import TriangleMesh

CELLS = ((0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 2), (0, 0, 3), (2, 1, 0))
"""A corner with three arms of different lengths, one of them bent."""


def polycube(edge: float, cells: tuple[tuple[int, int, int], ...] = CELLS) -> TriangleMesh:
    """The surface of cubes of `edge` [m] in cells (x, y, z) of a lattice: two triangles for each outer face."""
    corners, faces = list[tuple[float, ...]](), list[tuple[int, int, int]]()
    for cell in cells:
        for axis in range(3):
            for side in (0, 1):
                beside = list(cell)
                beside[axis] += 2 * side - 1
                if tuple(beside) in cells:
                    continue
                u, v = ((axis + 1) % 3, (axis + 2) % 3) if side else ((axis + 2) % 3, (axis + 1) % 3)
                first = len(corners)
                for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    corner = [float(n) for n in cell]
                    corner[axis] += side
                    corner[u] += a
                    corner[v] += b
                    corners.append(tuple(edge * n for n in corner))
                faces += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    return TriangleMesh(np.array(corners), np.array(faces), "polycube").merged()
