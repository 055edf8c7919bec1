"""What the thesis says, in our units: its configurations, rates, schedule, growth, start and physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.materials import WATER
from holosplat.methods.presets import preset
from holosplat.volume import Volume
from holosplat_bench.thesis.configurations import (
    EVERY,
    PACES,
    PHYSICS,
    THESIS_TABLE,
    Configuration,
    Measured,
    Pace,
    configurations,
    mean_inside,
)
from holosplat_bench.thesis.study import DenseCloud, random_start

PIXEL = 1e-6
SHAPE = (15, 22)
SMALL = replace(THESIS_TABLE[1], count=60)


def test_the_eight_configurations_are_those_of_the_thesis():
    assert [(c.count, c.views) for c in THESIS_TABLE] == [
        *((8_000, 1), (8_000, 4), (8_000, 8)),
        *((32_000, 4), (98_000, 4), (244_000, 4)),
        *((8_000, 4), (8_000, 4)),
    ]
    assert [c.position_rate for c in THESIS_TABLE] == [1.6e-4] * 6 + [3.2e-4, 1.6e-4]
    assert [c.shape_rate for c in THESIS_TABLE] == [1e-3] * 7 + [2e-3]


def test_every_configuration_is_another_one():
    assert len({c.name for c in EVERY}) == len({replace(c, name="same") for c in EVERY}) == len(EVERY)


def test_lengths_are_translated_to_detector_pixels():
    """In the thesis' cube [-1, 1]³ half the detector's width is 1; a gradient goes the other way."""
    recipe = PACES["full"].recipe(configurations(["8k-v4-position"])[0], width_px=96, start_density=0.005)
    assert recipe.fit.rates.centres == pytest.approx(3.2e-4 * 48)
    assert recipe.fit.density.grow_gradient == pytest.approx(2e-4 / 48)
    assert recipe.fit.density.faint == pytest.approx(0.2 * 0.005)
    rates = PACES["full"].recipe(configurations(["8k-v4-shape"])[0], width_px=128, start_density=1.0).fit.rates
    assert (rates.log_scales, rates.quaternions) == (2e-3, 2e-3)
    assert rates.centres == pytest.approx(preset("thesis").fit.rates.centres, rel=0.03)


@pytest.mark.parametrize(
    ("name", "steps", "warmup", "every"),
    [("full", 30_000, 1000, 500), ("third", 10_000, 333, 166), ("short", 3000, 100, 50)],
)
def test_the_schedule_is_that_of_the_thesis_or_shorter(name, steps, warmup, every):
    fit = PACES[name].recipe(THESIS_TABLE[0], 96, 1.0).fit
    schedule, density = fit.schedule, fit.density
    assert (schedule.steps, schedule.warmup_steps, schedule.views_per_step) == (steps, warmup, 1)
    assert schedule.validation_views == 0, "no training view is taken away to judge"
    assert density.every == every
    events = [step for step in range(steps) if density.due(step, steps)]
    growing = [step + 1 for step in events if density.grows(step, steps)]
    assert 0 <= growing[0] - steps / 10 < every, "3000 of 30000"
    assert 0 <= steps / 2 - growing[-1] < every, "15000 of 30000"
    assert steps - events[-1] - 1 < every, "it prunes to the end"
    assert PACES[name].look_every % every != 0, "most looks do not fall on an event of density control"


def test_the_loss_is_that_of_the_thesis():
    frames, volume = (
        PACES["full"].recipe(c, 96, 1.0).fit.objective for c in configurations(["8k-v4", "8k-v4-volume-tv"])
    )
    assert (frames.l1, frames.ssim, frames.frc) == (0.75, 0.20, 0.05)
    assert frames.frc_ramp * 30_000 == 3000, "over the first few thousand steps"
    assert frames.anisotropy > 0
    assert (frames.tv_image > 0, frames.uses_volume) == (True, False)
    assert (volume.tv_image > 0, volume.uses_volume) == (False, True)


def test_until_the_warm_up_is_over_only_density_delta_and_beta_move():
    recipe = PACES["full"].recipe(configurations(["8k-v4-amplitude"])[0], 96, 1.0)
    moving = {step: {name for name, rate in recipe.rates(1.0, step).items() if rate > 0} for step in (999, 1000)}
    assert moving[999] == {"object.raw_amplitudes", "object.raw_densities"}
    assert len(moving[1000]) == 5
    assert recipe.rates(0.5, 0)["object.raw_densities"] == pytest.approx(0.025)


def test_the_worst_views_of_a_batch_do_not_learn_unless_asked():
    rule = {c.name: PACES["full"].recipe(c, 96, 1.0).fit.schedule.detach_worst for c in EVERY}
    assert [name for name, holds in rule.items() if not holds] == ["8k-v4-all-learn"]


def test_unknown_configurations_paces_and_physics_are_refused(balls):
    assert configurations() == THESIS_TABLE
    assert [c.name for c in configurations(["8k-v8", "8k-v1", "8k-v8"])] == ["8k-v8", "8k-v1"]
    with pytest.raises(InputError, match=r"one of 8k-v1, .*8k-v4-one-unit, but it is '9k'"):
        configurations(["9k"])
    with pytest.raises(InputError, match="shortened must be at least 1, but it is 0"):
        Pace("none", 0)
    with pytest.raises(InputError, match=r"physics must be one of declared, contact, .*, but it is 'optics'"):
        Measured.of(balls, "optics")
    with pytest.raises(InputError, match=r"threshold must .* -1"):
        Configuration("wrong", threshold=-1.0)


def test_each_physics_differs_in_one_thing(balls):
    plain = Measured.of(balls).scan
    changed = {name: Measured.of(balls, name).scan for name in PHYSICS if name != "declared"}
    assert set(changed["contact"].exposures.distance) == {0.0}
    assert set(changed["far"].exposures.distance) == {0.5}
    assert set(changed["blurred"].exposures.psf_sigma_px) == {0.5}
    train = ~plain.is_test
    noise = (changed["noisy"].frames - plain.frames)[train]
    assert noise.std() == pytest.approx(2000**-0.5, rel=0.1)
    assert np.array_equal(changed["noisy"].frames[~train], plain.frames[~train]), "held-out frames have no noise"
    assert plain.frames.std() > 3 * changed["contact"].frames.std(), "absorption alone shows little"


def test_the_random_start_is_faint_uniform_and_without_prior():
    views = Views.evenly_spaced(4, (31, 64), PIXEL)
    cloud = random_start(replace(SMALL, count=4000), views, 20.0, seed=1)
    half = np.array([32, 15.5, 32])
    centres = cloud.centres.numpy() / half
    assert np.abs(centres).max() <= 1
    np.testing.assert_allclose(centres.mean(0), 0, atol=0.04)
    np.testing.assert_allclose(centres.var(0), 1 / 3, rtol=0.06)  # of a uniform distribution on [-1, 1]
    water = WATER.delta_beta(20.0)
    volume = cloud.voxelise(Grid.centred((24, 12, 24), PIXEL))
    assert float(volume.delta.mean()) == pytest.approx(0.01 * water.delta, rel=0.1, abs=0)
    assert float(volume.beta.mean()) == pytest.approx(0.01 * water.beta, rel=0.1, abs=0)
    np.testing.assert_allclose(cloud.ratios(), water.ratio, rtol=1e-5)
    same, other = (random_start(replace(SMALL, count=4000), views, 20.0, seed) for seed in (1, 2))
    assert same.centres.equal(cloud.centres)
    assert not other.centres.equal(cloud.centres)


def test_one_unit_starts_delta_and_beta_alike():
    views = Views.evenly_spaced(4, SHAPE, PIXEL)
    cloud = random_start(replace(SMALL, one_unit=True), views, 20.0, 0)
    volume = cloud.voxelise(Grid.of_views(views))
    np.testing.assert_allclose(volume.delta, volume.beta, rtol=1e-6)
    np.testing.assert_allclose(cloud.ratios(), 1.0, rtol=1e-6)


def test_means_inside_are_weighted_by_true_matter():
    grid = Grid.centred((1, 1, 3), PIXEL)
    truth = Volume(np.array([[[0.0, 1.0, 3.0]]]), np.zeros((1, 1, 3)), grid)
    found = Volume(np.array([[[9.0, 2.0, 4.0]]]), np.array([[[9.0, 0.0, 8.0]]]), grid)
    assert mean_inside(found, truth) == pytest.approx((0.25 * 2 + 0.75 * 4, 0.75 * 8))


# --- Gaussians with a density -------------------------------------------------------------------------------


def a_cloud(count: int = 7) -> DenseCloud:
    """Some Gaussians that differ in everything."""
    start = random_start(replace(SMALL, count=count), Views.evenly_spaced(4, SHAPE, PIXEL), 20.0, 3)
    generator = torch.Generator().manual_seed(1)
    return start.replaced(p + 0.3 * torch.randn(p.shape, generator=generator) for p in start.parameters().values())


def test_density_multiplies_delta_and_beta_alike():
    cloud = a_cloud()
    np.testing.assert_allclose(cloud.amplitudes, cloud.densities * cloud.values, rtol=1e-6)
    np.testing.assert_allclose(cloud.strength, cloud.densities[:, 0])
    ratio = cloud.amplitudes[:, 0] * cloud.matter.delta / (cloud.amplitudes[:, 1] * cloud.matter.beta)
    np.testing.assert_allclose(cloud.ratios(), ratio, rtol=1e-5)


def test_a_weaker_gaussian_has_less_density_and_the_same_matter():
    cloud, index = a_cloud(), torch.tensor([4, 1])
    values = cloud.values_times(0.25, index)
    assert torch.equal(values["raw_amplitudes"], cloud.raw_amplitudes[index])
    np.testing.assert_allclose(
        torch.nn.functional.softplus(values["raw_densities"]), cloud.densities[index] / 4, rtol=1e-4
    )


def test_files_hold_plain_gaussians_that_add_up_to_the_same(tmp_path):
    cloud, grid = a_cloud(), Grid.centred((15, 15, 22), PIXEL)
    plain = DenseCloud.from_state(cloud.state())
    assert type(plain) is not DenseCloud
    np.testing.assert_allclose(plain.voxelise(grid).delta, cloud.voxelise(grid).delta, rtol=1e-4, atol=1e-14)
    assert isinstance(cloud.on("reference"), DenseCloud)


def test_densities_must_fit_to_the_gaussians():
    *shared, densities = a_cloud().parameters().values()
    with pytest.raises(InputError, match=r"raw_densities must have the shape \(7, 1\), but they have \(6, 1\)"):
        DenseCloud([*shared, densities[:6]], PIXEL, a_cloud().matter)
