"""Bodies that move: snapshots of closed meshes, and straight lines between them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..checks import InputError, finite, require, shaped
from ..geometry import Grid, Views
from ..mesh import TriangleMesh
from ..volume import LineIntegrals, Volume
from .scene import MeshScene

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
