"""A scene of closed triangle meshes, each filled with one material: the truth that simulations start from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..checks import require
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..mesh import TriangleMesh
from ..projectors.mesh import mesh_line_integrals, voxelise_meshes
from ..volume import LineIntegrals, Volume


@dataclass(frozen=True)
class MeshScene:
    """A scene of closed meshes, each filled with one material.

    meshes: with outward normals (see `specimens.repair.closed`); coordinates `(x, y, z)` [m].
    materials: δ and β of each mesh, dimensionless.
    backend: that projects them, resolved (see `backends`).

    Errors: `InputError` without a mesh, and unless there is one material for each.

    Examples:

        >>> import holosplat as hs
        >>> cells = hs.specimens.random_cells(2, box=(24e-6, 24e-6, 24e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, hs.DeltaBeta(5.8e-7, 2.6e-10))
        >>> volume = scene.voxelise(hs.Grid.centred((24, 24, 24), voxel_size=1e-6))
        >>> f"{volume.delta.max():.1e}"
        '5.8e-07'
        >>> B, D = scene.project(hs.Views.evenly_spaced(3, shape=(24, 24), pixel_size=1e-6))
        >>> tuple(D.shape)  # line integrals of δ [m]
        (3, 24, 24)
    """

    meshes: tuple[TriangleMesh, ...]
    materials: tuple[DeltaBeta, ...]
    backend: str = "cpu"
    """What projects them, resolved (see `backends`)."""

    @classmethod
    def of_one_material(cls, meshes: Sequence[TriangleMesh], material: DeltaBeta) -> MeshScene:
        """All meshes filled with the same δ, β."""
        return cls(tuple(meshes), (material,) * len(meshes))

    def __post_init__(self) -> None:
        require(len(self.meshes) > 0, "a scene needs at least one mesh.")
        require(len(self.meshes) == len(self.materials), "a scene needs one material for each mesh.")

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner `(x, y, z)` [m] of all meshes together."""
        low, high = zip(*(mesh.bounds for mesh in self.meshes))
        return np.min(low, axis=0), np.max(high, axis=0)

    def moved(self, translation: np.ndarray) -> MeshScene:
        """The scene shifted by `translation` (x, y, z) [m]."""
        return replace(self, meshes=tuple(m.transformed(np.eye(3), translation) for m in self.meshes))

    def on(self, backend: str) -> MeshScene:
        """The scene for another backend (resolved)."""
        return replace(self, backend=backend)

    def at(self, time: float) -> MeshScene:
        """The scene itself: it does not move."""
        return self

    def project(self, views: Views) -> LineIntegrals:
        """Line integrals of each material, or of δ and β where there are more than two; float64, 2 × 2 rays a pixel."""
        vertices, faces, values, kinds = self._soup()
        return LineIntegrals(mesh_line_integrals(vertices, faces, values, views, backend=self.backend), kinds)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β averaged over voxels (partial occupancy at surfaces)."""
        vertices, faces, values, kinds = self._soup()
        shares = voxelise_meshes(vertices, faces, values, grid)
        delta, beta = (sum((n * share for n, share in zip(of, shares)), np.zeros(grid.shape)) for of in zip(*kinds))
        return Volume(delta, beta, grid)

    def missing_field(self, views: Views) -> float:
        """How far [m] the scene reaches beyond the detector in the worst view (0 or less: it fits)."""
        vertices = np.concatenate([m.vertices for m in self.meshes])
        lab = np.einsum("vij,pj->vpi", views.rotations, vertices)[..., :2] - views.shifts[:, None]
        return float((np.abs(lab) - 0.5 * views.fields[:, None]).max())

    def _soup(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[tuple[float, float], ...]]:
        """All meshes as one: vertices [P, 3], faces [F, 3], and the matter of each face's body, [C, F] of C kinds.

        The kinds are the (δ, β) of the materials, or units of δ and of β where there are more than two materials.
        """
        offsets = np.cumsum([0] + [len(m.vertices) for m in self.meshes[:-1]])
        faces = np.concatenate([m.faces + o for m, o in zip(self.meshes, offsets)])
        matter = np.array([(m.delta, m.beta) for m in self.materials], dtype=np.float64)  # [M, 2]
        kinds = tuple(dict.fromkeys((float(delta), float(beta)) for delta, beta in matter))
        if len(kinds) > 2:
            values, kinds = matter.T, ((1.0, 0.0), (0.0, 1.0))
        else:
            values = np.stack([(matter == kind).all(1) for kind in kinds]).astype(np.float64)
        values = np.repeat(values, [len(m.faces) for m in self.meshes], axis=1)
        return np.concatenate([m.vertices for m in self.meshes]), faces, values, kinds
