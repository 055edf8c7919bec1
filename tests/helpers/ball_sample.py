"""The two balls as a scene for learning, from their frames of 25 × 28 pixels."""

from __future__ import annotations

import numpy as np
import torch

from helpers.two_balls import ONE, PIXEL, scan, truth
from holosplat.geometry import Grid
from holosplat.learning.start import retrieved_thickness
from holosplat_bench.training.sample import Sample


def ball_sample() -> Sample:
    """Three views for training and three that are held out."""
    seen, material = scan(), ONE.channels[0]
    frames, views, exposures = torch.from_numpy(seen.frames), seen.views, seen.exposures
    thickness = retrieved_thickness(frames, exposures, material) / PIXEL
    facts = [PIXEL, exposures.energy_kev[0], exposures.distance[0], 0.0, np.inf, material.delta, material.beta, 2]
    return Sample(
        contrast=(seen.frames - 1).astype(np.float16),
        thickness=thickness.numpy().astype(np.float16),
        noise=np.full(6, 1e-3, np.float32),
        rotations=views.rotations,
        shifts=views.shifts / PIXEL,
        is_test=np.arange(6) >= 3,
        occupancy=np.rint(255 * truth(Grid.of_views(views)).numpy()).astype(np.uint8),
        facts=np.array(facts, dtype=np.float64),
    )
