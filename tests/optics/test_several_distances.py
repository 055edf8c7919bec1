"""Frames of one pose at several distances: one projection of all of them, in every method of retrieval."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.retrieval import BETA, DELTA, DOUBLE, PITCH, _squared_distance, at, exposures, pixels, taken
from holosplat.geometry import Views
from holosplat.optics.retrieval import RETRIEVALS
from holosplat.optics.retrieval.contact import _moved
from holosplat.optics.retrieval.model import WaveModel
from holosplat.optics.retrieval.nonlinear import objective, penalty_weights
from holosplat.optics.sampling import SharedPoses, alike
from holosplat.scan import Exposures

FAR, NEAR = at(24.0), at(7.0)
SHAPE = (39, 47)


def of_poses(poses: list[float], distances: list[float], shape: tuple[int, int] = SHAPE) -> Exposures:
    """Frames of poses by their numbers, at distances [m]."""
    return replace(
        exposures(shape, np.array(distances), count=len(poses)), views=Views.from_angles(poses, shape, PITCH)
    )


def bodies_at(x: Tensor, y: Tensor) -> Tensor:
    """Thickness [H, W] in metres of a ball and a flat ellipsoid beside it, at x [1, W] and y [H, 1] [m]."""
    total = torch.zeros(len(y), x.shape[1], dtype=DOUBLE)
    for centre, flatness in (((-9.3, 4.2), 1.0), ((8.4, -5.7), 0.4)):
        total = total + 2 * flatness * ((7 * PITCH) ** 2 - _squared_distance(x, y, centre)).clamp_min(0).sqrt()
    return total


def bodies(views: Views) -> Tensor:
    """The same on the raster of `views`."""
    return bodies_at(*pixels(views))


def noisy(frames: Tensor, photons: float) -> Tensor:
    return torch.poisson(frames * photons, generator=torch.Generator().manual_seed(0)) / photons


def relative_error(found: Tensor, truth: Tensor) -> float:
    return float((found.double() - truth).norm() / truth.norm())


def test_frames_of_one_pose_and_time_are_found():
    where = of_poses([0, 5, 0, 5, 9, 9], [NEAR, NEAR, FAR, FAR, FAR, FAR])
    poses = SharedPoses(where)
    assert poses.any
    assert [poses.of[a] == poses.of[b] for a, b in ((0, 2), (1, 3), (0, 1), (4, 5))] == [True, True, False, False]
    values = torch.tensor([1.0, 2.0, 10.0, 20.0, 5.0, 6.0])
    assert poses.sum(values).tolist() == [11, 22, 11, 22, 5, 6]
    assert poses.mean(values).tolist() == [5.5, 11, 5.5, 11, 5, 6]
    assert not SharedPoses(replace(where, time=np.arange(6.0))).any
    assert not SharedPoses(replace(where, distance=FAR)).any
    edge = 0.5 * max(SHAPE)
    for turn_px, shared in ((0.4, True), (0.6, False)):
        turned = of_poses([0, np.rad2deg(turn_px / edge)], [NEAR, FAR])
        assert SharedPoses(turned).any is shared
    dense = of_poses([0, 0.3, 0, 0.3], [NEAR, NEAR, FAR, FAR])  # each has one frame of each distance
    assert SharedPoses(dense).of.tolist() == [0, 1, 0, 1]
    together = [sorted(index.tolist()) for index in alike(where)]
    assert sorted(together) == [[0, 1, 2, 3], [4, 5]]


def test_the_objectives_gradient_is_that_of_all_frames_of_a_pose():
    """Against central differences along a direction that all frames of the pose share."""
    where = of_poses([0, 0, 4, 0], [NEAR, FAR, FAR, at(15.0)], (21, 27))
    waves = WaveModel(noisy(taken(bodies, where)[1], 500.0), where, BETA / DELTA, None)
    weights, poses = penalty_weights(waves, 1.0), SharedPoses(where)
    draw = torch.Generator().manual_seed(3)
    phase = waves.phase + 0.2 * poses.mean(torch.rand(waves.phase.shape, dtype=DOUBLE, generator=draw))
    value, slope = objective(waves, phase, weights)
    assert float(value[0]) == pytest.approx(float(value[1]))
    assert torch.allclose(slope[0], slope[3])
    way = poses.mean(torch.randn(phase.shape, dtype=DOUBLE, generator=draw))
    ahead, behind = (objective(waves, phase + s * 1e-5 * way, weights)[0] for s in (1, -1))
    assert torch.allclose((ahead - behind) / 2e-5, (slope * way).sum(dim=(1, 2)), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", RETRIEVALS)
def test_two_frames_tell_more_than_each(name):
    """All frames of a pose have the same thickness, in any order of the frames."""
    where = of_poses([0, 0], [at(15.0), FAR])
    truth, clean = taken(bodies, where)
    frames, retrieve = noisy(clean, 1000.0).float(), RETRIEVALS[name]
    each = [relative_error(retrieve(frames[[v]], where[[v]], DELTA, BETA), truth[[v]]) for v in range(2)]
    both = retrieve(frames, where, DELTA, BETA)
    assert torch.allclose(both[0], both[1], atol=1e-4 * float(truth.max()))
    assert relative_error(both[:1], truth[:1]) < min(each)
    turned = retrieve(frames.flip(0), where[[1, 0]], DELTA, BETA)
    assert relative_error(turned[:1], both[:1]) < 0.01


def test_two_distances_fill_the_zeros_of_each_other():
    """The linear inverse of as many photons in all, far away, where its zeros are many."""
    where = of_poses([0, 0], [at(100.0), at(170.0)], (63, 75))
    truth, clean = taken(bodies, where)

    def error_of(frames: list[int], photons: float) -> float:
        found = RETRIEVALS["ctf"](noisy(clean[frames], photons).float(), where[frames], DELTA, BETA)
        return relative_error(found[:1], truth[:1])

    assert error_of([0, 1], 20000.0) < 0.65 * min(error_of([0], 40000.0), error_of([1], 40000.0))


@pytest.mark.parametrize("name", ["ctf", "tikhonov"])
def test_frames_that_lie_beside_each_other_are_moved(name):
    """The second one by parts of pixels along both axes: as if it had not been."""
    still = of_poses([0, 0], [NEAR, FAR])
    shift = np.array([[0.0, 0.0], [1.3 * PITCH, -2.6 * PITCH]])

    def moved(views: Views) -> Tensor:
        x, y = pixels(views)
        return bodies_at(x + shift[1, 0], y + shift[1, 1])

    truth, first = taken(bodies, still[[0]])
    beside, second = taken(moved, still[[1]])
    frames = noisy(torch.cat((first, second)), 2000.0).float()
    where = replace(still, views=replace(still.views, shifts=shift))
    found = RETRIEVALS[name](frames, where, DELTA, BETA)
    unmoved = RETRIEVALS[name](noisy(taken(bodies, still)[1], 2000.0).float(), still, DELTA, BETA)
    best = relative_error(unmoved[:1], truth)
    assert relative_error(found[:1], truth) < 1.3 * best
    assert relative_error(found[1:], beside) < 1.3 * best
    ignored = RETRIEVALS[name](frames, still, DELTA, BETA)
    assert relative_error(ignored[:1], truth) > 1.5 * best


def test_a_frame_in_contact_helps_one_at_a_distance():
    """What absorbs strongly: the contact frame tells the lowest frequencies, the other one the edges."""
    where, beta = of_poses([0, 0], [0.0, FAR]), 0.03 * DELTA
    truth, clean = taken(bodies, where, DELTA, beta)
    frames = noisy(clean, 1000.0).float()
    both = RETRIEVALS["tikhonov"](frames, where, DELTA, beta)
    each = [relative_error(RETRIEVALS["tikhonov"](frames[[v]], where[[v]], DELTA, beta), truth[[v]]) for v in range(2)]
    assert torch.allclose(both[0], both[1], atol=1e-4 * float(truth.max()))
    assert relative_error(both[:1], truth[:1]) < min(each)


@pytest.mark.parametrize("name", list(RETRIEVALS))
def test_frames_of_smaller_pixels_help_those_of_larger_ones(name):
    """Each where it lies, and at its distance; those of the smallest pixels are as they are alone."""
    sizes, shifts = PITCH * np.array([1.3, 1.0, 1.3]), PITCH * np.array([[0.0, 0.0], [1.3, -2.6], [-2.0, 1.0]])
    views = Views.of_pixels(np.repeat(np.eye(3)[None], 3, axis=0), shifts, SHAPE, sizes)
    where = replace(of_poses([0, 0, 9], [FAR, at(15.0), FAR]), views=views)
    each = [replace(where[[n]], views=replace(views[[n]], pitch=float(sizes[n]), scales=None)) for n in range(3)]

    def there(views: Views) -> Tensor:
        x, y = pixels(views)
        return bodies_at(x + views.shifts[0, 0], y + views.shifts[0, 1])

    truth, frames = (torch.cat(parts) for parts in zip(*(taken(there, one) for one in each)))
    frames, retrieve = noisy(frames, 1000.0).float(), RETRIEVALS[name]
    alone = torch.cat([retrieve(frames[[n]], one, DELTA, BETA) for n, one in enumerate(each)])
    found = retrieve(frames, where, DELTA, BETA)
    assert relative_error(found[0], truth[0]) < 0.9 * relative_error(alone[0], truth[0])
    for n in (1, 2):  # the last one has a pose of its own
        torch.testing.assert_close(found[n], alone[n], rtol=1e-4, atol=1e-4 * float(truth.max()))


@pytest.mark.parametrize("ratio", [1.0, 1.3, 2.0, 2.5])
def test_a_frame_on_a_raster_of_larger_pixels_is_what_those_average(ratio):
    """A Gaussian in closed form, whose variance grows by that of the larger pixels, beside rows that lack values."""
    sigma, beside, (h, w) = 4.0, np.array([[1.4, -2.7]]), (41, 57)

    def seen(step: float, variance: float, by: np.ndarray) -> Tensor:
        y, x = ((torch.arange(n, dtype=DOUBLE) - (n - 1) / 2) * step + b for n, b in zip((h, w), by))
        return sigma**2 / variance * torch.exp(-(y[:, None] ** 2 + x**2) / (2 * variance))[None]

    found = _moved(seen(1.0, sigma**2, np.zeros(2)), beside, ratios=np.array([ratio]))
    assert torch.allclose(found, seen(ratio, sigma**2 + (ratio**2 - 1) / 12, beside[0]), atol=2e-3)
    gaps = torch.zeros(1, h, w, dtype=DOUBLE)
    gaps[:, : h // 2] = 1
    unseen = _moved(gaps, beside, 1.0, np.array([ratio])) > 0
    y = (torch.arange(h, dtype=DOUBLE) - (h - 1) / 2) * ratio + beside[0, 0] + (h - 1) / 2
    inside = (y >= h // 2 + ratio + 1) & (y <= h - 1)
    assert unseen[0, ~((y >= h // 2) & (y <= h - 1))].all()
    assert not unseen[0, inside, w // 2].any()
    assert inside.any()
