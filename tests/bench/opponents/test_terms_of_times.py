"""Total variation in space and time, sums that are looked at one after another, and which times are drawn."""

from __future__ import annotations

import pytest
import torch

from holosplat.checks import InputError
from holosplat_bench.opponents.moving.times import DrawnTimes, one_after_another, space_time_variation


def random(*shape: int) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def test_variation_of_what_is_constant_is_zero():
    assert float(space_time_variation(torch.full((3, 4, 5, 6), 0.7), 1.0, 0.01)) == pytest.approx(0, abs=1e-6)
    still = random(1, 4, 5, 6).repeat(3, 1, 1, 1)
    assert float(space_time_variation(still, 5.0, 0.01)) == pytest.approx(float(space_time_variation(still, 0.0, 0.01)))


def test_variation_of_a_step():
    """A step of one along an axis costs the area of its face; in time, as many voxels as appear, by the pace."""
    volumes = torch.zeros(3, 4, 5, 6, dtype=torch.float64)
    volumes[:, :, :, 3:] = 1
    assert float(space_time_variation(volumes, 0.5, 1e-6)) == pytest.approx(3 * 4 * 5, rel=1e-4)
    volumes = torch.zeros(3, 4, 5, 6, dtype=torch.float64)
    volumes[2] = 1
    assert float(space_time_variation(volumes, 0.5, 1e-6)) == pytest.approx(0.5 * 4 * 5 * 6, rel=1e-4)


@pytest.mark.parametrize("shape", [(3, 4, 5, 3), (1, 3, 1, 4), (2, 1, 1, 5)])
def test_the_slope_of_variation_is_that_of_differences(shape):
    volumes = random(*shape).requires_grad_()
    assert torch.autograd.gradcheck(lambda u: space_time_variation(u, 0.7, 0.1), [volumes], fast_mode=True)
    wanted = plain(volumes, 0.7, 0.1)
    found = space_time_variation(volumes, 0.7, 0.1)
    torch.testing.assert_close(found, wanted)
    theirs = torch.autograd.grad(wanted, volumes)[0]
    torch.testing.assert_close(torch.autograd.grad(3 * found, volumes)[0], 3 * theirs)


def plain(u: torch.Tensor, pace: float, smoothing: float) -> torch.Tensor:
    """By automatic differentiation of the formula."""
    square = torch.zeros_like(u) + smoothing**2
    for axis, factor in enumerate((pace, 1.0, 1.0, 1.0)):
        last = u.narrow(axis, u.shape[axis] - 1, 1)
        square = square + (factor * torch.diff(u, dim=axis, append=last)) ** 2
    return (square.sqrt() - smoothing).sum()


def test_volumes_one_after_another_have_the_slope_of_their_sum():
    volumes = random(3, 2, 4, 5).requires_grad_()
    found = one_after_another(volumes, lambda k, u: (k + 1) * u.square().sum())
    wanted = sum((k + 1) * volumes[k].square().sum() for k in range(3))
    assert isinstance(wanted, torch.Tensor)
    torch.testing.assert_close(found, wanted)
    ours, theirs = (torch.autograd.grad(2 * value, volumes)[0] for value in (found, wanted))
    torch.testing.assert_close(ours, theirs)


def test_times_open_from_the_middle():
    drawn = DrawnTimes(count=2, opening=0.5)
    assert drawn.among(16, 0.0) == (6, 9)
    assert drawn.among(16, 0.25) == (4, 12)
    assert drawn.among(16, 0.5) == drawn.among(16, 1.0) == (0, 16)
    assert DrawnTimes().among(16, 0.0) == (0, 16)
    assert drawn.among(2, 0.0) == (0, 2)


def test_what_does_not_fit_is_refused():
    with pytest.raises(InputError, match="count must be at least 1"):
        DrawnTimes(count=0)
    with pytest.raises(InputError, match=r"shape \[T, Z, Y, X\]"):
        space_time_variation(random(2, 3, 4), 1.0, 0.1)
    with pytest.raises(InputError, match="smoothing must be positive"):
        space_time_variation(random(2, 3, 4, 5), 1.0, 0.0)
