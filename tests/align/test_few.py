"""What few frames tell of poses, beside matter that follows them; and what stays as planned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.misaligned_balls import MATERIAL, scan_of
from holosplat.align import PoseOptions, PosePrior, align_views
from holosplat.align.derivatives import beside, motions, projections
from holosplat.align.marginal_likelihood import SHARP, SOFT, Following, of_poses, weighed
from holosplat.beamline.misalignment import Misalignment
from holosplat.geometry import Grid, Views
from holosplat.matter import MaterialPrior
from holosplat.scan import Exposures

SHAPE, BLUR, LEFT = (9, 11), 0.7, 1e-5


@pytest.fixture(scope="module")
def scene() -> tuple[torch.Tensor, Grid, Exposures]:
    """A round ball of 2.5 pixels beside the middle of three views; lengths in pixels of 1 µm."""
    rotations = Rotation.random(3, rng=np.random.default_rng(1)).as_matrix()
    views = Views(rotations, np.zeros((3, 2)), SHAPE, 1e-6)
    grid = Grid.of_views(views.in_units_of(1e-6))
    x, y, z = (torch.from_numpy(axis).float() for axis in grid.axes())
    away = ((x - 1) ** 2 + (y[:, None] + 0.5) ** 2 + (z[:, None, None] - 1) ** 2).sqrt()
    return (3 - away).clamp(0, 1), grid, Exposures.of(views, 20.0, 0.02, 0.3)


@pytest.mark.parametrize("leeway", [SHARP, SOFT])
def test_information_is_that_of_the_whole_problem(scene, leeway):
    """`Cᵀ (1 + K)⁻¹ C` with K as a matrix; the search never says more, and hardly less."""
    volume, grid, exposures = scene
    places = [0, 1, 2, 3, 4]
    found = of_poses(
        volume, grid, exposures, MATERIAL, left=torch.full((3,), LEFT), leeway=leeway, blur=BLUR, places=places
    )
    follows = Following(volume, grid, exposures, MATERIAL, leeway, BLUR)
    noise = 4 * np.pi * BLUR**2 * LEFT
    slopes = follows.frames(projections(volume, grid, exposures.views.in_units_of(1e-6))[1][:, :5].transpose(0, 1))
    columns = torch.zeros(3, 5, 3, *SHAPE)
    for v in range(3):
        columns[v, :, v] = slopes[:, v]
    flat = columns.reshape(15, -1).double() / noise**0.5
    single = torch.eye(flat.shape[1]).reshape(-1, 3, *SHAPE)
    spread = torch.stack([follows.spread(image) for image in single]).reshape(len(single), -1).double() / noise
    torch.testing.assert_close(spread, spread.T, rtol=1e-3, atol=1e-4 * float(spread.abs().max()))
    exact = flat @ torch.linalg.solve(torch.eye(len(single)).double() + spread, flat.T)
    known = flat @ flat.T
    units = known.diagonal().rsqrt()
    lacking = torch.linalg.eigvalsh(units[:, None] * (exact - found) * units)
    assert lacking[0] > -1e-4
    assert lacking[-1] < 0.2
    assert (exact.diagonal() / known.diagonal()).max() < 0.9


def test_numbers_go_back_to_the_plan_as_far_as_they_are_not_told():
    """Of plans of known errors, and of plans without; the errors that are said are the scatter."""
    rng = np.random.default_rng(2)
    views = Views(Rotation.random(4, rng=rng).as_matrix(), np.zeros((4, 2)), (9, 11), 1.0)
    common, expected = motions(views), np.array([2.0, 2.0, 0.02, 0.02, 0.02])
    kept = beside(common / np.tile(expected, 4)[:, None])
    own = rng.normal(size=(14, 14)) @ np.diag(np.geomspace(0.02, 3.0, 14)) / 14**0.5  # errors, in units of the prior
    told = kept @ np.linalg.inv(own @ own.T) @ kept.T / np.outer(np.tile(expected, 4), np.tile(expected, 4))
    kinds = [[0, 1], [2, 3], [4]]
    away, said = [], []
    for seed in range(60):
        draws = np.random.default_rng(seed)
        true = (kept @ kept.T @ (0.5 * draws.normal(size=20))).reshape(4, 5) * expected
        found = true + (kept @ own @ draws.normal(size=14)).reshape(4, 5) * expected
        judged = weighed(found, told, expected, kinds, common)
        away.append(((judged.numbers - true) / expected, (found - true) / expected, true / expected))
        said.append(np.diag(judged.off).reshape(4, 5) / expected**2)
    ours, theirs, planned = np.sqrt(np.square(away).mean((0, 2, 3)))
    assert ours < 0.9 * min(theirs, planned)
    assert ours**2 == pytest.approx(np.mean(said), rel=0.5)
    noises = [(kept @ own @ rng.normal(size=14)).reshape(4, 5) * expected for _ in range(30)]
    kept_plans = [weighed(noise, told, expected, kinds, common).scales == (0.0, 0.0, 0.0) for noise in noises]
    assert np.mean(kept_plans) > 0.9  # odds of 20 to 1 are asked for
    noise = noises[kept_plans.index(True)]
    nothing = weighed(noise, told, expected, kinds, common)
    assert not nothing.numbers.any()
    likeliest = np.linalg.lstsq(told + _prior(kept, expected), told @ noise.reshape(-1), rcond=None)[0]
    assert np.diag(nothing.off) == pytest.approx(np.diag(nothing.covariance) + likeliest**2, rel=1e-6, abs=0)


def _prior(kept: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """The information of the prior about the directions `kept`."""
    return kept @ kept.T / np.outer(np.tile(expected, 4), np.tile(expected, 4))


def test_few_noisy_frames_leave_a_good_plan():
    """Noise of a tenth of the contrast; what the frames say against the plan may be noise, and this is said."""
    scan, _ = scan_of(Misalignment(), 4, 9)
    noise = 0.1 * scan.frames.std() * np.random.default_rng(0).normal(size=scan.frames.shape)
    noisy = replace(scan, frames=(scan.frames + noise).astype(np.float32))
    options = PoseOptions(PosePrior(shift=1.0, angle=0.5, roll=0.5), rounds=2, retrieval=15, first=10, steps=4, edges=0)
    found = align_views(noisy, MaterialPrior.known(MATERIAL), options)
    assert not found.changes.any()
    (decision,) = (one for one in found.decisions if one.name == "errors of the plan")
    assert decision.choice == "none"
