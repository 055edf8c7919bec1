"""A fixed pattern: what frames have in common beside their prediction, as far as chance allows."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat.beamline.light import correlated_field
from holosplat.optics.patterns import fixed_pattern, mean_light

SHAPE, NOISE, PATTERN = (31, 48), 0.004, 0.003
AXIS = 23.5


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


@pytest.mark.parametrize("pattern", [PATTERN, 0.01])
def test_a_pattern_beside_the_prediction_is_found(pattern: float):
    measured, matter, _, true = frames(pattern=pattern)
    found = fixed_pattern(measured, matter, AXIS)
    least = 1 / (1 / pattern**2 + 12 / NOISE**2)  # variance that is left of Wiener's estimate of a Gaussian
    left = (found / true).log()
    assert float((left - left.mean()).square().mean()) == pytest.approx(least, rel=0.35)


@pytest.mark.parametrize("grain", [0.0, 0.01])
def test_noise_of_each_frame_is_no_pattern(grain: float):
    measured, matter, *_ = frames(pattern=0.0, grain=grain)
    assert float(fixed_pattern(measured, matter, AXIS).std()) < 0.15 * NOISE


def test_errors_that_go_with_the_shadow_of_matter_on_the_axis_are_no_pattern():
    """A cylinder there casts one shadow in all frames, and what its volume gets wrong is alike in all of them, too."""
    measured, _, _, true = frames()
    x = torch.arange(SHAPE[1]).double() - 23.5
    shadow = torch.exp(-0.2 * torch.exp(-0.5 * (x / 4) ** 2)).expand(len(measured), *SHAPE)
    own = true * (1 + NOISE * torch.from_numpy(np.random.default_rng(5).standard_normal(measured.shape)))
    wrong = 1 + 0.1 * (shadow[0] - 1)
    found = fixed_pattern(shadow * wrong * own, shadow, AXIS)
    beside, within = x.abs() > 12, x.abs() < 3
    left = (found / true).log()
    assert float(left[:, beside].std()) < 0.8 * PATTERN
    taken = float(found[:, within].log().mean() - found[:, beside].log().mean())
    assert abs(taken) < 0.5 * abs(float(wrong[:, within].log().mean()))


@pytest.mark.parametrize("axis", [AXIS, 30.0])
def test_what_is_even_about_the_axis_is_no_evidence_of_a_pattern(axis: float):
    """A volume's error about the axis, five times as strong as the noise of the frames' mean; the odd part shows none.
    With a pattern beside it, that is found where its pixels have no error."""
    x, y = torch.arange(SHAPE[1]).double() - axis, torch.arange(SHAPE[0]).double()[:, None]
    rings = torch.cos(1.3 * x.abs() + 0.4 * y) * torch.exp(-0.5 * (x / 4) ** 2)
    shadow = torch.exp(-0.2 * torch.exp(-0.5 * (x / 4) ** 2)).expand(12, *SHAPE)
    own = 1 + NOISE * torch.from_numpy(np.random.default_rng(5).standard_normal((12, *SHAPE)))
    wrong = (0.02 * rings).exp()
    assert float(fixed_pattern(shadow * wrong * own, shadow, axis).log().std()) < 0.2 * NOISE
    *_, true = frames(pattern=0.01)
    found = fixed_pattern(shadow * wrong * own * true, shadow, axis)
    clear = x.abs() > 12
    assert float((found / true).log()[:, clear].std()) < 0.4 * float(true.log()[:, clear].std())


@pytest.mark.parametrize("pattern", [0.0, 0.01])
def test_errors_about_the_axis_that_no_shadow_tells_are_left_in_the_frames(pattern: float):
    """Rings all over the frame, where no matter was predicted: none is taken, or little beside a true pattern."""
    x, y = torch.arange(SHAPE[1]).double() - AXIS, torch.arange(SHAPE[0]).double()[:, None]
    rings = torch.cos(1.3 * x.abs() + 0.4 * y)
    *_, true = frames(pattern=pattern)
    own = 1 + NOISE * torch.from_numpy(np.random.default_rng(5).standard_normal((12, *SHAPE)))
    found = fixed_pattern((0.02 * rings).exp() * own * true, torch.ones_like(own), AXIS).log()
    share = float((found * rings).sum() / rings.square().sum())
    assert abs(share) < 0.4 * 0.02
    if not pattern:
        assert float(found.std()) < 0.5 * NOISE


def test_without_mirror_images_nothing_tells_a_pattern_from_matter():
    measured, matter, *_ = frames(pattern=0.01)
    assert bool((fixed_pattern(measured, matter, -30.0) == 1).all())


def test_one_frame_has_no_pattern():
    measured, matter, *_ = frames(count=1)
    assert bool((fixed_pattern(measured, matter, AXIS) == 1).all())


def test_smooth_mean_light_is_that_of_its_modes():
    rows = torch.cos(torch.pi * (torch.arange(SHAPE[0]).double() + 0.5) / SHAPE[0])
    light = (0.1 * rows).exp()[:, None].expand(SHAPE)
    predicted = torch.full((3, *SHAPE), 0.5, dtype=torch.float64)
    torch.testing.assert_close(mean_light(predicted * light, predicted, 2), light.contiguous(), atol=1e-6, rtol=0)
    torch.testing.assert_close(mean_light(2 * predicted, predicted, 2), torch.ones(SHAPE).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(mean_light(2 * predicted, predicted, 0), torch.full(SHAPE, 2.0).double())
