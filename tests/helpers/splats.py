"""Clouds, views and volumes that the tests of the splat draw on every backend."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from holosplat.projectors.splat import splat, voxelise

NAMES = ("centres", "scales", "quaternions", "amplitudes")
DETECTOR, VOLUME = (31, 40), (23, 31, 40)
KINDS = ("ordinary", "small", "thin", "large", "outside")


def cloud(kind: str, channels: int = 1, count: int = 120, seed: int = 0) -> list[Tensor]:
    """A random float32 cloud of one kind, around (and a little beyond) the detector; signed amplitudes."""
    r = torch.Generator().manual_seed(seed)
    spread = torch.tensor([44.0, 34.0, 26.0]) * (4.0 if kind == "outside" else 1.0)
    centres = (torch.rand(count, 3, generator=r) - 0.5) * spread
    scales = {
        "ordinary": lambda u: 0.3 + 3 * u,
        "outside": lambda u: 0.3 + 3 * u,
        "small": lambda u: 0.3 + 0.5 * u,
        "thin": lambda u: 10 ** (4 * u - 3),  # 0.001 to 10 px: needles and discs
        "large": lambda u: 10 + 50 * u,
    }[kind](torch.rand(count, 3, generator=r))
    return [centres, scales, torch.randn(count, 4, generator=r), torch.randn(count, channels, generator=r)]


def poses(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Rotations [V, 3, 3] in all directions, not coplanar, and shifts [V, 2] of a few pixels."""
    shifts = np.random.default_rng(seed).normal(size=(count, 2)) * 3
    return torch.from_numpy(Rotation.random(count, rng=seed).as_matrix()), torch.from_numpy(shifts)


def value_and_gradients(function, arrays: list[Tensor], dtype: torch.dtype) -> tuple[Tensor, list[Tensor]]:
    """The function's value, and the gradients of a fixed random sum over it."""
    leaves = [a.to(dtype).requires_grad_() for a in arrays]
    value = function(*leaves)
    weights = torch.randn(value.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return value.detach(), list(torch.autograd.grad(value, leaves, weights.to(dtype)))


def error(value: Tensor, truth: Tensor) -> float:
    """Largest difference over largest true value."""
    return float((value.detach().double() - truth.detach()).abs().max() / truth.detach().abs().max())


def draw_views(*arguments) -> Tensor:
    *arrays, backend = arguments
    return splat(*arrays, *poses(3), DETECTOR, backend=backend)


def draw_volume(*arguments) -> Tensor:
    *arrays, backend = arguments
    return voxelise(*arrays, VOLUME, backend=backend)


DRAWS = pytest.mark.parametrize("draw", [draw_views, draw_volume])
