"""Whether a network's guess shows the bodies of single times better than total variation does."""

from __future__ import annotations

import torch
from torch import Tensor

from ..inference import Decision, Score, select
from ..learning.network import Guess
from ..learning.start import Guessed, LearnedStart, guess_matter, missing_thickness
from ..matter import DeltaBeta, Matter
from ..progress import Progress
from ..representations import VoxelGrid
from ..scan import Scan
from .sightings import SightingOptions, occupancy

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
