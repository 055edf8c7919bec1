"""The likeliest smooth volume: the prior against its plain form, and the descent."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from helpers.blobs import MATERIAL, SHAPE, blob_scan, blobs
from holosplat.checks import InputError
from holosplat.fit.smooth_volume import ContinuousPrior, Descent, Slope, VolumeProblem, descend
from holosplat.fit.whitened import WhitenedFrames
from holosplat.geometry import Grid
from holosplat.optics.noise import NoiseModel

PRIOR = ContinuousPrior()


def problem(prior: ContinuousPrior = PRIOR, photons: float | None = None) -> VolumeProblem:
    """Of six views of 25 × 31 pixels."""
    measured = blob_scan(photons=photons)
    noise = NoiseModel.of_frames(torch.from_numpy(measured.frames))
    return VolumeProblem(WhitenedFrames(measured, MATERIAL, noise), prior, 1.0)


def matter() -> torch.Tensor:
    """The occupancy."""
    return blobs(Grid.of_views(blob_scan().views))


def plain(u: torch.Tensor, prior: ContinuousPrior) -> torch.Tensor:
    """The prior in float64, written again."""
    square = torch.zeros_like(u)
    square[:-1] += (u[1:] - u[:-1]) ** 2
    square[:, :-1] += (u[:, 1:] - u[:, :-1]) ** 2
    square[:, :, :-1] += (u[:, :, 1:] - u[:, :, :-1]) ** 2
    size = torch.sqrt(square + prior.rounding**2) - prior.rounding
    slopes = prior.slopes * torch.log(1 + size / prior.slope).sum()
    away = u
    if prior.levels:
        nearest = torch.stack([(u - level) ** 2 for level in (0.0, *prior.levels)]).min(dim=0).values
        away = torch.sqrt(nearest + prior.rounding**2) - prior.rounding
    return slopes + prior.values * torch.log(1 + away / prior.value).sum()


@pytest.mark.parametrize("levels", [(), (1.0,), (0.4, 1.0)])
def test_the_prior_is_its_plain_form(levels):
    weighty = ContinuousPrior(slopes=3.0, values=0.7, levels=levels)
    u = matter() + 0.1 * torch.rand(matter().shape, generator=torch.Generator().manual_seed(1))
    at = u.double().requires_grad_()
    expected = plain(at, weighty)
    (slope,) = torch.autograd.grad(expected, at)
    value, pull = problem(weighty).penalty(u)
    gradient = pull(torch.zeros_like(u))
    assert value == pytest.approx(float(expected.detach()), rel=1e-5)
    np.testing.assert_allclose(gradient.numpy(), slope.numpy(), rtol=1e-4, atol=1e-4 * float(slope.abs().max()))


def test_the_backprojection_is_the_adjoint():
    p, g = problem(), torch.Generator().manual_seed(2)
    u, lines = torch.rand(p.grid.shape, generator=g), torch.rand((6, *SHAPE), generator=g)
    assert float((p.lines(u) * lines).sum()) == pytest.approx(float((u * p.backprojection(lines)).sum()), rel=1e-4)


def test_the_descent_never_rises_and_keeps_matter_positive():
    p = problem(photons=2000)
    start = 0.5 * matter()
    found, values = descend(p, start, 15)
    assert len(values) > 5
    assert all(after <= before for before, after in pairwise(values))
    assert float(found.min()) >= 0
    error = [float((u - matter()).norm() / matter().norm()) for u in (start, found)]
    assert error[1] < 0.7 * error[0]


class Trap:
    """Σ (u - 1)² (u + 0.05): a second, higher minimum at zero, where a first step from far above ends."""

    lower = 0.0

    def __call__(self, u: torch.Tensor) -> tuple[float, Slope]:
        return float(((u - 1) ** 2 * (u + 0.05)).sum()), lambda: 2 * (u - 1) * (u + 0.05) + (u - 1) ** 2

    def preconditioner(self, u: torch.Tensor):
        return lambda gradient: gradient


@pytest.mark.parametrize(("kept", "end"), [(False, 0.0), (True, 1.0)])
def test_an_empty_volume_is_a_trap_that_shorter_steps_avoid(kept, end):
    descent = Descent(Trap(), torch.full((3, 4, 5), 3.0), kept)
    while not descent.ended and descent.done < 60:
        descent.step()
    assert descent.u.numpy() == pytest.approx(end, abs=1e-3)
    assert Descent.again(Trap(), descent.state_dict()).kept is kept


def test_a_known_level_draws_matter_that_is_near_to_it():
    """Where frames tell next to nothing, what is known decides; without it the matter vanishes."""
    blind = NoiseModel.white_only(torch.full((6,), 1e3, dtype=torch.float64), SHAPE)
    full = (matter() > 0.5).float()
    for levels, end in (((1.0,), 1.0), ((), 0.0)):
        prior = ContinuousPrior(slopes=0.01, values=1.0, levels=levels)
        p = VolumeProblem(WhitenedFrames(blob_scan(), MATERIAL, blind), prior, 1.0)
        found, _ = descend(p, 0.9 * full, 20)
        assert float(found[full > 0].median()) == pytest.approx(end, abs=0.03)


def test_bad_options_are_refused():
    with pytest.raises(InputError, match="slope must be a positive number"):
        ContinuousPrior(slope=0.0)
    with pytest.raises(InputError, match="values must"):
        ContinuousPrior(values=-1.0)
    with pytest.raises(InputError, match="level of the matter must be positive"):
        VolumeProblem(problem().frames, ContinuousPrior(), 0.0)
