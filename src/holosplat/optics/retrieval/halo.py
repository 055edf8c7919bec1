"""Halos of matter that a frame's edge cuts, taken out of retrieved thickness.

Fringes determine the curvature of the thickness, `∇²T` (the transport of intensity, Teague 1983). The thickness is
therefore free by a function without curvature, which its values at the border determine. Where matter extends beyond
the frame these are wrong, and a smooth halo reaches from there far into the frame. It is found again where there is
air, whose thickness is zero.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

WAVES = 6
"""Halves of a period along an edge, at most: shorter waves end within a sixth of the frame over π."""
ROUNDS = 60
"""Of weighted least squares."""
BELOW = 0.7
"""What a thickness below the halo counts, and one above 1 - that: matter is above."""
LEAST = 0.03
"""Thickness that passes for air, at least [pixels]."""
FINEST = 64
"""About so many pixels of the shorter side are looked at: halos are smooth."""
TINY = 1e-6
"""Of the unit matrix beside the equations."""


def without_halo(thickness: Tensor, air: float = LEAST) -> Tensor:
    """Thickness [V, H, W], in pixels, less the halo of each frame; less than zero where air was.

    The halo is the sum of a constant and, from each edge, of `WAVES` functions `cos(k s) exp(-k d)`, s along the edge
    and d from it, which have no curvature. It is the one with the least sum of absolute differences, in which what is
    below it counts more (`BELOW`), as of quantiles (Koenker & Bassett 1978, Econometrica 46, 33): most of a frame is
    air or, if not, has no halo of these few shapes. air: noise of the thickness [pixels].
    """
    shape = thickness.shape[1], thickness.shape[2]
    step = max(1, min(shape) // FINEST)
    coarse = avg_pool2d(thickness.detach().cpu().double()[None], step)[0].flatten(1).numpy()
    seen, everywhere, least = _without_curvature(shape, step), _without_curvature(shape), max(float(air) / step, LEAST)
    halos = np.array([everywhere @ _low_quantile(seen, frame, least) for frame in coarse])
    return thickness - torch.from_numpy(halos.reshape(-1, *shape)).to(thickness)


def _without_curvature(shape: tuple[int, int], step: int = 1) -> np.ndarray:
    """[Q, 1 + 4 WAVES]: the shapes at the middles of whole blocks of `step` × `step` pixels."""
    height, width = shape
    y, x = step * (np.mgrid[: height // step, : width // step] + 0.5)
    edges = ((x, width, y), (x, width, height - y), (y, height, x), (y, height, width - x))
    waves = [
        np.cos(np.pi * n * along / length) * np.exp(-np.pi * n * away / length)
        for along, length, away in edges
        for n in range(1, WAVES + 1)
    ]
    return np.stack([np.ones_like(x), *waves], axis=-1).reshape(-1, 1 + len(waves))


def _low_quantile(shapes: np.ndarray, values: np.ndarray, width: float) -> np.ndarray:
    """Coefficients of the `shapes` [Q, S] that run through the air of `values` [Q], by weighted least squares."""
    left, found = values, np.zeros(shapes.shape[1])
    for _ in range(ROUNDS):
        weights = np.where(left < 0, BELOW, 1 - BELOW) / np.hypot(left, width)
        matrix = shapes.T @ (weights[:, None] * shapes) + TINY * np.eye(shapes.shape[1])
        found = np.linalg.solve(matrix, shapes.T @ (weights * values))
        left = values - shapes @ found
    return found
