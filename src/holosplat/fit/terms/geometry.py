"""What is expected of alignment and light before any frame is seen."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ...checks import InputError
from ...model import Model
from ...scan import Scan
from ..batch import Batch
from ..problem import Part, Term


class Quadratic:
    """Half the sum of squares of a model's parameters, each in units of how far off it is expected to be."""

    def __init__(self, name: str, weight: float, expected: dict[str, float]) -> None:
        """expected: standard deviation of each parameter by the name `part.parameter`."""
        self.names = (name,)
        self._weight, self._expected = weight, expected

    def __call__(self, model: Model, batch: Batch) -> Sequence[Part]:
        """The one part."""
        parameters = model.parameters()
        squares = [(parameters[name] / deviation).square().sum() for name, deviation in self._expected.items()]
        return [Part(self.names[0], self._weight, 0.5 * torch.stack([s.to(torch.float32) for s in squares]).sum())]


EXPECTED = {
    "alignment.turns": 0.01,
    "alignment.shifts": 1.0,
    "alignment.stretches": 0.02,
    "alignment.blurs": 0.5,
    "light.coefficients": 0.02,
}
"""Standard deviations where nobody says otherwise: [rad], [pixels], share of the distance, [pixels], share of light."""


def alignment_prior(weight: float, model: Model, train: Scan) -> Term:
    """Poses, distances and blurs near to the plan; `InputError` for a model without alignment."""
    return _quadratic("alignment_prior", "alignment.", weight, model.parameters())


def light_prior(weight: float, model: Model, train: Scan) -> Term:
    """Light that is nearly even; `InputError` for a model without a light field."""
    return _quadratic("light_prior", "light.", weight, model.parameters())


def _quadratic(name: str, prefix: str, weight: float, parameters: dict[str, Tensor]) -> Quadratic:
    own = {key: EXPECTED[key] for key in parameters if key.startswith(prefix)}
    if not own:
        raise InputError(f"the term {name} needs a model with {prefix}*, but it has {', '.join(parameters)}.")
    return Quadratic(name, weight, own)
