"""Results of beams that are not where methods were told: each is judged after the rigid move that suits it best.

What no frame can tell, a motion of the whole object, must not count. So the truth is moved onto each result, and each
result puts all frames where they fit it best (`align.held_out`), whatever its method did about poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from holosplat.align.held_out import place_frames
from holosplat.align.poses import PoseOptions
from holosplat.beamline.declared.case import Case
from holosplat.checks import InputError
from holosplat.progress import Progress
from holosplat.representations import Stored
from holosplat.scan import Scan
from holosplat.specimens.scene import MeshScene
from holosplat.volume import Volume

BLURS = (3.0, 1.0)
"""Gaussian blurs of both volumes [voxels], one after the other: a wide one catches moves of some voxels."""
ROUNDS = 6
"""Gauss–Newton steps at each blur; they settle in four."""
PLACING = 4
"""Rounds in which frames are placed on each size of pixels: the matter is known, and errors are of a pixel."""


@dataclass(frozen=True)
class Move:
    """`x' = R x + t`: rotation [3, 3], translation [3] [m]."""

    rotation: np.ndarray
    translation: np.ndarray

    @classmethod
    def best(cls, truth: Volume, found: Volume) -> Move:
        """The move of `truth` onto `found`, both on one grid of cubic voxels, with the least squares of δ."""
        voxel = truth.grid.voxel_size[0]
        axes = [(axis - middle) / voxel for axis, middle in zip(truth.grid.axes(), truth.grid.centre)]
        z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
        points = np.stack([x, y, z], axis=-1)
        scale = float(np.abs(truth.delta).max())
        rotation, translation = np.eye(3), np.zeros(3)
        for blur in BLURS:
            still, target = (gaussian_filter(volume.delta / scale, blur) for volume in (truth, found))
            for _ in range(ROUNDS):
                turn, step = _step(still, target, points, rotation, translation)
                rotation, translation = turn @ rotation, turn @ translation + step
        middle = truth.grid.centre
        return cls(rotation, voxel * translation + middle - rotation @ middle)

    def of(self, scene: MeshScene) -> MeshScene:
        """The moved scene."""
        meshes = tuple(mesh.transformed(self.rotation, self.translation) for mesh in scene.meshes)
        return replace(scene, meshes=meshes)


def _step(
    still: np.ndarray, target: np.ndarray, points: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The turn [3, 3] and then the translation [3] [voxels] that bring `still`, moved as it is, nearer to `target`.

    A small turn ω and translation τ change the moved volume f by `-(ω × x + τ) · ∇f`.
    """
    back = (points - translation) @ rotation + 0.5 * (np.array(still.shape[::-1]) - 1)
    moved = map_coordinates(still, np.moveaxis(back[..., ::-1], -1, 0), order=1)
    slopes = np.stack([np.asarray(np.gradient(moved, axis=axis)) for axis in (2, 1, 0)], axis=-1)
    near = (slopes**2).sum(-1) > 0
    slopes, missing, at = slopes[near], (target - moved)[near], points[near]
    columns = -np.concatenate([np.cross(at, slopes), slopes], axis=1)
    found = np.linalg.lstsq(columns.T @ columns, columns.T @ missing, rcond=1e-12)[0]
    return Rotation.from_rotvec(found[:3]).as_matrix(), found[3:]


def judged_with(case: Case, found: Stored, scan: Scan, truth: Volume, on_progress: Progress) -> tuple[Scan, Volume]:
    """The frames of `scan` where they fit `found` best, and the truth moved onto it; errors: `InputError` for scenes
    without meshes."""
    if not isinstance(case.scene, MeshScene):
        raise InputError(f"beams of {case.name} are elsewhere, for which the scene must be of meshes.")
    moved = Move.best(truth, found.voxelise(truth.grid)).of(case.scene).voxelise(truth.grid)
    placed = place_frames(found, scan, PoseOptions(rounds=PLACING), on_progress).exposures
    return Scan(scan.frames, placed, scan.is_test, scan.provenance), moved
