"""A triangle mesh, as specimens make it and projectors read it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .checks import InputError, finite, shaped


@dataclass(frozen=True)
class TriangleMesh:
    """vertices: [P, 3] float64 object-frame coordinates `(x, y, z)` [m]; faces: [F, 3] int64 vertex indices.

    A closed mesh with outward normals (counter-clockwise seen from outside) encloses positive volume.
    """

    vertices: np.ndarray
    faces: np.ndarray
    name: str = "mesh"

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        finite(f"{self.name}: vertex coordinates", shaped(f"{self.name}: vertices", vertices, (None, 3)))
        faces = np.ascontiguousarray(self.faces, dtype=np.int64)
        shaped(f"{self.name}: faces", faces, (None, 3))
        if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError(f"{self.name}: faces must name existing vertices, at least one face.")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @property
    def volume(self) -> float:
        """Signed enclosed volume [m³]: Σ a·(b × c)/6 (divergence theorem)."""
        a, b, c = np.moveaxis((self.vertices - self.vertices.mean(0))[self.faces], 1, 0)
        return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)

    @property
    def area(self) -> float:
        """Area of the surface [m²]."""
        return float(np.linalg.norm(vector_areas(self), axis=1).sum())

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner `(x, y, z)` [m] of the bounding box."""
        return self.vertices.min(0), self.vertices.max(0)

    def merged(self, tolerance: float = 0.0) -> TriangleMesh:
        """The mesh with vertices closer than `tolerance` [m] (0: equal ones) made one.

        Triangles left with a repeated vertex are dropped; the order of the vertices that stay is kept.
        """
        if tolerance > 0:
            from scipy.spatial import KDTree  # which takes longer to load than meshes to read

            group = _connected(KDTree(self.vertices).query_pairs(tolerance, output_type="ndarray"), len(self.vertices))
        else:
            _, group = np.unique(self.vertices, axis=0, return_inverse=True)
        _, first, group = np.unique(group.reshape(-1), return_index=True, return_inverse=True)
        kept, index = np.unique(first[group.reshape(-1)], return_inverse=True)
        faces = index.reshape(-1)[self.faces]
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
        if len(faces) == 0:
            raise InputError(f"{self.name}: all triangles are degenerate (two corners coincide); check the mesh.")
        return replace(self, vertices=self.vertices[kept], faces=faces)

    def transformed(self, rotation: np.ndarray, translation: np.ndarray) -> TriangleMesh:
        """The mesh moved to `rotation @ vertex + translation` ([3, 3], [3] in metres)."""
        return replace(self, vertices=self.vertices @ np.asarray(rotation).T + np.asarray(translation))


def joined(meshes: Sequence[TriangleMesh], name: str = "mesh") -> TriangleMesh:
    """All meshes as one, their vertices and faces one mesh after the other."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts)])
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), faces, name)


def part_of(mesh: TriangleMesh, faces: np.ndarray, name: str) -> TriangleMesh:
    """The mesh of `faces` [F, 3] and of those vertices alone that they name."""
    used, index = np.unique(faces, return_inverse=True)
    return TriangleMesh(mesh.vertices[used], index.reshape(-1, 3), name)


def shell_labels(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """[F] the number, from 0 on, of the connected shell that each of `faces` [F, 3] belongs to."""
    group = _connected(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]), vertex_count)
    return np.unique(group[faces[:, 0]], return_inverse=True)[1].reshape(-1)


def _connected(pairs: np.ndarray, count: int) -> np.ndarray:
    """[count] the number of the group that each vertex belongs to, where `pairs` [E, 2] belong together."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def winding_number(triangles: np.ndarray, point: np.ndarray) -> float:
    """How often the closed surface `triangles` [F, 3, 3] winds about `point` [3], without its sign.

    The triangles' solid angles, summed (van Oosterom & Strackee 1983, IEEE Trans. Biomed. Eng. 30, 125,
    eq. 8).
    """
    a, b, c = np.moveaxis(triangles - point, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    numerator = np.einsum("fi,fi->f", a, np.cross(b, c))
    dots = [np.einsum("fi,fi->f", u, v) for u, v in ((a, b), (b, c), (c, a))]
    denominator = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return float(abs(2 * np.arctan2(numerator, denominator).sum()) / (4 * np.pi))


def ball_radius(volume: float) -> float:
    """Radius [m] of the ball of a `volume` [m³]."""
    return float((3 * volume / (4 * np.pi)) ** (1 / 3))


def vector_areas(mesh: TriangleMesh) -> np.ndarray:
    """[F, 3] m²: normals of the triangles, of the length of the triangle's area."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return 0.5 * np.cross(b - a, c - a)


def areas(mesh: TriangleMesh) -> np.ndarray:
    """[P] m² around each vertex: a third of its triangles."""
    found = np.linalg.norm(vector_areas(mesh), axis=1) / 3
    return np.bincount(mesh.faces.ravel(), np.repeat(found, 3), minlength=len(mesh.vertices))


def sums_of_areas(mesh: TriangleMesh) -> np.ndarray:
    """[P, 3] m² at the vertices: the sums of `vector_areas` of the triangles around."""
    corners, across = mesh.faces.ravel(), np.repeat(vector_areas(mesh), 3, axis=0)
    return np.stack([np.bincount(corners, across[:, axis], len(mesh.vertices)) for axis in range(3)], axis=1)


def normals(mesh: TriangleMesh) -> np.ndarray:
    """[P, 3] outward unit normals at the vertices, means of those of their triangles by area."""
    found = sums_of_areas(mesh)
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), np.finfo(float).tiny)


def across(places: np.ndarray, others: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[T] m: root-mean-square distance of two sets of places [T, P, 3] of a body's vertices along its normals."""
    found = []
    for one, other in zip(places, others):
        mesh = TriangleMesh(one, faces)
        along_normals = ((other - one) * normals(mesh)).sum(1)
        found.append(np.sqrt(np.average(along_normals**2, weights=areas(mesh))))
    return np.array(found)
