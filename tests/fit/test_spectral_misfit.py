"""The misfit in pixels of thickness, and the minimiser under bounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.two_balls import BETA, DELTA, ONE, PIXEL, chords, scan
from holosplat.checks import InputError
from holosplat.fit.projected_gradient import ProjectedGradient
from holosplat.fit.terms import Objective
from holosplat.fit.terms.frames import SpectralMisfit, linear_response
from holosplat.matter import Matter
from holosplat.model import Instrument
from holosplat.optics.noise import noise_level
from holosplat.optics.sampling import fringe_sampling
from holosplat.volume import LineIntegrals

# --- the misfit ---------------------------------------------------------------------------------------------


def test_the_misfit_of_the_truth_is_small_and_views_stand_alone():
    measured = scan()
    instrument = Instrument(measured.exposures, 4)
    misfit = SpectralMisfit(measured, instrument, ONE, 0.3)
    lines = LineIntegrals(chords(instrument.views)[:, None].float(), ((DELTA, BETA),))
    nothing = LineIntegrals(torch.zeros_like(lines.channels), lines.materials)
    true, empty = instrument.frames(lines), instrument.frames(nothing)
    assert float(misfit(true).max()) < 1e-5 * float(misfit(empty).min())
    index = torch.tensor([4, 1])
    assert torch.allclose(misfit(empty[index], index), misfit(empty)[index])


def test_the_misfit_is_in_pixels_of_thickness():
    """A faint object whose shape is a wave of response H, below the first maximum: ½ Σ (H T)² / (H² + floor²)."""
    measured = scan(count=1)
    views = measured.views
    frames = np.ones_like(measured.frames)
    instrument = Instrument(measured.exposures, fringe_sampling(measured.exposures))
    misfit = SpectralMisfit(replace(measured, frames=frames), instrument, ONE, 0.3)
    response = linear_response(measured.exposures, BETA / DELTA)[0, 0, 5]
    depth = 1e-3
    columns = torch.arange(instrument.views.shape[1]) - instrument.margin[1] * instrument.oversample + 0.5
    wave = torch.cos(2 * torch.pi * 5 / 28 / instrument.oversample * columns)
    lines = (depth * PIXEL * wave).expand(1, 1, *instrument.views.shape)
    expected = 0.25 * views.shape[0] * views.shape[1] * (depth * response) ** 2 / (response**2 + 0.3**2)
    found = misfit(instrument.frames(LineIntegrals(lines, ((DELTA, BETA),))))
    assert float(found) == pytest.approx(float(expected), rel=0.05)


@pytest.mark.parametrize("sigma", [0.003, 0.02])
def test_noise_is_measured_between_shapes(sigma):
    generator = torch.Generator().manual_seed(0)
    shapes = torch.zeros(4, 61, 80)
    shapes[:, 20:40, 20:50] = 1.0
    noisy = shapes + sigma * torch.randn(shapes.shape, generator=generator)
    assert noise_level(noisy) == pytest.approx(sigma, rel=0.2)
    assert noise_level(shapes) == 0


# --- the minimiser ------------------------------------------------------------------------------------------


def minimised(
    value: Callable[[Tensor], Tensor], start: Tensor, upper: float, steps: int, lower: float = 0.0
) -> tuple[Tensor, list[Tensor]]:
    """The best point after some steps, and every point that was tried."""
    leaves, seen = {"x": start.clone().requires_grad_()}, []
    optimiser = ProjectedGradient(leaves, upper, lower=lower)
    for _ in range(steps):
        seen.append(leaves["x"].detach().clone())
        loss = value(leaves["x"])
        loss.backward()
        optimiser.prepare({})
        optimiser.apply(loss.detach())
    return optimiser.best()["x"], seen


def test_the_minimiser_finds_the_bounded_minimum():
    """A quadratic with a condition number of 1e3: bounded values sit on their bounds, free ones at the minimum."""
    scale = torch.logspace(0, 3, 30, dtype=torch.float64)
    target = torch.linspace(-0.5, 1.5, 30, dtype=torch.float64)
    start = torch.full_like(target, 0.5)
    for lower, steps in ((0.0, 80), (-0.25, 80), (-math.inf, 160)):
        found, seen = minimised(lambda x: 0.5 * (scale * (x - target) ** 2).sum(), start, 1.0, steps, lower)
        assert torch.allclose(found, target.clamp(lower, 1), atol=1e-6)
        assert all(float(x.min()) >= lower and float(x.max()) <= 1 for x in seen)


def test_the_minimiser_returns_the_best_point_and_refuses_nonsense():
    values = iter([3.0, 2.0, 4.0, float("nan"), 2.5])
    found, seen = minimised(lambda x: x.sum() - x.sum().detach() + next(values), torch.ones(2), float("inf"), 5)
    assert torch.equal(found, seen[1])
    with pytest.raises(InputError, match="no finite value"):
        minimised(lambda x: float("nan") * x.sum(), torch.ones(2), 1.0, 3)


def test_one_parameter_at_a_time_is_minimised():
    leaves = {"a": torch.ones(2, requires_grad=True), "b": torch.ones(2, requires_grad=True)}
    with pytest.raises(InputError, match="moves one parameter, but a, b are free"):
        ProjectedGradient(leaves, 1.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: _misfit_of(Matter.one(0.0, 1e-9)), "needs a material with a δ, but it is 0"),
        (lambda: Objective(spectral=1.0, floor=0.0), "floor must be positive"),
    ],
)
def test_bad_input_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def _misfit_of(matter: Matter) -> SpectralMisfit:
    measured = scan(count=1)
    return SpectralMisfit(measured, Instrument(measured.exposures), matter, 0.3)
