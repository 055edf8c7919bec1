"""Where held-out frames are, by the finished volume, which they took no part in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..geometry import Grid
from ..matter import DeltaBeta
from ..optics.retrieval import Tikhonov, tikhonov
from ..optics.sampling import fringe_sampling
from ..progress import Progress
from ..representations import Stored
from ..scan import Scan
from .coarse import centres_of_mass
from .derivatives import in_pixels, predicted
from .poses import DISTANCE, FLUX, SHIFT, PoseOptions, PoseSearch
from .views import AlignedViews, changes

STAGE = "poses of held-out frames"


def place_frames(
    found: Stored, scan: Scan, options: PoseOptions, on_progress: Progress = lambda stage, fraction: None
) -> AlignedViews:
    """Where all frames of `scan` are beside the matter that was `found`, which stays as it is.

    The matter counts as one material. Steps are those of `align_views`, from large pixels to small ones, with no
    common motion to be chosen: the matter has its place. Each frame is free by itself.
    """
    scan = scan.with_split(np.zeros(len(scan), dtype=bool))
    material = DeltaBeta(found.matter.delta, found.matter.beta)
    by_mass = options.uncertain.shift > options.by_mass
    search = PoseSearch(scan, material, replace(options, by_mass=max(options.by_mass, options.uncertain.shift)), None)
    levels = options.levels(scan.views.shape, options.few_views)
    if by_mass:
        search.numbers[:, SHIFT] = _by_mass(found, scan.binned(levels[0].pixels), material, options)
        search.numbers[:, SHIFT] *= levels[0].pixels
    done, rounds = 0, sum(level.rounds for level in levels)
    for level in levels:
        binned = scan.binned(level.pixels)
        occupied, grid = _occupancy(found, binned, material)
        frames, oversample = torch.from_numpy(binned.frames), fringe_sampling(binned.exposures)
        for _ in range(level.rounds):
            search.move(occupied, grid, search.exposures(binned.exposures), frames, oversample)
            done += 1
            on_progress(STAGE, done / rounds)
    told = options.uncertain.distance > 0
    search.numbers[:, DISTANCE] *= told
    before, after = (_left(search, occupied, grid, binned, moved) for moved in (False, True))
    worse = after > before
    search.numbers[torch.from_numpy(worse)] = 0
    exposures = search.exposures(scan.exposures)
    errors = search.covariances.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt().numpy()[:, :FLUX]
    words = [
        f"held-out frame {k} of {len(scan)} is as planned: no pose explains it better" for k in np.flatnonzero(worse)
    ]
    return AlignedViews(
        exposures,
        changes(exposures, scan.exposures),
        errors * np.array([1, 1, *[np.rad2deg(1)] * 3, float(told), 1]) * ~worse[:, None],
        np.exp(search.numbers[:, FLUX].numpy()) - 1,
        before,
        np.minimum(before, after),
        tuple(words),
    )


def _occupancy(found: Stored, scan: Scan, material: DeltaBeta) -> tuple[Tensor, Grid]:
    """δ over that of `material` on the field of view of `scan`, and its grid with lengths in pixels."""
    with torch.no_grad():
        delta = found.voxelise(Grid.of_views(scan.views)).delta
    return torch.from_numpy(delta / material.delta).float(), Grid.of_views(in_pixels(scan.views))


def _by_mass(found: Stored, scan: Scan, material: DeltaBeta, options: PoseOptions) -> Tensor:
    """Shifts [V, 2] [pixels of `scan`] that bring the centres of mass of frames to those of the matter."""
    how = Tikhonov(iterations=options.retrieval)
    thickness = tikhonov(torch.from_numpy(scan.frames), scan.exposures, *material, options=how)
    with torch.no_grad():
        _, lines = found.project(scan.views)
    expected, seen = (centres_of_mass(images.double().numpy()) for images in (lines, thickness))
    return torch.from_numpy(expected - seen)


def _left(search: PoseSearch, occupied: Tensor, grid: Grid, scan: Scan, moved: bool) -> np.ndarray:
    """[V] rms of what is unexplained of each frame, as a share of its contrast, as planned or as found."""
    exposures = search.exposures(scan.exposures) if moved else scan.exposures
    frames = torch.from_numpy(scan.frames)
    images = predicted(occupied, grid, exposures, search.material, fringe_sampling(scan.exposures)).frames
    left = (frames - images).square().mean((1, 2)).sqrt() / frames.std(dim=(1, 2)).clamp_min(1e-12)
    return left.double().numpy()
