"""Objects as viewers draw them: Gaussians with opacities, or triangles, in a scene of ten units to each side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ..checks import require
from ..geometry import Grid
from ..io.hdf5 import open_hdf5
from ..io.objects import SERIES, read_object, read_series
from ..io.solids import opacities
from ..matter import Matter
from ..mesh import TriangleMesh
from ..representations import GaussianCloud, InMotion, Stored, SurfaceMesh, VoxelGrid, isosurface
from ..units import bar_length, format_length
from ..workflows.matter_map import MatterMap
from ..workflows.reconstruction import instants_of
from ..workflows.rehearsal import matter_of
from ..workflows.run_folder import RunFolder

HALF_EDGE = 10.0
"""Units of the scene from its middle to its farthest side, which suits the cameras of viewers."""
MOST_VOXELS = 1 << 21
"""Voxels of the volume that an object without Gaussians or surfaces is cut from."""
DEPTH = 40.0
"""Optical depth of the thickest ray: viser drops a splat whose opacity times its area squared is under a quarter of a
pixel's, which at depths that can be seen through are all of them."""
NEAR, FAR = (0.95, 0.85, 0.70), (0.25, 0.40, 0.65)
"""Colours of Gaussians at the near end of the object, and at the far one: all of one colour would be a silhouette."""
COLOUR = (205, 80, 60)
"""Of surfaces."""
LEVEL = 0.5
"""Share of the largest |δ| at which that is."""
SURE = (0.9, 0.5, 0.1)
"""Probabilities of matter whose surfaces are shown."""
TIMES = 48
"""Steps of the slider of time, at most."""


@dataclass(frozen=True)
class Splats:
    """centres [N, 3], covariances [N, 3, 3] [m, m²]; colours [N, 3] and opacities [N] from 0 to 1."""

    centres: np.ndarray
    covariances: np.ndarray
    colours: np.ndarray
    opacities: np.ndarray


Shown = Splats | TriangleMesh


@dataclass(frozen=True)
class Frame:
    """The frame of the scene. middle: (x, y, z) [m]; scale: units a metre."""

    middle: np.ndarray
    scale: float

    @classmethod
    def around(cls, grid: Grid) -> Frame:
        """That which holds a grid."""
        half = 0.5 * float((np.array(grid.shape[::-1]) * np.array(grid.voxel_size)).max())
        return cls(grid.centre, HALF_EDGE / half)

    @property
    def bar(self) -> float:
        """The length [m] of the scale bars: a round one, up to a quarter of the scene."""
        return bar_length(2 * HALF_EDGE / self.scale)

    def places(self, points: np.ndarray) -> np.ndarray:
        """Points [N, 3] [m] in units of the scene, float32."""
        return ((points - self.middle) * self.scale).astype(np.float32)


def shown(obj: Stored) -> Shown:
    """What is drawn of an object: Gaussians, surfaces, or the surface at half of the largest |δ| of others;
    `InputError` without one."""
    with torch.no_grad():
        if isinstance(obj, GaussianCloud):
            unit, turns = obj.unit_length, Rotation.from_quat(obj.quaternions.double().numpy()[:, [1, 2, 3, 0]])
            axes = turns.as_matrix() * (unit * obj.scales.double().numpy())[:, None, :]
            centres = unit * obj.centres.double().numpy()
            depth = (centres[:, 2] - centres[:, 2].min()) / max(float(np.ptp(centres[:, 2])), 1e-30)
            colours = np.array(NEAR) + depth[:, None] * (np.array(FAR) - np.array(NEAR))
            return Splats(centres, axes @ axes.transpose(0, 2, 1), colours, opacities(obj, DEPTH))
        if isinstance(obj, SurfaceMesh):
            return obj.mesh()
        grid = obj.enclosing_grid(MOST_VOXELS)
        delta = np.abs(obj.voxelise(grid).delta)
    return isosurface(delta, grid, LEVEL * float(delta.max()))


