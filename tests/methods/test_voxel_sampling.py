"""Waves behind voxels: how finely they are sampled, and what voxels cast on such samples."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holosplat.beamline.simulate import simulate
from holosplat.geometry import Grid, Views
from holosplat.materials import parse_material
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods.cross_validation import predicted_frames
from holosplat.methods.method import Task
from holosplat.methods.smooth_fit import SmoothFit
from holosplat.methods.volume import SmoothStage, SmoothVolume
from holosplat.optics.sampling import fringe_sampling
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.specimens.phantoms import packed_balls
from holosplat.specimens.scene import MeshScene


@pytest.mark.parametrize(("refine", "samples"), [(1, 2), (1, 4), (2, 4)])
def test_true_voxels_of_sharp_matter_predict_frames_better_than_their_steps(refine, samples):
    """As the same matter on voxels as small as the samples, each of which has the value of the large one around it."""
    pixel, water = 5e-6, parse_material("water").delta_beta(20.0)
    views = Views.evenly_spaced(3, (31, 42), pixel)
    exposures = Exposures.of(views, 20.0, 0.1)
    balls = packed_balls(pixel * np.array([9.0, 7.0, 12.0]), (31 * pixel,) * 3, seed=4)
    scene = MeshScene.of_one_material([ball.mesh() for ball in balls], water)
    frames = torch.from_numpy(simulate(scene, exposures).frames)
    grid, factor = Grid.of_views(views, refine), samples // refine
    occupied = torch.from_numpy(scene.voxelise(grid).delta / water.delta).float()[None]
    smooth = VoxelGrid(occupied, grid, Matter.one(*water))
    for axis in (1, 2, 3):
        occupied = occupied.repeat_interleave(factor, axis)
    steps = VoxelGrid(occupied, grid.divided((factor,) * 3), Matter.one(*water))

    def missed(voxels: VoxelGrid, number: int) -> float:
        return float((predicted_frames(exposures, voxels, number) - frames).square().mean().sqrt())

    assert fringe_sampling(exposures) == 4
    assert missed(smooth, 0) == missed(smooth, 2)
    assert missed(smooth, samples) < 0.7 * missed(steps, samples)


def test_waves_behind_larger_voxels_have_samples_as_fine_as_behind_those_of_a_pixel():
    """Two a pixel of 5 µm are four a pixel of 10 µm, where fringes of sharp matter ask for seven."""
    exposures = Exposures.of(Views.evenly_spaced(3, (31, 42), 5e-6), 20.0, 0.1)
    frames = np.random.default_rng(0).normal(1, 0.01, (3, 31, 42)).astype(np.float32)
    scan = Scan(frames, exposures, np.zeros(3, dtype=bool))
    grid = Grid.of_views(exposures.views)
    start = VoxelGrid(torch.zeros(1, *grid.shape), grid, Matter.one(1e-7, 1e-10))
    fit = SmoothStage(SmoothVolume()).fit(Task(scan, MaterialPrior.of_ratio(1000.0)), start)
    assert isinstance(fit, SmoothFit)
    assert fringe_sampling(scan.binned(2).exposures) == 7
    assert [fit.plan.frames(factor).instrument.oversample for factor in (1, 2)] == [2, 4]
