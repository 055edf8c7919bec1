"""Bodies as single times show them: a volume of each time by itself, cut into closed surfaces."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from ..baselines import HolographicTV, holographic_tv
from ..bodies.moments import centroid
from ..bodies.touching import parted
from ..checks import InputError, in_range
from ..geometry import Grid, Views
from ..learning.network import Guess
from ..learning.start import guessed
from ..matter import DeltaBeta, Matter
from ..mesh import TriangleMesh
from ..progress import Progress
from ..ranges import Pixels, Weight, ranged
from ..representations import SurfaceMesh, isosurface
from ..scan import Scan


@dataclass(frozen=True)
class Sighting:
    """A body at one time. mesh: its surface [m]; cut: whether it goes on beyond the field, so that a part is seen."""

    mesh: TriangleMesh
    cut: bool

    @property
    def volume(self) -> float:
        """What is seen of it [m³]."""
        return self.mesh.volume

    @property
    def centre(self) -> np.ndarray:
        """The middle `(x, y, z)` [m] of what is seen: the centroid of the volume (divergence theorem)."""
        return centroid(self.mesh)

    @property
    def reach(self) -> float:
        """Radius [m] of a ball of its volume."""
        return float((3 * abs(self.volume) / (4 * np.pi)) ** (1 / 3))


@dataclass(frozen=True)
@ranged
class SightingOptions:
    """How bodies are found in the frames of one time."""

    volume: HolographicTV = field(default_factory=lambda: HolographicTV(iterations=60, corrections=0))
    """The volume of one time by itself: 160 iterations find no other bodies than 60 do."""
    level: float = 0.5
    """Occupancy at the surface."""
    least_volume: Weight = 30.0
    """Bodies of fewer voxels are left out: noise, or too little to be followed."""
    smoothing: int = 10
    """Steps that smooth away the voxels' traces."""
    edge: Pixels = 1.0
    """Bodies that come nearer to the field's edge than this are cut by it [pixels]."""

    def __post_init__(self) -> None:
        in_range("level", self.level, 0.01, 0.99)


def sightings(
    scan: Scan,
    material: DeltaBeta,
    options: SightingOptions = SightingOptions(),
    on_progress: Progress = lambda stage, part: None,
    network: Guess | None = None,
) -> list[Sighting]:
    """The bodies of `material` in the frames of `scan`, of one time, the largest first; none where nothing is seen.

    network: guesses the volume, which is made by total variation without one.
    """
    values, grid = occupancy(scan, material, options, on_progress, network)
    pixel = scan.views.finest
    least = options.least_volume * (pixel / grid.voxel_size[0]) ** 3
    try:
        mesh = isosurface(parted(values.numpy(), options.level, least), grid, options.level, least, options.smoothing)
        unit = torch.from_numpy(mesh.vertices / pixel)
        bodies = SurfaceMesh(unit, torch.from_numpy(mesh.faces), pixel, Matter.one(*material)).bodies()
    except InputError:  # nothing reaches the level, or cavities alone do
        return []
    return [Sighting(body, is_cut(body, scan.views, options.edge)) for body in bodies]


def occupancy(
    scan: Scan, material: DeltaBeta, options: SightingOptions, on_progress: Progress, network: Guess | None
) -> tuple[Tensor, Grid]:
    """The volume [Z, Y, X] of one time, and its voxels; by `network`, if there is one."""
    if network is None:
        return holographic_tv(scan, material, options.volume, on_progress)
    found = guessed(scan, material, network, on_progress)
    return found.values, found.grid


def is_cut(body: TriangleMesh, views: Views, edge: float = 1.0) -> bool:
    """Whether `body` comes within `edge` pixels of the rows' ends in any view, or of the columns' in all of them.

    What one view's columns cut, others may see whole; rows are common to all views about one axis, but need not be.
    """
    seen = np.einsum("vij,pj->vpi", views.rotations[:, :2], body.vertices) - views.shifts[:, None]
    rows, columns = views.shape
    half = 0.5 * np.array([columns, rows]) * views.pixel_sizes[:, None] - edge * views.pixel_sizes[:, None]
    beyond = (np.abs(seen) > half[:, None]).any(1)  # [V, 2]: of columns, of rows
    return bool(beyond[:, 1].any() or beyond[:, 0].all())
