"""Properties of the splat and the voxeliser for whatever cloud: mass, sums, order, whole steps and turns."""

from __future__ import annotations

import math

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from helpers.strategies import clouds, numbers, rotations, vectors
from holosplat.projectors.splat import splat, voxelise

DETECTOR, VOLUME = (55, 60), (52, 55, 60)
STILL = np.zeros((1, 2))
WIDE = {"cutoff": 6.0}
"""Far enough out that a pixel more or less of a Gaussian's box does not matter."""


def image(cloud: list[Tensor], turns: np.ndarray, shifts: np.ndarray = STILL, **options: float) -> Tensor:
    return splat(*cloud, turns, np.repeat(shifts, len(turns), axis=0), DETECTOR, **(WIDE | options))


def volume(cloud: list[Tensor], **options: float) -> Tensor:
    return voxelise(*cloud, VOLUME, **(WIDE | options))


def close(a: Tensor, b: Tensor, tolerance: float = 2e-6) -> bool:
    """Equal up to a share of the largest values that went in."""
    largest = max(float(a.abs().max()), float(b.abs().max()), 1e-3)
    return float((a - b).abs().max()) <= tolerance * largest


def masses(cloud: list[Tensor]) -> Tensor:
    """What each channel [C] adds up to over all space, and over the magnitudes of its Gaussians."""
    _, scales, _, amplitudes = (a.double() for a in cloud)
    return (2 * math.pi) ** 1.5 * scales.prod(1, keepdim=True) * amplitudes


@given(clouds(), rotations(2))
def test_mass_is_conserved_in_every_view_and_on_voxels(cloud, turns):
    """Within the share of a Gaussian thinner than a pixel's edge that the docstring allows, 0.3 %."""
    wanted, most = masses(cloud).sum(0), masses(cloud).abs().sum(0)
    for found in (*image(cloud, turns), volume(cloud)):
        assert bool(((found.double().flatten(1).sum(1) - wanted).abs() <= 3e-3 * most + 1e-6).all())


@given(clouds(), clouds(), rotations(1))
def test_a_cloud_of_two_is_the_sum_of_the_two(first, second, turns):
    both = [torch.cat(pair) for pair in zip(first, second)]
    sizes = float(first[3].abs().sum() + second[3].abs().sum()) + 1e-3
    for found, parts in (
        (image(both, turns), [image(first, turns), image(second, turns)]),
        (volume(both), [volume(first), volume(second)]),
    ):
        assert float((found - parts[0] - parts[1]).abs().max()) < 1e-5 * sizes


@given(clouds(), rotations(1), st.randoms(use_true_random=False))
def test_the_order_of_the_gaussians_does_not_matter(cloud, turns, random):
    order = list(range(len(cloud[0])))
    random.shuffle(order)
    shuffled = [a[order].contiguous() for a in cloud]
    sizes = float(cloud[3].abs().sum()) + 1e-3
    assert float((image(cloud, turns) - image(shuffled, turns)).abs().max()) < 1e-5 * sizes
    assert float((volume(cloud) - volume(shuffled)).abs().max()) < 1e-5 * sizes


@given(clouds(), numbers(-5.0, 5.0))
def test_amplitudes_scale_what_is_drawn(cloud, factor):
    scaled = [*cloud[:3], cloud[3] * factor]
    turns = np.eye(3)[None]
    assert close(image(scaled, turns), factor * image(cloud, turns), 1e-5)
    assert close(volume(scaled), factor * volume(cloud), 1e-5)


@given(clouds(reach=4.0), rotations(1), st.tuples(st.integers(-4, 4), st.integers(-4, 4)))
def test_a_shift_of_whole_pixels_shifts_the_image(cloud, turns, step):
    still, moved = image(cloud, turns), image(cloud, turns, np.array([step], dtype=float))
    x, y = step
    rolled = torch.roll(still, (-y, -x), (-2, -1))[..., 4:-4, 4:-4]
    assert close(moved[..., 4:-4, 4:-4], rolled, 1e-5)


@given(clouds(reach=4.0), st.tuples(st.integers(-4, 4), st.integers(-4, 4), st.integers(-4, 4)))
def test_a_step_of_whole_voxels_shifts_the_volume(cloud, step):
    moved = volume([cloud[0] + torch.tensor(step, dtype=torch.float32), *cloud[1:]])
    rolled = torch.roll(volume(cloud), tuple(reversed(step)), (-3, -2, -1))
    assert close(moved[..., 4:-4, 4:-4, 4:-4], rolled[..., 4:-4, 4:-4, 4:-4], 1e-5)


@given(clouds(), rotations(1), rotations(2))
def test_turning_the_object_is_turning_the_views(cloud, turn, turns):
    centres, scales, quaternions, amplitudes = cloud
    own = Rotation.from_quat(np.roll(quaternions.double().numpy(), -1, 1))
    together = np.roll((Rotation.from_matrix(turn[0]) * own).as_quat(), 1, 1)
    moved = [centres.double() @ torch.from_numpy(turn[0]).T, scales, torch.from_numpy(together), amplitudes]
    found = image([a.float().contiguous() for a in moved], turns)
    longest = math.sqrt(2 * math.pi) * float(scales.max())  # along the beam; an image may reach this times the sum
    sizes = longest * (float(amplitudes.abs().sum()) + 1e-3)
    assert float((found - image(cloud, turns @ turn[0])).abs().max()) < 1.5e-5 * sizes


@given(clouds(), vectors(0.2, 5.0, 1))
def test_the_length_and_sign_of_quaternions_do_not_matter(cloud, length):
    centres, scales, quaternions, amplitudes = cloud
    turns = np.eye(3)[None]
    longer = [centres, scales, -float(length[0]) * quaternions, amplitudes]
    assert close(image(longer, turns), image(cloud, turns), 1e-5)
    assert close(volume(longer), volume(cloud), 1e-5)
