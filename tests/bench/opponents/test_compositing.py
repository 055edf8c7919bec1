"""Compositing front to back: against the formula by hand, a closed form, and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat.geometry import Views
from holosplat_bench.opponents.photographed import DILATION, composite, photograph

SHAPE = (9, 13)


def scene(seed: int = 0, count: int = 5) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centres, scales, quaternions and values of random Gaussians, float64."""
    draw = torch.Generator().manual_seed(seed)
    centres = 3 * torch.randn(count, 3, generator=draw).double()
    scales = 0.8 + 1.5 * torch.rand(count, 3, generator=draw).double()
    opacities, greys = 0.2 + 0.6 * torch.rand(2, count, generator=draw).double()
    return centres, scales, torch.randn(count, 4, generator=draw).double(), torch.stack((opacities, 2 * greys), 1)


def by_hand(centres: Tensor, scales: Tensor, values: Tensor, matrix: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """The photograph of round Gaussians, pixel by pixel, the nearest first, each over what is behind it."""
    lab = centres.numpy() @ matrix.T
    image = np.ones(SHAPE)  # the screen, over which everything comes from the back to the front
    for n in np.argsort(-lab[:, 2]):
        for i, j in np.ndindex(*SHAPE):
            x = j + 0.5 - SHAPE[1] / 2 + shift[0] - lab[n, 0]
            y = i + 0.5 - SHAPE[0] / 2 + shift[1] - lab[n, 1]
            opacity, grey = values[n].tolist()
            alpha = min(0.99, opacity * math.exp(-0.5 * (x * x + y * y) / (float(scales[n, 0]) ** 2 + DILATION)))
            if alpha >= 1 / 255:
                image[i, j] = alpha * grey + (1 - alpha) * image[i, j]
    return image


def test_photographs_are_those_by_hand():
    """Of overlapping round Gaussians, from any side, on an odd rectangular frame with a shifted detector."""
    centres, scales, quaternions, values = scene(count=6)
    scales = scales[:, :1].expand(-1, 3)
    values[0, 0] = 0.9999  # more opaque than anything may be
    for matrix in Views.from_angles([0.0, 73.0, 180.0], SHAPE, 1.0).rotations:
        shift = np.array([0.7, -0.4])
        found = photograph(
            centres, scales, quaternions, values, torch.from_numpy(matrix), torch.from_numpy(shift), SHAPE
        )
        assert np.allclose(found.numpy(), by_hand(centres, scales, values, matrix, shift), rtol=0, atol=1e-12)


def test_the_front_hides_the_back():
    """Two at one place: what is upstream comes first, and from the other side it is the other way round."""
    centres = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]]).double()
    scales, turned = torch.ones(2, 3).double(), torch.tensor([[1.0, 0, 0, 0]] * 2).double()
    (back, dark), (front, bright) = values = torch.tensor([[0.5, 0.2], [0.8, 1.7]]).double()
    seen = []
    for matrix in Views.from_angles([0.0, 180.0], (3, 5), 1.0).rotations:
        frame = photograph(centres, scales, turned, values, torch.from_numpy(matrix), torch.zeros(2), (3, 5))
        seen.append(float(frame[1, 2]))
    ahead = front * bright + (1 - front) * (back * dark + (1 - back))
    behind = back * dark + (1 - back) * (front * bright + (1 - front))
    assert seen == pytest.approx([float(ahead), float(behind)], rel=1e-12)


def test_a_slab_shines_and_absorbs_by_the_exponential_law():
    """However finely it is divided: I = g + (1 - g) exp(-τ); a pixel without samples shows the screen."""
    grey, total = 0.3, 1.7
    for parts in (1, 7, 100):
        thickness = torch.full((parts,), total / parts)
        pixel = torch.ones(parts, dtype=torch.long)
        found = composite(thickness, torch.full((parts,), grey), pixel, 3)
        assert found.tolist() == pytest.approx([1.0, grey + (1 - grey) * math.exp(-total), 1.0], rel=1e-5)


def test_gradients_are_those_of_finite_differences():
    cloud = scene(seed=4, count=4)
    turn = torch.from_numpy(Views.from_angles([31.0], SHAPE, 1.0).rotations[0])
    free = [part.requires_grad_() for part in (*cloud, turn, torch.tensor([0.3, -0.2]).double())]
    assert torch.autograd.gradcheck(lambda *parts: photograph(*parts, SHAPE), free, fast_mode=True)
    pixel, samples = (
        torch.tensor([0, 0, 2, 2, 2]),
        torch.rand(2, 5, generator=torch.Generator().manual_seed(1)).double(),
    )
    free = [row.clone().requires_grad_() for row in samples]
    assert torch.autograd.gradcheck(lambda t, g: composite(t, g, pixel, 3), free)
