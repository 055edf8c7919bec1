"""A term on radiance fields: measured frames on random rays."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from holosplat.fit.problem import Batch, Part
from holosplat.model import Model
from holosplat.representations.neural_field import uniform
from holosplat.scan import Scan

from .photographed import RadianceField


class RandomRays:
    """Mean squared difference of intensities on rays drawn anew in every step (Mildenhall et al. 2020, eq. 6).

    count: of all rays in a step, as many of each frame.
    """

    names = ("rays",)

    def __init__(self, train: Scan, count: int, generator: torch.Generator) -> None:
        self._views, self._generator = train.views, generator
        self._frames = torch.from_numpy(train.frames).flatten(1)
        self._of_each = max(1, round(count / len(train)))

    def __call__(self, model: Model, batch: Batch) -> Sequence[Part]:
        """The one part."""
        field, generator = model.object, self._generator
        assert isinstance(field, RadianceField)
        positions, rays, measured = list[Tensor](), list[Tensor](), self._frames.new_zeros(0)
        for v, frame in enumerate(self._frames):
            chosen = (uniform(generator, self._of_each) * len(frame)).long().unique()
            at, ray = field.along(self._views, v, chosen, generator)
            positions.append(at)
            rays.append(ray + len(measured))
            measured = torch.cat((measured, frame[chosen]))
        found = field.intensities(torch.cat(positions), torch.cat(rays), len(measured))
        return [Part("rays", 1.0, (found - measured).square().mean())]
