"""Windows about matter in large fields: found by frames, exact in what they predict, left where they save little."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from holosplat.beamline.simulate import simulate
from holosplat.fit.pose_refinement import PoseRefinement
from holosplat.geometry import Grid, Views, rotation_tilted
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import Auto, solve
from holosplat.methods.illumination import prepared
from holosplat.methods.method import Task
from holosplat.methods.window import MARGIN, MULTIPLE, Windows, shown, windows_of
from holosplat.model import measure
from holosplat.optics.background import LightOptions
from holosplat.optics.noise import NoiseModel
from holosplat.scan import Exposures, Scan
from holosplat.specimens.phantoms import Ball
from holosplat.specimens.scene import MeshScene

PIXEL, SHAPE, MATERIAL = 1e-6, (250, 281), DeltaBeta(7e-7, 2.6e-10)
ANGLES = [0.0, 50.0, 110.0]
POSES = {
    "one axis": Views.from_angles(ANGLES, SHAPE, PIXEL),
    "any poses": Views.from_rotations(rotation_tilted(ANGLES, [0.0, 25.0, -20.0]), SHAPE, PIXEL),
}


def ball(x: float = 60.0, y: float = -40.0, z: float = 30.0) -> MeshScene:
    """A ball of 20 pixels across, off the axis."""
    mesh = Ball(PIXEL * np.array([x, y, z]), 20 * PIXEL).mesh(3, "ball")
    return MeshScene.of_one_material([mesh], MATERIAL)


@cache
def frames(poses: str, photons: float | None = 1000.0) -> Scan:
    exposures = Exposures.of(POSES[poses], 20.0, 0.02)
    return simulate(ball(), exposures, photons_per_pixel=photons, is_test=np.zeros(3, dtype=bool), oversample=2)


def noise_of(scan: Scan, sigma: float = 1000.0**-0.5) -> NoiseModel:
    return NoiseModel.white_only(torch.full((len(scan),), sigma), scan.views.shape)


def found_in(scan: Scan, sigma: float = 1000.0**-0.5) -> Windows:
    found = windows_of(scan, noise_of(scan, sigma))
    assert found is not None
    return found


@pytest.mark.parametrize("poses", POSES)
def test_windows_hold_the_shadow_and_a_margin(poses):
    scan, (h, w) = frames(poses), SHAPE
    found = found_in(scan)
    rows, columns = found.shape
    assert rows % MULTIPLE == columns % MULTIPLE == 0
    assert rows * columns < 0.2 * h * w
    centres = scan.views.rotations @ (PIXEL * np.array([60.0, -40.0, 30.0])) / PIXEL
    for (x, y, _), top, left in zip(centres, found.tops, found.lefts):
        assert top + MARGIN <= y + 0.5 * h - 10 < y + 0.5 * h + 10 <= top + rows - MARGIN
        assert left + MARGIN <= x + 0.5 * w - 10 < x + 0.5 * w + 10 <= left + columns - MARGIN
    assert len(set(found.tops)) == (1 if poses == "one axis" else 3)


@pytest.mark.parametrize("poses", POSES)
def test_what_is_predicted_in_a_window_is_what_is_predicted_there_of_the_whole(poses):
    scan = frames(poses, None)
    found = found_in(scan, 0.0)
    part = found.of(scan)
    assert np.array_equal(part.frames, found.cut(scan.frames))
    whole, own = (measure(ball(), one.exposures, 2).numpy() for one in (scan, part))
    assert np.ptp(own) > 0.1
    np.testing.assert_allclose(own, found.cut(whole), atol=2e-3 * np.ptp(own))


def test_views_about_one_axis_keep_the_same_rows():
    scan = frames("one axis")
    marked = scan.frames.copy()
    marked[1, 30:40, 150:160] += 0.3
    found = found_in(replace(scan, frames=marked))
    assert len(set(found.tops)) == 1
    assert found.tops[0] + MARGIN <= 32
    assert found.tops[0] + found.shape[0] >= 0.5 * SHAPE[0] - 30 + MARGIN


def test_a_faint_wide_shadow_is_seen_by_the_mean_of_many_pixels():
    sigma, contrast = 0.03, 0.03 * torch.randn(256, 320, generator=torch.Generator().manual_seed(1)).double()
    assert not shown(contrast, sigma).any()
    contrast[64:160, 96:224] += 0.01  # a third of the noise
    seen = shown(contrast, sigma)
    assert seen[70:154, 100:220].float().mean() > 0.9
    assert not seen[200:].any()


def test_nothing_is_left_out_where_it_would_save_little_or_tells_something():
    scan = frames("one axis")
    small = scan.cropped(slice(20, 220), slice(100, 280))
    empty = replace(scan, frames=np.ones_like(scan.frames))
    noisy = replace(noise_of(scan), grain=torch.full_like(noise_of(scan).grain, 1e-12))
    crowded = replace(scan, frames=scan.frames + scan.frames[:, ::-1, ::-1] - 1)
    assert windows_of(scan, noise_of(scan)) is not None
    assert windows_of(small, noise_of(small)) is None
    assert windows_of(empty, noise_of(empty)) is None
    assert windows_of(scan, noisy) is None
    assert windows_of(crowded, noise_of(crowded)) is None


def test_a_task_looks_at_windows_only_in_even_light_and_known_poses():
    scan = frames("one axis")
    task = Task(scan, MaterialPrior.known(MATERIAL), light=LightOptions("even", noise="white"))
    assert task.in_windows() is task, "its light was not looked at"
    task = prepared(task)
    part = task.in_windows()
    assert part.scan.views.shape == found_in(scan).shape
    assert part.lit is not None
    assert part.lit.air.shape == part.scan.frames.shape
    assert part.noise.shape == part.scan.views.shape
    free = replace(task, freedom=PoseRefinement(1.0, 0.0, 0.0, 0.0, np.zeros((3, 7))))
    assert free.in_windows() is free


def test_a_run_in_windows_finds_the_matter_where_it_is():
    views = Views.evenly_spaced(6, SHAPE, PIXEL)
    scan = simulate(ball(), Exposures.of(views, 20.0, 0.02), is_test=np.zeros(6, dtype=bool), oversample=2)
    said = list[str]()
    told = {"prior": MaterialPrior.known(MATERIAL), "light": LightOptions("even", noise="white")}
    task = Task(scan, **told, on_progress=lambda stage, part: said.append(stage))
    found = solve(Auto().with_effort(0.3), task, "levels")
    assert any(stage.startswith("windows of") for stage in said)
    grid = Grid((32, 32, 32), (PIXEL,) * 3, (44.5 * PIXEL, -55.5 * PIXEL, 14.5 * PIXEL))
    ours, true = (matter.voxelise(grid).delta for matter in (found, ball()))
    assert np.linalg.norm(ours - true) < 0.1 * np.linalg.norm(true)
