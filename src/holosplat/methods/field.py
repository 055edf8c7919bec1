"""The field of view, and the rows above and below it in which Gaussians stand for matter that goes on there."""

from __future__ import annotations

import torch

from ..baselines.beyond import MULTIPLE
from ..geometry import Grid, Views
from ..representations import GaussianCloud


def field_of(cloud: GaussianCloud, views: Views) -> Views:
    """`views` with the rows above and below that `cloud` fills: a multiple of `MULTIPLE`, to the nearest."""
    with torch.no_grad():
        height = cloud.centres[:, 1].double() * cloud.unit_length - float(Grid.of_views(views).centre[1])
    past = float(height.abs().max()) - 0.5 * views.height if len(cloud) else 0.0
    return views.taller(MULTIPLE * max(0, round(past / (MULTIPLE * views.finest))))
