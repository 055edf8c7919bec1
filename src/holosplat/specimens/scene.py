"""Truths that simulations start from: closed triangle meshes of one material each, still or moving, and volumes of
voxels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn.functional import grid_sample

from ..checks import InputError, finite, require, shaped
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..mesh import TriangleMesh, joined
from ..projectors.mesh import mesh_line_integrals, voxelise_meshes
from ..projectors.voxels.raycast import voxel_line_integrals
from ..volume import LineIntegrals, Unmoved, Volume


@dataclass(frozen=True)
class MeshScene(Unmoved):
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
        return float((np.abs(_seen(vertices, views)) - 0.5 * views.fields[:, None]).max())

    def _soup(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[tuple[float, float], ...]]:
        """All meshes as one: vertices [P, 3], faces [F, 3], and the matter of each face's body, [C, F] of C kinds.

        The kinds are the (δ, β) of the materials, or units of δ and of β where there are more than two materials.
        """
        whole = joined(self.meshes)
        matter = np.array([(m.delta, m.beta) for m in self.materials], dtype=np.float64)  # [M, 2]
        kinds = tuple(dict.fromkeys((float(delta), float(beta)) for delta, beta in matter))
        if len(kinds) > 2:
            values, kinds = matter.T, ((1.0, 0.0), (0.0, 1.0))
        else:
            values = np.stack([(matter == kind).all(1) for kind in kinds]).astype(np.float64)
        values = np.repeat(values, [len(m.faces) for m in self.meshes], axis=1)
        return whole.vertices, whole.faces, values, kinds


STEP = 0.25
"""Distance of samples along a ray, in voxels: line integrals are then right to 1e-3 of the thickest."""
MOST_POINTS = 1 << 22
"""Points that are evaluated at once."""


@dataclass(frozen=True, eq=False)
class VoxelScene(Unmoved):
    """The truth that a volume describes: its values stand at the centres of voxels, and are interpolated in between.

    No fit projects so: fits use slice matrices and the lattice of voxels. `InputError` for a volume without matter.
    """

    volume: Volume

    def __post_init__(self) -> None:
        empty = not (self.volume.delta.any() or self.volume.beta.any())
        require(not empty, "a volume must hold matter, but its δ and β are zero everywhere.")

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner `(x, y, z)` [m] of the voxels that are not empty."""
        filled = (self.volume.delta != 0) | (self.volume.beta != 0)
        low, high = [], []
        for axis, at, size in zip((2, 1, 0), self.volume.grid.axes(), self.volume.grid.voxel_size):
            there = np.flatnonzero(filled.any(tuple(a for a in range(3) if a != axis)))
            low.append(at[there[0]] - 0.5 * size)
            high.append(at[there[-1]] + 0.5 * size)
        return np.array(low), np.array(high)

    def missing_field(self, views: Views) -> float:
        """How far [m] the filled box reaches beyond the detector in the worst view (0 or less: it fits)."""
        lab = _corners(self.bounds, views)
        return float((np.abs(lab) - 0.5 * views.fields[:, None]).max())

    def project(self, views: Views) -> LineIntegrals:
        """Line integrals of δ and β, [V, 2, H, W]: one channel where β is δ times a number.

        Rays are cast where the filled box is, with a margin of a voxel, and no others.
        """
        values, kinds = self._channels()
        counts = np.array(views.shape[::-1])
        lines = torch.zeros((len(views), len(kinds), *views.shape))
        margin = max(self.volume.grid.voxel_size)
        for v, (lab, p) in enumerate(zip(_corners(self.bounds, views), views.pixel_sizes)):
            first = np.clip(np.floor((lab.min(0) - margin) / p + 0.5 * counts), 0, counts).astype(int)
            last = np.clip(np.ceil((lab.max(0) + margin) / p + 0.5 * counts), 0, counts).astype(int)
            if np.any(last <= first):
                continue
            shift = views.shifts[v] + (0.5 * (first + last) - 0.5 * counts) * p
            (w, h), (column, row) = last - first, first
            one = views[[v]]
            part = Views(one.rotations, shift[None], (h, w), float(p), sources=one.sources)
            cast = voxel_line_integrals(values, self.volume.grid, part, step=STEP)
            lines[v, :, row : row + h, column : column + w] = cast[0]
        return LineIntegrals(lines, kinds)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β averaged over the voxels of `grid`: the mean of two points or more a voxel of the volume and edge."""
        own = self.volume.grid
        n = max(2, *(2 * int(np.ceil(d / o)) for d, o in zip(grid.voxel_size, own.voxel_size)))
        values = torch.from_numpy(np.stack([self.volume.delta, self.volume.beta]))[None]
        fine = zip(grid.divided((n, n, n)).axes(), own.centre, own.voxel_size, own.shape[::-1])
        x, y, z = (2 * (at - centre) / (size * count) for at, centre, size, count in fine)
        out = np.zeros((2, *grid.shape), np.float32)
        step = max(1, MOST_POINTS // (n * len(x) * len(y)))
        for start in range(0, grid.shape[0], step):
            stop = min(start + step, grid.shape[0])
            axes = [torch.from_numpy(a).float() for a in (z[n * start : n * stop], y, x)]
            mesh = torch.stack(torch.meshgrid(*axes, indexing="ij")[::-1], -1)
            found = grid_sample(values, mesh[None], align_corners=False)[0].numpy()
            out[:, start:stop] = found.reshape(2, stop - start, n, len(y) // n, n, len(x) // n, n).mean((2, 4, 6))
        return Volume(out[0], out[1], grid)

    def _channels(self) -> tuple[torch.Tensor, tuple[tuple[float, float], ...]]:
        """δ in units of its largest, [1, Z, Y, X], if β follows it, else δ and β, [2, Z, Y, X]; and what they are."""
        delta, beta = self.volume.delta, self.volume.beta
        scale = float(np.abs(delta).max())
        if scale > 0:
            factor = float(np.sum(beta * delta, dtype=np.float64) / np.sum(np.square(delta), dtype=np.float64))
            if np.abs(beta - factor * delta).max() <= 1e-6 * max(float(np.abs(beta).max()), 1e-30):
                return torch.from_numpy(delta / np.float32(scale))[None], ((scale, factor * scale),)
        scales = [float(np.abs(a).max()) or 1.0 for a in (delta, beta)]
        values = np.stack([a / np.float32(s) for a, s in zip((delta, beta), scales)])
        return torch.from_numpy(values), ((scales[0], 0.0), (0.0, scales[1]))


def _corners(bounds: tuple[np.ndarray, np.ndarray], views: Views) -> np.ndarray:
    """The corners [V, 8, 2] of a box on each view's detector [m], from its middle."""
    corners = np.stack(np.meshgrid(*zip(*bounds), indexing="ij"), -1).reshape(-1, 3)
    return _seen(corners, views)


