"""The power that frames themselves show of a phase: the parameters of its prior, by maximum likelihood."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

CORNERS = np.geomspace(1.5, 16.0, 11)
"""Frequencies [cycles per field of view] below which the power may be level: no body seen whole is larger than the
field, so that its power is level from about a cycle on, and a dozen times smaller ones are hardly resolved."""
DECAYS = np.arange(1.0, 2.01, 0.25)
"""Half the exponents of the fall-off that are tried: textures, bodies with sharp edges (2), and softer ones."""
LOWEST = 2
"""Cycles a frame below which a periodogram of a cut frame holds what lies beside it."""
SCORING = 40
"""Steps of Fisher's scoring for the scale, which converges quadratically."""


def expected_shapes(frames: Tensor, response2: Tensor, cycles: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Corners and decays [V] of the power `A / (f² + corner²)^decay` of the phases, f in cycles per field of view.

    frames: relative intensities [V, H, W]; response2: squared response [V, H, W//2 + 1] at their frequencies; cycles:
    these frequencies [H, W//2 + 1]; noise: power of everything else [V, H, W//2 + 1] or [V, 1, 1].

    The periodogram of each frame, in rings of one cycle, is compared with `A |H|² / (f² + corner²)^decay + noise` by
    Whittle's (1953) likelihood; of all tried shapes the mean by their likelihood is taken. Where the response hides a
    frequency, as it does the lowest, the law goes on from those that are seen. Frames are tapered (Hann), so that
    their edges do not pass for power.
    """
    contrast = frames.detach().cpu().double() - 1
    h, w = contrast.shape[1:]
    taper = torch.hann_window(h + 2, periodic=False)[1:-1, None] * torch.hann_window(w + 2, periodic=False)[1:-1]
    taper = taper.double() / taper.double().square().mean().sqrt()
    power = torch.fft.rfft2((contrast - contrast.mean(dim=(1, 2), keepdim=True)) * taper, norm="ortho").abs().square()
    ring = cycles.round().long().flatten()
    count = torch.bincount(ring).double()
    f = np.arange(len(count), dtype=float)
    used = (count.numpy() > 0) & (f >= LOWEST) & (f <= max(min(h, w) // 2, LOWEST))
    weight, bodies = count.numpy()[used], (f[used] ** 2 + CORNERS[:, None, None] ** 2) ** -DECAYS[:, None]

    def over_rings(image: Tensor) -> np.ndarray:
        values = image.expand(h, w // 2 + 1).flatten().double()
        return (torch.zeros(len(count), dtype=torch.float64).index_add(0, ring, values) / count.clamp_min(1)).numpy()[
            used
        ]

    found = [
        _mean_shape(over_rings(one), bodies * over_rings(gain), over_rings(rest), weight)
        for one, gain, rest in zip(power, response2, noise)
    ]
    corners, decays = zip(*found)
    return torch.tensor(corners, dtype=torch.float64), torch.tensor(decays, dtype=torch.float64)


def _mean_shape(seen: np.ndarray, shape: np.ndarray, rest: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Corner and decay by a ring spectrum `seen` [R]; shape: what each pair of them predicts [C, D, R] up to a scale,
    beside the power of everything else, `rest` [R]; weight: samples of each ring [R]."""
    tiny = np.finfo(float).tiny
    scale = np.maximum((seen - rest).clip(0).sum() / np.maximum(shape.sum(axis=-1), tiny), tiny)[..., None]
    for _ in range(SCORING):
        model = scale * shape + rest
        score, information = (
            (weight * part / model**2).sum(axis=-1, keepdims=True) for part in (shape * (seen - model), shape**2)
        )
        scale = np.maximum(scale + score / np.maximum(information, tiny), 1e-3 * scale)
    model = np.maximum(scale * shape + rest, tiny)
    likelihood = -(weight * (seen / model + np.log(model))).sum(axis=-1)
    share = np.exp(likelihood - likelihood.max())
    share /= share.sum()
    corner = np.exp((share.sum(axis=1) * np.log(CORNERS)).sum())
    return float(corner), float((share.sum(axis=0) * DECAYS).sum())
