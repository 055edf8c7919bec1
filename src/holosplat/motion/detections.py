"""Bodies at single times: a volume of each time, by tomography or by a network, cut into closed surfaces."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from ..baselines import HolographicTV, holographic_tv
from ..bodies.cut import EDGE, LEAST_VOLUME, LEVEL, SMOOTHING, cut_bodies, is_cut
from ..bodies.moments import centroid
from ..checks import in_range
from ..geometry import Grid
from ..inference import Decision, Score, select
from ..learning.network import Guess
from ..learning.start import Guessed, LearnedStart, guess_matter, missing_thickness
from ..matter import DeltaBeta, Matter
from ..mesh import TriangleMesh
from ..progress import Progress
from ..ranges import Pixels, Weight, ranged
from ..representations import VoxelGrid
from ..scan import Scan


@dataclass(frozen=True)
class Detection:
    """A body at one time. mesh: its surface [m]; cut: whether it goes on beyond the field, so that a part is seen."""

    mesh: TriangleMesh
    cut: bool

    @property
    def volume(self) -> float:
        """The visible volume [m³]."""
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
    level: float = LEVEL
    """Occupancy at the surface."""
    least_volume: Weight = LEAST_VOLUME
    """Bodies of fewer voxels are left out: noise, or too little to be followed."""
    smoothing: int = SMOOTHING
    """Steps that smooth away the voxels' traces."""
    edge: Pixels = EDGE
    """Bodies that come nearer to the field's edge than this are cut by it [pixels]."""

    def __post_init__(self) -> None:
        in_range("level", self.level, 0.01, 0.99)


def sightings(
    scan: Scan,
    material: DeltaBeta,
    options: SightingOptions = SightingOptions(),
    on_progress: Progress = lambda stage, part: None,
    network: Guess | None = None,
) -> list[Detection]:
    """The bodies of `material` in the frames of `scan`, of one time, the largest first; none where nothing is seen.

    network: guesses the volume, which is made by total variation without one.
    """
    values, grid = occupancy(scan, material, options, on_progress, network)
    how = options.level, options.least_volume, options.smoothing
    bodies = cut_bodies(values.numpy(), grid, scan.views.finest, *how)
    return [Detection(body, is_cut(body, scan.views, options.edge)) for body in bodies]


def occupancy(
    scan: Scan, material: DeltaBeta, options: SightingOptions, on_progress: Progress, network: Guess | None
) -> tuple[Tensor, Grid]:
    """The volume [Z, Y, X] of one time, and its voxels; by `network`, if there is one."""
    if network is None:
        return holographic_tv(scan, material, options.volume, on_progress)
    found = guess_matter(scan, material, network, on_progress)
    return found.values, found.grid


NAME = "bodies at single times"
TOMOGRAPHY, NETWORK = "tomography", "network's guess"


def network_for(
    scan: Scan, material: DeltaBeta, options: SightingOptions, how: LearnedStart, on_progress: Progress
) -> tuple[Guess | None, Decision]:
    """The network whose guesses show the bodies of `material` in the frames of one time, `scan`, better; or None.

    Both volumes are cut at the bodies' level, for bodies are full, and their shadows compared with retrieved thickness.
    Tomography, the null, was fitted to these frames, and the guess was not.
    """
    trained = how.network
    found = guess_matter(scan, material, trained.network, on_progress)
    values, grid = occupancy(scan, material, options, on_progress, None)
    seen = VoxelGrid(values[None], grid, Matter.one(*material)).resampled(found.grid).values[0]
    scores = {TOMOGRAPHY: missed_by_bodies(seen, found, options.level)}
    scores[NETWORK] = missed_by_bodies(found.values, found, options.level)
    decision = select(NAME, tuple(scores), lambda name, fold: scores[name], by="frames of one time")
    return (trained.network if decision.choice == NETWORK else None), decision


def missed_by_bodies(values: Tensor, found: Guessed, level: float) -> Score:
    """Relative residual of the thickness that the network saw, with full bodies.

    values: [Z, Y, X] on the voxels of `found`, of which what is above `level` is full
    """
    return Score.of(missing_thickness((values > level).to(torch.float32), found.images, found.taps)[0])