def at_times(obj: Stored, times: Sequence[float]) -> dict[str, Stored]:
    """The objects of the time slider by label: a moving one at up to `TIMES` of `times` [s], or from the first time of
    its basis to the last if there are none; any other object alone."""
    if not isinstance(obj, InMotion):
        return {"": obj}
    basis = obj.basis
    chosen = np.array(times) if len(times) else np.linspace(basis.first, basis.last, TIMES)
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, min(TIMES, len(chosen))).astype(int))]
    return {f"{1e6 * t:.6g} µs": obj.at(float(t)) for t in chosen}


def likely_surfaces(found: MatterMap) -> dict[str, Stored]:
    """The surfaces within which a voxel is matter with the probabilities `SURE` or more, by what a slider says of each,
    without those that no voxel reaches; each as voxels that `LEVEL` cuts there."""
    values, most = found.values, float(found.values.max())
    return {
        f"matter with a probability of {level:.0%} or more": VoxelGrid(
            torch.from_numpy(np.interp(values, [0, level, most], [0, LEVEL, 1])[None].astype(np.float32)),
            found.found.grid,
            Matter.one(1.0, 0.0),
        )
        for level in SURE
        if level < most
    }


def steps_of(folder: RunFolder) -> list[str]:
    """How far the last fit of a run has come, in words; nothing where metrics.csv does not say."""
    losses = folder.history().get("loss")
    return [] if losses is None or len(losses) == 0 else [f"step {len(losses)}, loss {losses[-1]:.4g}"]


def objects_of(what: Path) -> tuple[dict[str, Stored], list[str], str]:
    """Objects by labels of the slider (times, or a rehearsed run and likely matter), words, the slider's name."""
    require(what.exists(), f"{what} must be a run folder or an object file, but there is none; check the path.")
    if what.is_dir():
        folder = RunFolder(what)
        folder.require_run()
        obj, matter = folder.read_result(), matter_of(folder)
        likely = {} if matter is None else likely_surfaces(matter)
        words, slider = [obj.described, *steps_of(folder)], "shown" if likely else "time"
        return at_times(obj, instants_of(folder)) | likely, words, slider
    with open_hdf5(what) as file:
        several = file.attrs.get("format", "") == SERIES
    if several:
        series = read_series(what)
        return series, [f"{len(series)} objects"], "time"
    obj = read_object(what)
    return at_times(obj, ()), [obj.described], "time"


def legend(part: Shown) -> tuple[str, str]:
    """The legend of the colours of a part, and these as CSS has them, from the near end to the far one."""
    places = part.centres if isinstance(part, Splats) else part.vertices[part.faces]
    low, high = (format_length(float(end)) for end in (places[..., 2].min(), places[..., 2].max()))
    if isinstance(part, TriangleMesh):
        return f"surface of the matter, z from {low} to {high}", f"rgb{COLOUR}, rgb{COLOUR}"
    ends = ", ".join(f"rgb{tuple(round(255 * c) for c in colour)}" for colour in (NEAR, FAR))
    return f"depth z from {low} to {high}; opacity: thickness", ends


def cut(part: Shown, axis: int, share: float) -> Shown:
    """Cut away the nearest `share` (0 to 1) of the matter's extent along `axis`."""
    if share <= 0:
        return part
    if isinstance(part, Splats):
        kept = _beyond(part.centres[:, axis], share)
        return Splats(part.centres[kept], part.covariances[kept], part.colours[kept], part.opacities[kept])
    faces = part.faces[_beyond(part.vertices[part.faces].mean(axis=1)[:, axis], share)]
    return replace(part, faces=faces)


def _beyond(places: np.ndarray, share: float) -> np.ndarray:
    """Which of `places` [N] stay; the farthest always does."""
    low, high = places.min(), places.max()
    return (places >= low + min(share, 1.0) * (high - low)) | (places == high)