def _seen(points: np.ndarray, views: Views) -> np.ndarray:
    """Where points [P, 3] are seen on each view's detector [V, P, 2] [m], from its middle."""
    lab = np.einsum("vij,pj->vpi", views.rotations, points)
    seen = lab[..., :2] if views.sources is None else lab[..., :2] / (1 + lab[..., 2:] / views.sources[:, None, None])
    return seen - views.shifts[:, None]


JUMP = 4.0
ROUNDING = 1e-9
"""Times beyond the series by less than this share of its length are its ends."""


@dataclass(frozen=True)
class MeshSeries:
    """Snapshots of the same bodies at growing times; between them each vertex moves straight and evenly.

    snapshots: scenes [T] whose bodies come in the same order, with the same triangles and materials.
    times: [T] s.

    Straight lines leave a body's volume right to second order in how far it turns between two snapshots.

    Errors: `InputError` naming the body whose triangles, number or material change.
    """

    snapshots: tuple[MeshScene, ...]
    times: np.ndarray

    def __post_init__(self) -> None:
        require(len(self.snapshots) > 0, "a series needs at least one snapshot.")
        times = finite("snapshot times", np.asarray(self.times, dtype=np.float64))
        object.__setattr__(self, "times", shaped("snapshot times", times, (len(self.snapshots),)))
        steps = np.diff(times)
        if not (steps > 0).all():
            n = int(np.flatnonzero(steps <= 0)[0])
            raise InputError(
                f"snapshot times must grow, but the one numbered {n + 1} (from 0), at {times[n + 1]:g} s, follows one "
                f"at {times[n]:g} s."
            )
        for scene in self.snapshots[1:]:
            _require_alike(self.snapshots[0], scene)

    def on(self, backend: str) -> MeshSeries:
        """The series for another backend (resolved)."""
        return replace(self, snapshots=tuple(scene.on(backend) for scene in self.snapshots))

    def at(self, time: float) -> MeshScene:
        """The bodies at `time` [s]; `InputError` outside the series."""
        first, last = self.times[0], self.times[-1]
        slack = ROUNDING * (last - first)
        require(
            first - slack <= time <= last + slack,
            f"time must lie between the first and the last snapshot, {first:g} and {last:g} s, but it is {time:g} s.",
        )
        k = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, max(len(self.times) - 2, 0)))
        if len(self.times) == 1:
            return self.snapshots[0]
        part = float(np.clip((time - self.times[k]) / (self.times[k + 1] - self.times[k]), 0, 1))
        before, after = self.snapshots[k], self.snapshots[k + 1]
        meshes = tuple(_between(a, b, part) for a, b in zip(before.meshes, after.meshes))
        return replace(before, meshes=meshes)

    def project(self, views: Views) -> LineIntegrals:
        """Line integrals at the first snapshot's time."""
        return self.snapshots[0].project(views)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β at the first snapshot's time."""
        return self.snapshots[0].voxelise(grid)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner `(x, y, z)` [m] of the box that the bodies sweep."""
        low, high = zip(*(scene.bounds for scene in self.snapshots))
        return np.min(low, axis=0), np.max(high, axis=0)

    def missing_field(self, views: Views) -> float:
        """How far [m] the bodies ever reach beyond the detector in the worst view (0 or less: they fit)."""
        return max(scene.missing_field(views) for scene in self.snapshots)

    def moved(self, translation: np.ndarray) -> MeshSeries:
        """The series shifted by `translation` (x, y, z) [m]."""
        return replace(self, snapshots=tuple(scene.moved(translation) for scene in self.snapshots))

    def delayed(self, seconds: float) -> MeshSeries:
        """The same motion, `seconds` later."""
        return replace(self, times=self.times + seconds)

    def unfolded(self, period: np.ndarray) -> MeshSeries:
        """The series with bodies followed through the sides of a periodic box, where their centres jump.

        period: the box's edges (x, y, z) [m], 0 along axes that are not periodic. A body must move by less than half
        a period from one snapshot to the next; in the first snapshot all stay where they are. Errors: `InputError` for
        a negative period, and for one that bodies do not fit into.
        """
        period = finite("period", np.asarray(period, dtype=np.float64).reshape(3))
        require(bool((period >= 0).all()), f"period must not be negative, but it is {period.tolist()} m.")
        largest = self._sizes().max(axis=0)
        for axis in np.flatnonzero((period > 0) & (period < largest)):
            raise InputError(
                f"period must be at least as long as the bodies, {largest[axis]:.3g} m along {'xyz'[axis]}, but it is "
                f"{period[axis]:.3g} m; mind the unit: it is that of the files."
            )
        centres = self._centres()
        jumps = np.zeros_like(centres)
        wraps = period > 0
        jumps[1:, :, wraps] = -period[wraps] * np.round(np.diff(centres, axis=0)[..., wraps] / period[wraps])
        shifts = jumps.cumsum(axis=0)
        return replace(self, snapshots=tuple(_shifted(s, by) for s, by in zip(self.snapshots, shifts)))

    def require_continuous(self) -> None:
        """`InputError` where a body jumps by more than its size and `JUMP` usual steps: it was folded into a box."""
        steps = np.abs(np.diff(self._centres(), axis=0))  # [T - 1, M, 3]
        usual = np.median(steps, axis=(0, 1)) if len(steps) else np.zeros(3)
        found = np.argwhere(steps > np.maximum(JUMP * usual, self._sizes()))
        if len(found):
            t, body, axis = found[0]
            raise InputError(
                f"{self.snapshots[t + 1].meshes[body].name} jumps by {1e6 * steps[t, body, axis]:.4g} µm along "
                f"{'xyz'[axis]} against the snapshot before; if the bodies were folded into a periodic box, give "
                "--period (its edges, 0 where it is not periodic); --period 0 0 0 says that they were not."
            )

    def _centres(self) -> np.ndarray:
        """Means of the bodies' vertices [T, M, 3]."""
        return np.array([[mesh.vertices.mean(0) for mesh in scene.meshes] for scene in self.snapshots])

    def _sizes(self) -> np.ndarray:
        """Extents [M, 3] of the bodies in the first snapshot."""
        return np.array([np.subtract(*mesh.bounds[::-1]) for mesh in self.snapshots[0].meshes])


def _between(before: TriangleMesh, after: TriangleMesh, part: float) -> TriangleMesh:
    return replace(before, vertices=(1 - part) * before.vertices + part * after.vertices)


def _shifted(scene: MeshScene, by: np.ndarray) -> MeshScene:
    return replace(scene, meshes=tuple(m.transformed(np.eye(3), v) for m, v in zip(scene.meshes, by)))


def _require_alike(first: MeshScene, other: MeshScene) -> None:
    require(
        len(first.meshes) == len(other.meshes),
        f"every snapshot must hold the same bodies, but one holds {len(first.meshes)} and another {len(other.meshes)}.",
    )
    for a, b, before, after in zip(first.meshes, other.meshes, first.materials, other.materials):
        same = len(a.vertices) == len(b.vertices) and np.array_equal(a.faces, b.faces)
        require(
            same,
            f"{b.name} must have the triangles of {a.name} ({len(a.faces)} on {len(a.vertices)} vertices), to move "
            f"from one to the other, but it has {len(b.faces)} on {len(b.vertices)}, or joins them otherwise.",
        )
        require(before == after, f"{b.name} must be made of what {a.name} is made of, but δ, β are others.")
