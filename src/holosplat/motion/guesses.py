"""Whether a network's guess shows the bodies of single times better than total variation does."""

from __future__ import annotations

import torch
from torch import Tensor

from ..learning.network import Guess
from ..learning.start import Guessed, LearnedStart, contradicted, guessed, unexplained
from ..matter import DeltaBeta, Matter
from ..progress import Progress
from ..representations import VoxelGrid
from ..scan import Scan
from .sightings import SightingOptions, occupancy

CLEARLY = 0.75
"""What bodies by the network may leave unexplained of the retrieved thickness, over what those by tomography leave.
Of red cells that is 0.31 to 0.71 in two and three beams, and about one in four (docs/data/sightings.csv)."""


def network_for(
    scan: Scan, material: DeltaBeta, options: SightingOptions, how: LearnedStart, on_progress: Progress
) -> tuple[Guess | None, str]:
    """The network whose guesses show the bodies of `material` in the frames of one time, `scan`, better; or None; and
    why, in words.

    Both volumes are cut at the bodies' level, for bodies are full, and their shadows compared with retrieved thickness.
    A guess that the frames contradict (`learning.start.contradicted`) is never taken.
    """
    trained = how.network
    found = guessed(scan, material, trained.network, on_progress)
    against = contradicted(found, how, trained.card)
    if against:
        return None, f"bodies that tomography shows at single times: the network knows others, for {against}"
    values, grid = occupancy(scan, material, options, on_progress, None)
    seen = VoxelGrid(values[None], grid, Matter.one(*material)).resampled(found.grid).values[0]
    left, by_tomography = (left_by_bodies(volume, found, options.level) for volume in (found.values, seen))
    taken = left < CLEARLY * by_tomography
    return (trained.network if taken else None), (
        f"bodies that {'a network guesses' if taken else 'tomography shows'} at single times: those of the network "
        f"leave {100 * left:.0f} % of the thickness unexplained, those of tomography {100 * by_tomography:.0f} %"
    )


def left_by_bodies(values: Tensor, found: Guessed, level: float) -> float:
    """Relative residual of the thickness that the network saw, with full bodies.

    values: [Z, Y, X] on the voxels of `found`, of which what is above `level` is full
    """
    return unexplained((values > level).to(torch.float32), found.images, found.taps)
