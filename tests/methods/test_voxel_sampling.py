"""Waves behind voxels: too many samples show the edges of voxels as fringes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holosplat.beamline.simulate import simulate
from holosplat.geometry import Grid, Views
from holosplat.materials import parse_material
from holosplat.matter import Matter
from holosplat.methods.cross_validation import predicted_frames
from holosplat.optics.sampling import fringe_sampling
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures
from holosplat.specimens.phantoms import packed_balls
from holosplat.specimens.scene import MeshScene


@pytest.mark.parametrize("refine", [1, 2])
def test_true_voxels_of_sharp_matter_predict_frames_better_with_two_samples_a_pixel(refine):
    """Fringes of half a pixel ask for four samples of sharp matter; those of voxels show the voxels' edges."""
    pixel, water = 5e-6, parse_material("water").delta_beta(20.0)
    views = Views.evenly_spaced(3, (31, 42), pixel)
    exposures = Exposures.of(views, 20.0, 0.1)
    balls = packed_balls(pixel * np.array([9.0, 7.0, 12.0]), (31 * pixel,) * 3, seed=4)
    scene = MeshScene.of_one_material([ball.mesh() for ball in balls], water)
    frames = torch.from_numpy(simulate(scene, exposures).frames)
    grid = Grid.of_views(views, refine)
    occupied = torch.from_numpy(scene.voxelise(grid).delta / water.delta).float()
    voxels = VoxelGrid(occupied[None], grid, Matter.one(*water))

    def missed(samples: int) -> float:
        return float((predicted_frames(exposures, voxels, samples) - frames).square().mean().sqrt())

    assert fringe_sampling(exposures) == 4
    assert missed(0) == missed(2)
    assert missed(2) < 0.9 * missed(4)
