"""The network: any number of views in any order, any size, and what it predicts for the frames."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holosplat.geometry import Grid, Views
from holosplat.learning.network import Guess, Size, Taps, _fine, coarse, thickness_of

SMALL = Size((4, 4, 6, 6), 3, (4, 6, 8))


def case(angles: list[float], shape: tuple[int, int] = (12, 10)) -> tuple[torch.Tensor, Taps]:
    h, w = shape
    random = torch.Generator().manual_seed(1)
    grid, views = Grid.centred((w // 2, h // 2, w // 2), 1.0), Views.from_angles(angles, (h // 2, w // 2), 1.0)
    return torch.rand(len(angles), 3, *shape, generator=random), Taps.of(grid, views)


@pytest.fixture(scope="module")
def network() -> Guess:
    torch.manual_seed(0)
    return Guess(SMALL)


@pytest.mark.parametrize(("angles", "shape"), [([0.0, 90.0], (12, 10)), ([5.0, 30.0, 48.0, 100.0, 160.0], (18, 14))])
def test_volumes_have_voxels_half_as_large_as_the_lattice(network, angles, shape):
    first, second = network(*case(angles, shape))

    assert first.shape == second.shape == (shape[1], shape[0], shape[1])


def test_views_have_no_order(network):
    images, taps = case([0.0, 50.0, 110.0])
    turned = torch.tensor([2, 0, 1])

    ours, theirs = network(images, taps)[1], network(images[turned], taps.part(turned))[1]

    assert torch.allclose(ours, theirs, atol=1e-5)
    assert not torch.allclose(ours, network(images[turned], taps)[1], atol=1e-4)  # the poses go with the images


def test_the_default_has_about_a_million_weights():
    assert 0.5e6 < sum(value.numel() for value in Guess().parameters()) < 2e6


def test_eight_logits_of_a_voxel_are_its_parts():
    logits = torch.zeros(1, 8, 2, 3, 4)
    logits[0, :, 1, 2, 3] = torch.arange(8.0)

    fine = _fine(logits)

    assert fine[2:, 4:, 6:].flatten().tolist() == list(range(8))
    assert float(fine.sum()) == 28
    assert float(coarse(fine)[1, 2, 3]) == 3.5


def test_thickness_of_a_full_slab_is_its_depth():
    taps = Taps.of(Grid.centred((6, 5, 6), 1.0), Views.from_angles([0.0, 90.0], (5, 6), 1.0))

    shown = thickness_of(torch.ones(6 * 5 * 6), taps)

    # six voxels of two pixels each, in the images' unit of four pixels
    assert np.allclose(shown.numpy(), 3.0)


def test_gradients_reach_every_weight(network):
    network.zero_grad()
    network(*case([0.0, 70.0]))[1].square().mean().backward()

    assert all(value.grad is not None and bool(value.grad.abs().sum() > 0) for value in network.parameters())
