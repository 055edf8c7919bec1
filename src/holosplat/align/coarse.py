"""Initial geometry from single frames: shifts by centres of mass, and mirrored detectors."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..geometry import Views

MIRRORED = 0.85
"""A view counts as mirrored if its mirror image has less than this part of its own residual."""
SIDES = {"x": (-1,), "y": (-2,), "xy": (-1, -2)}
"""Names of mirror images, and the axes that are reversed."""


def shifts_by_mass(thickness: np.ndarray, views: Views) -> np.ndarray:
    """Detector shifts [V, 2] [pixels] beside those of `views` that bring all centres of mass to one point of space.

    thickness: [V, H, W] ≥ 0 of matter that lies in the field of every view. The centre of mass of a projection is the
    projection of the centre of mass (the moment of order one, Helgason 1980); the point is that which asks for the
    least shifts.
    """
    edges = views.relative[:, None]
    seen = centres_of_mass(thickness) + views.shifts / views.pixel_sizes[:, None]
    design = views.rotations[:, :2].reshape(-1, 3)
    point = np.linalg.lstsq(design, (seen * edges).reshape(-1), rcond=1e-9)[0]
    return (design @ point).reshape(-1, 2) / edges - seen


def centres_of_mass(images: np.ndarray) -> np.ndarray:
    """Centres of mass [V, 2] (x, y) [pixels] of images [V, H, W], from the middle of the image."""
    h, w = images.shape[1:]
    at_x, at_y = images.sum(1) @ (np.arange(w) + 0.5 - w / 2), images.sum(2) @ (np.arange(h) + 0.5 - h / 2)
    return np.stack([at_x, at_y], axis=1) / images.sum((1, 2))[:, None]


def mirrored(frames: Tensor, predicted: Tensor) -> list[str]:
    """Compare frames [V, H, W] with those of a volume [V, H, W]: "" or the mirror image that fits, for each.

    One of "x" (columns are reversed), "y" (rows are), "xy".
    """
    names = ["", *SIDES]
    images = [frames, *(frames.flip(axes) for axes in SIDES.values())]
    left = torch.stack([(image - predicted).square().mean((1, 2)).sqrt() for image in images])
    best = left.argmin(0)
    sure = left.amin(0) < MIRRORED * left[0]
    return [names[k] if known else "" for k, known in zip(best.tolist(), sure.tolist())]
