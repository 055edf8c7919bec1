"""Light that frames have in common: found where air shows it, as strong as air shows it, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat.beamline.light import correlated_field
from holosplat.optics.noise_model import NoiseModel
from holosplat.optics.still_light import Common, mean_light, shows_still_light, still_light

SHAPE, NOISE, PATTERN = (31, 48), 0.004, 0.003


def frames(count: int = 12, pattern: float = PATTERN, grain: float = 0.0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Frames [V, H, W] with noise of their own and a pattern in common; without these; where they show air; the
    pattern."""
    draw = np.random.default_rng(3)
    x = np.arange(SHAPE[1]) - 23.5
    shadows = np.stack([np.exp(-0.06 * np.exp(-0.5 * ((x - 6 * np.sin(k)) / 5) ** 2)) for k in range(count)])
    matter = np.broadcast_to(shadows[:, None], (count, *SHAPE))
    shared = 1 + pattern * draw.standard_normal(SHAPE)
    own = 1 + NOISE * draw.standard_normal((count, *SHAPE))
    if grain:
        own += np.stack([grain * correlated_field(SHAPE, 1.5, draw) for _ in range(count)])
    given = (torch.from_numpy(np.ascontiguousarray(part)) for part in (matter * shared * own, matter, matter > 0.999))
    return (*given, torch.from_numpy(shared))  # type: ignore[return-value]


def noise(count: int = 12) -> NoiseModel:
    """The noise that frames have of their own."""
    return NoiseModel.white_only(torch.full((count,), NOISE), SHAPE)


def test_what_images_have_in_common_is_measured_without_bias():
    measured, _, air, _ = frames()
    found = Common.of(measured.log(), air)
    assert found.power == pytest.approx(PATTERN**2, rel=0.1)
    assert found.own == pytest.approx(NOISE**2, rel=0.05)
    alone = Common.of(measured.log(), air & (torch.arange(12) == 4)[:, None, None])
    assert alone == Common(0.0, 0.0, 0.0)


@pytest.mark.parametrize("pattern", [PATTERN, 0.01])
def test_light_in_common_is_found_in_air_and_behind_matter(pattern: float):
    measured, matter, air, true = frames(pattern=pattern)
    assert shows_still_light(measured, air, noise())
    found = still_light(measured, matter, air, noise())
    assert found is not None
    least = 1 / (1 / pattern**2 + 12 / NOISE**2)  # variance that is left of Wiener's estimate of a Gaussian
    for part in (air.all(dim=0), ~air.any(dim=0)):
        assert part.any()
        left = (found / true).log()[part].square().mean()
        assert float(left) == pytest.approx(least, rel=0.35)


@pytest.mark.parametrize("grain", [0.0, 0.01])
def test_noise_of_each_frame_is_not_light_in_common(grain: float):
    measured, matter, air, _ = frames(pattern=0.0, grain=grain)
    known = NoiseModel.of_frames(measured, air)
    assert not shows_still_light(measured, air, known)
    assert still_light(measured, matter, air, known) is None
    assert not shows_still_light(measured[:1], air[:1], known[:1])


def test_matter_that_a_volume_lacks_in_all_frames_does_not_pass_for_light():
    """Without such light in the air there is none; with it, what is missing counts for no more than air shows."""
    measured, matter, air, _ = frames(pattern=0.0)
    assert still_light(measured * 0.97 ** (~air).double(), matter, air, noise()) is None
    measured, matter, air, true = frames()
    lacking = torch.where(air.any(dim=0), 1.0, 0.97)  # ten times as strong as the light
    found = still_light(measured * lacking, matter, air, noise())
    assert found is not None
    wrong = (found / true).log()[~air.any(dim=0)]
    assert float(wrong.mean()) > 0.3 * np.log(0.97)


@pytest.mark.parametrize("explained", [1.0, 0.6])
def test_faint_matter_that_passes_for_air_is_not_light(explained: float):
    """A body around the axis that absorbs less than a frame's noise: many frames have it surely in common."""
    y, x = np.mgrid[-15:16, -23.5:24]
    thickness = 0.004 * np.sqrt(np.clip(1 - (x / 20) ** 2 - (y / 13) ** 2, 0, 1))
    draw, shape = np.random.default_rng(5), (60, *SHAPE)
    body = torch.from_numpy(np.broadcast_to(np.exp(-thickness), shape).copy())
    measured = body * torch.from_numpy(1 + NOISE * draw.standard_normal(shape))
    air, quiet = torch.ones(shape, dtype=torch.bool), noise(60)
    assert shows_still_light(measured, air, quiet)
    assert still_light(measured, body**explained, air, quiet) is None
    assert still_light(measured, torch.ones(shape).double(), air, quiet) is not None  # with no matter it were light


def test_smooth_mean_light_is_that_of_its_modes():
    rows = torch.cos(torch.pi * (torch.arange(SHAPE[0]).double() + 0.5) / SHAPE[0])
    light = (0.1 * rows).exp()[:, None].expand(SHAPE)
    predicted = torch.full((3, *SHAPE), 0.5, dtype=torch.float64)
    torch.testing.assert_close(mean_light(predicted * light, predicted, 2), light.contiguous(), atol=1e-6, rtol=0)
    torch.testing.assert_close(mean_light(2 * predicted, predicted, 2), torch.ones(SHAPE).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(mean_light(2 * predicted, predicted, 0), torch.full(SHAPE, 2.0).double())


def test_a_few_pixels_of_air_have_something_in_common_by_chance():
    """Three frames and four pixels: one draw in eight has more in common than noise leaves in the mean."""
    draw, quiet = torch.Generator().manual_seed(1), NoiseModel.white_only(torch.full((3,), NOISE), (2, 2))
    air = torch.ones(3, 2, 2, dtype=torch.bool)
    for _ in range(60):
        assert not shows_still_light(1 + NOISE * torch.randn(3, 2, 2, generator=draw).double(), air, quiet)
