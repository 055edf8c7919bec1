"""Smooth images, of which uneven light is made."""

from __future__ import annotations

import torch
from torch import Tensor

from ..checks import require


def smooth_modes(shape: tuple[int, int], order: int, device: torch.device | str = "cpu") -> Tensor:
    """Products of cosines [K, h, w] up to `order` half waves along each side, `(order + 1)²` of them, float32.

    The first is constant one; they are those of the discrete cosine transform, of rms one.
    """
    require(order >= 0, f"the order of smooth modes must be 0 or more, but it is {order}.")
    rows, columns = (cosines(n, order, device) for n in shape)
    modes = rows[:, None, :, None] * columns[None, :, None, :]
    return modes.reshape(-1, *shape).float()


def half_waves(order: int) -> Tensor:
    """How many half waves each of `smooth_modes` has across a frame, [K], the root of the squares of both sides."""
    count = torch.arange(order + 1, dtype=torch.float64)
    return (count[:, None].square() + count.square()).sqrt().flatten()


def cosines(count: int, order: int, device: torch.device | str) -> Tensor:
    """Cosines [order + 1, count] of 0 to `order` half waves along `count` pixels, of rms one, float64."""
    place = (torch.arange(count, dtype=torch.float64, device=device) + 0.5) / count
    waves = torch.cos(torch.pi * torch.arange(order + 1, dtype=torch.float64, device=device)[:, None] * place)
    return waves / waves.square().mean(dim=1, keepdim=True).sqrt().clamp_min(1e-12)
