"""Waves behind voxels: too many samples show the edges of voxels as fringes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holosplat.beamline.simulate import simulate
from holosplat.geometry import Grid, Views
from holosplat.materials import parse_material
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods.cross_validation import predicted_frames, predictions
from holosplat.methods.method import Task
from holosplat.methods.smooth_fit import SmoothFit
from holosplat.methods.volume import SmoothStage, SmoothVolume
from holosplat.optics.sampling import fringe_sampling
from holosplat.representations import BandLimitedVoxels, VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.specimens.phantoms import packed_balls
from holosplat.specimens.scene import MeshScene


def true_voxels(refine: int) -> tuple[Exposures, torch.Tensor, VoxelGrid]:
    """Three balls of water: exposures whose fringes of half a pixel ask for four samples of sharp matter, frames, and
    the balls on voxels."""
    pixel, water = 5e-6, parse_material("water").delta_beta(20.0)
    views = Views.evenly_spaced(3, (31, 42), pixel)
    exposures = Exposures.of(views, 20.0, 0.1)
    balls = packed_balls(pixel * np.array([9.0, 7.0, 12.0]), (31 * pixel,) * 3, seed=4)
    scene = MeshScene.of_one_material([ball.mesh() for ball in balls], water)
    frames = torch.from_numpy(simulate(scene, exposures).frames)
    grid = Grid.of_views(views, refine)
    occupied = torch.from_numpy(scene.voxelise(grid).delta / water.delta).float()
    return exposures, frames, VoxelGrid(occupied[None], grid, Matter.one(*water))


@pytest.mark.parametrize("refine", [1, 2])
def test_true_voxels_of_sharp_matter_predict_frames_better_with_two_samples_a_pixel(refine):
    """Fringes of half a pixel ask for four samples of sharp matter; those of voxels show the voxels' edges."""
    exposures, frames, voxels = true_voxels(refine)

    def missed(samples: int) -> float:
        return float((predicted_frames(exposures, voxels, samples) - frames).square().mean().sqrt())

    assert fringe_sampling(exposures) == 4
    assert missed(0) == missed(2)
    assert missed(2) < 0.9 * missed(4)


@pytest.mark.parametrize(("refine", "samples", "share"), [(1, 2, 0.95), (1, 4, 0.85), (2, 4, 0.85)])
def test_voxels_without_steps_predict_frames_better(refine, samples, share):
    """And as well with finer samples of the waves."""
    exposures, frames, voxels = true_voxels(refine)
    smooth = BandLimitedVoxels.of(voxels)

    def missed(found: VoxelGrid, number: int) -> float:
        return float((predicted_frames(exposures, found, number) - frames).square().mean().sqrt())

    assert missed(smooth, samples) < share * missed(voxels, samples)
    assert missed(smooth, samples) == pytest.approx(missed(smooth, 2), rel=0.06)
    scan = Scan(frames.numpy(), exposures, np.zeros(3, dtype=bool))
    assert torch.equal(predictions(voxels, scan), predicted_frames(exposures, smooth))


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
