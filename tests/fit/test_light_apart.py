"""Light in doubt beside a misfit: the inverse of the whole covariance, and what it does to slopes and to light."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.blobs import MATERIAL, SHAPE, blob_scan
from holosplat.fit.whitened import LightProjection, WhitenedFrames
from holosplat.optics.background import Background, Light
from holosplat.optics.noise import NoiseModel
from holosplat.optics.patterns import smooth_modes

ORDER, POWER, MODES = 2, 0.01, 9


def covariances(count: int, size: float = 0.05) -> Tensor:
    """Of the coefficients of light [V, K, K], correlated and not of full rank."""
    draw = torch.Generator().manual_seed(4)
    roots = size * torch.randn(count, MODES, MODES - 2, generator=draw, dtype=torch.float64)
    return roots @ roots.mT


def test_images_over_their_errors_are_those_of_the_inverse_covariance():
    """Against the dense inverse of `P + B C Bᵀ` in float64; odd, rectangular frames."""
    shape, draw = (7, 10), torch.Generator().manual_seed(2)
    amplitudes = 0.4 + 0.6 * torch.rand(2, *shape, generator=draw)
    image = torch.randn(2, *shape, generator=draw)
    known = covariances(2)
    found = LightProjection(amplitudes, known, lambda one: one / POWER)(image / POWER)
    modes = smooth_modes(shape, ORDER).double().flatten(1)
    for v in range(2):
        changes = 0.5 * (amplitudes[v].double().flatten() * modes).T
        whole = POWER * torch.eye(70, dtype=torch.float64) + changes @ known[v] @ changes.T
        wanted = torch.linalg.solve(whole, image[v].double().flatten())
        np.testing.assert_allclose(found[v].flatten().numpy(), wanted.numpy(), rtol=2e-4, atol=2e-4 / POWER**0.5)


def doubtful(size: float = 0.05) -> tuple[WhitenedFrames, WhitenedFrames, Tensor]:
    """The misfit of frames in known light, in doubtful light, and the lines of matter that is a little off."""
    measured = blob_scan(count=4)
    noise = NoiseModel.white_only(torch.full((4,), 0.02, dtype=torch.float64), SHAPE)
    known = covariances(4, size)
    flat = Background(torch.zeros(4, MODES).double(), known, torch.ones(MODES).double(), torch.ones(4).double(), SHAPE)
    light = Light(torch.zeros(4, *SHAPE, dtype=torch.bool), noise, flat)
    sure = WhitenedFrames(measured, MATERIAL, noise)
    lines = 1e-2 * torch.rand(4, *SHAPE, generator=torch.Generator().manual_seed(6))
    return sure, WhitenedFrames(measured, MATERIAL, noise, doubt=light), lines


def test_the_gradient_beside_doubtful_light_is_that_of_the_value():
    _, misfit, at = doubtful()
    toward, step = misfit(at).gradient / misfit(at).gradient.abs().max(), 0.02
    slope = (misfit(at + step * toward).value - misfit(at - step * toward).value) / (2 * step)
    np.testing.assert_allclose(float((misfit(at).gradient * toward).sum()), slope, rtol=5e-3)


def test_light_within_its_doubt_costs_next_to_nothing():
    """A change of the light of one standard deviation, where the misfit knows of it and where it does not."""
    sure, misfit, lines = doubtful()
    strength, vectors = torch.linalg.eigh(covariances(4))
    modes = smooth_modes(SHAPE, ORDER)[:MODES].double().flatten(1)
    change = (vectors[:, :, -1] * strength[:, -1:].sqrt()) @ modes
    amplitudes = sure.measured.double() * 0.5 * change.reshape(4, *SHAPE)
    costs = [0.5 * float((amplitudes * one.whitened(amplitudes.float())).sum()) for one in (misfit, sure)]
    assert costs[0] == pytest.approx(2.0, rel=0.02)  # half of one for each of four frames
    assert costs[1] > 50 * costs[0]
    assert misfit(lines).value < sure(lines).value


def test_light_that_is_sure_changes_nothing():
    sure, misfit, lines = doubtful(size=0.0)
    assert misfit(lines).value == pytest.approx(sure(lines).value, rel=1e-5)
