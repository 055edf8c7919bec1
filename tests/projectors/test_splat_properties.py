"""What holds of line integrals whoever computes them: the properties, on every backend, also on the GPU's."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from helpers.kernels import few_programs
from holosplat.geometry import rotation_y
from holosplat.projectors.splat import splat

SHAPE = (25, 34)


@pytest.fixture(params=["cpu", "reference", "cuda"])
def project(request, monkeypatch):
    """`splat` on one backend: the cloud's four arrays, rotations, shifts and options in, images in main memory out."""
    place = request.getfixturevalue("gpu") if request.param == "cuda" else "cpu"
    if request.param == "cuda":
        few_programs(monkeypatch, place, 16)

    def act(arrays: list[Tensor], rotations: np.ndarray, shifts: np.ndarray, **options: float) -> Tensor:
        moved = [a.float().to(place) for a in arrays]
        return splat(*moved, rotations, shifts, SHAPE, backend=request.param, **options).cpu()

    return act


def a_cloud(count: int = 12, channels: int = 2) -> list[Tensor]:
    """Ellipsoids near the middle of the field, with signed amplitudes."""
    r = torch.Generator().manual_seed(4)
    centres = 8 * (torch.rand(count, 3, generator=r) - 0.5)
    scales = 0.8 + torch.rand(count, 3, generator=r)
    return [centres, scales, torch.randn(count, 4, generator=r), torch.randn(count, channels, generator=r)]


def alike(a: Tensor, b: Tensor, tolerance: float = 3e-6) -> bool:
    """Equal up to a share of the largest value."""
    return float((a - b).abs().max()) < tolerance * float(b.abs().max())


TURNS, STILL = rotation_y([0.0, 50.0, 130.0]), np.zeros((3, 2))


def test_linear_in_the_amplitudes(project):
    *shape, a = a_cloud()
    b = torch.randn(a.shape, generator=torch.Generator().manual_seed(5))
    images = [project([*shape, x], TURNS, STILL) for x in (a, b, 2 * a - 3 * b)]
    assert alike(images[2], 2 * images[0] - 3 * images[1])


def test_turning_the_object_is_turning_the_views(project):
    centres, scales, quaternions, amplitudes = a_cloud()
    turn = Rotation.random(rng=9)
    own = Rotation.from_quat(np.roll(quaternions.numpy(), -1, 1))
    turned = torch.from_numpy(np.roll((turn * own).as_quat(), 1, 1))
    matrix = turn.as_matrix()
    cloud = [centres.double() @ torch.from_numpy(matrix).T, scales, turned, amplitudes]
    options = {"cutoff": 6.0}  # a pixel more or less of a box does not matter then
    moved = project(cloud, TURNS, STILL, **options)
    assert alike(moved, project([centres, scales, quaternions, amplitudes], TURNS @ matrix, STILL, **options), 1e-5)


def test_the_view_from_behind_is_the_mirror_image(project):
    front, back = (project(a_cloud(), rotation_y([angle]), STILL[:1], cutoff=6.0) for angle in (35.0, 215.0))
    assert alike(front, back.flip(-1), 1e-5)


def test_shifting_by_a_pixel_shifts_the_image(project):
    still = project(a_cloud(), TURNS, STILL)
    moved = project(a_cloud(), TURNS, STILL + [1.0, -2.0])
    assert alike(moved[:, :, 2:, :-1], still[:, :, :-2, 1:])


def test_mass_is_conserved_as_the_cut_grows(project):
    """A box of `cutoff` deviations holds erf(c/√2)² of a Gaussian at least along its axes, and all of it in the end."""
    centres, scales, quaternions, _ = a_cloud(6, 1)
    amplitudes = torch.ones(6, 1)
    mass = float((2 * math.pi) ** 1.5 * scales.prod(1).sum())
    shares = []
    for cutoff in (1.5, 2.0, 3.0, 4.0, 6.0):
        image = project([centres, scales, quaternions, amplitudes], TURNS, STILL, cutoff=cutoff)
        share = image.double().sum((1, 2, 3)) / mass
        least = math.erf((cutoff - 0.5) / math.sqrt(2)) ** 2  # boxes are cut to whole pixels
        assert float(share.min()) > least - 1e-6
        shares.append(share)
    assert all(bool((b > a - 1e-6).all()) for a, b in pairwise(shares))
    assert bool((shares[0] < 0.95).all())  # there was something to conserve
    assert torch.allclose(shares[-1], torch.ones(3, dtype=torch.float64), atol=1e-4)
