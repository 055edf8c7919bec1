"""Poses of held-out frames from the finished volume, which does not use them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..geometry import Grid
from ..matter import DeltaBeta
from ..optics.sampling import fringe_sampling
from ..progress import Progress
from ..representations import Stored
from ..scan import Scan
from .derivatives import NUMBERS, changes, in_pixels, numbers_of, rms_of, unexplained
from .fixed_matter import Beside
from .initial_geometry import centres_of_mass, retrieved
from .poses import DISTANCE, FLUX, SHIFT, PoseOptions, PoseSearch
from .views import AlignedViews, errors_of

STAGE = "poses of held-out frames"


def place_frames(
    found: Stored,
    scan: Scan,
    options: PoseOptions,
    on_progress: Progress = lambda stage, fraction: None,
    oversample: int = 0,
) -> AlignedViews:
    """Estimate the poses of all frames of `scan` with the fixed matter `found`.

    The matter counts as one material. Steps are those of `align_views`, from large pixels to small ones, with no
    common motion to be chosen: the matter has its place. Each frame is free by itself. The last steps are taken beside
    the matter as it is, and not beside voxels of it (`Beside`), where they explain a frame better.

    oversample: wave samples a pixel (0: as the first fringe needs).
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
        with torch.no_grad():
            delta = found.voxelise(Grid.of_views(binned.views)).delta
        occupied, grid = torch.from_numpy(delta / material.delta).float(), Grid.of_views(in_pixels(binned.views))
        frames, oversample = binned.measured, fringe_sampling(binned.exposures)
        for _ in range(level.rounds):
            search.move(occupied, grid, search.exposures(binned.exposures), frames, oversample)
            done += 1
            on_progress(STAGE, done / rounds)
    search.numbers[:, DISTANCE] = 0
    beside = Beside(found, scan.exposures, oversample or fringe_sampling(scan.exposures))
    measured, nothing = scan.measured, torch.zeros_like(search.numbers)
    moved = beside.placed(measured, search.numbers, options.uncertain.deviations(sharp=True))
    tried = [
        rms_of(unexplained(measured, beside.frames(numbers))) for numbers in (nothing, search.numbers, moved.numbers)
    ]
    before, after = tried[0], np.minimum(tried[1], tried[2])
    search.numbers = torch.where(torch.from_numpy(tried[2] <= tried[1])[:, None], moved.numbers, search.numbers)
    worse = after > before
    search.numbers[torch.from_numpy(worse)] = 0
    exposures = search.exposures(scan.exposures)
    words = [
        f"held-out frame {k} of {len(scan)} is as planned: no pose explains it better" for k in np.flatnonzero(worse)
    ]
    return AlignedViews(
        exposures,
        changes(exposures, scan.exposures),
        errors_of(moved.covariances) * ~worse[:, None],
        np.exp(search.numbers[:, FLUX].numpy()) - 1,
        before,
        np.minimum(before, after),
        tuple(words),
    )


def _by_mass(found: Stored, scan: Scan, material: DeltaBeta, options: PoseOptions) -> Tensor:
    """Shifts [V, 2] [pixels of `scan`] that bring the centres of mass of frames to those of the matter."""
    thickness = retrieved(scan, material, options.retrieval)
    with torch.no_grad():
        _, lines = found.project(scan.views)
    expected, seen = (centres_of_mass(images.double().numpy()) for images in (lines, thickness))
    return torch.from_numpy(expected - seen)


def fitted_frames(found: Stored, planned: Scan, fitted: Scan, options: PoseOptions, oversample: int) -> AlignedViews:
    """Describe the poses of `fitted` frames as changes of those `planned`, in the same light.

    Errors are those beside the matter that was `found`, as it is.
    """
    numbers = torch.zeros(len(planned), len(NUMBERS), dtype=torch.float64)
    numbers[:, :FLUX] = numbers_of(fitted.exposures, planned.exposures)
    measured, nothing = fitted.measured, torch.zeros_like(numbers)
    beside = Beside(found, planned.exposures, oversample or fringe_sampling(planned.exposures))
    expected = options.uncertain.deviations(sharp=True)
    errors = errors_of(beside.placed(measured, numbers, expected, steps=0).covariances)
    before, after = (rms_of(unexplained(measured, beside.frames(each))) for each in (nothing, numbers))
    moved = changes(fitted.exposures, planned.exposures)
    return AlignedViews(fitted.exposures, moved, errors, np.zeros(len(planned)), before, after, ())
