"""The thesis' Gaussians: a density each, apart from δ and β."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import softplus

from holosplat.checks import require
from holosplat.matter import Matter
from holosplat.representations import GaussianCloud
from holosplat.representations.gaussians import PARAMETERS, raw_of


class DenseCloud(GaussianCloud):
    """Gaussians of peak values d δ and d β: density d, δ and β are parameters each, all through softplus.

    raw_densities [N, 1]: d before softplus, beside the parameters of `GaussianCloud`, whose raw_amplitudes are those of
    δ and β, in the units of `matter`. d goes down alone when Gaussians are cloned or split, and says which are faint.
    Errors: `InputError` if the arrays do not fit together.
    """

    names = (*PARAMETERS, "raw_densities")

    def __init__(self, parameters: Iterable[Tensor], unit_length: float, matter: Matter) -> None:
        *shared, self.raw_densities = parameters
        super().__init__(shared, unit_length, matter)
        shape = tuple(self.raw_densities.shape)
        require(shape == (len(self), 1), f"raw_densities must have the shape ({len(self)}, 1), but they have {shape}.")

    @property
    def densities(self) -> Tensor:
        """d [N, 1]."""
        return softplus(self.raw_densities)

    @property
    def values(self) -> Tensor:
        """δ and β [N, 2] of each Gaussian, in the units of the matter."""
        return softplus(self.raw_amplitudes)

    @property
    def amplitudes(self) -> Tensor:
        """Peak values d δ and d β [N, 2]."""
        return self.densities * self.values

    @property
    def strength(self) -> Tensor:
        """What says whether a Gaussian is faint, [N]: its density."""
        return self.densities[:, 0]

    def values_times(self, factor: float, index: Tensor) -> dict[str, Tensor]:
        """The parameters of the Gaussians `index` whose density is `factor` times theirs, with δ and β as they are."""
        weaker = raw_of(self.densities.detach()[index] * factor)
        return {"raw_amplitudes": self.raw_amplitudes.detach()[index], "raw_densities": weaker}

    def ratios(self) -> Tensor:
        """δ/β [N] of each Gaussian, as its parameters have them."""
        with torch.no_grad():
            delta, beta = self.values.double().unbind(1)
            smallest = torch.finfo(torch.float64).tiny
            return self.matter.delta * delta / (self.matter.beta * beta).clamp_min(smallest)

    def state(self) -> dict[str, Any]:
        """Plain Gaussians with the same peak values, which files can hold."""
        return self.plain().state()

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> GaussianCloud:  # type: ignore[override]
        """The plain Gaussians that `state` described."""
        return GaussianCloud.from_state(state)

    def plain(self) -> GaussianCloud:
        """Gaussians with the same peak values and no densities of their own."""
        kept = [getattr(self, name).detach() for name in PARAMETERS[:3]]
        return GaussianCloud([*kept, raw_of(self.amplitudes.detach())], self.unit_length, self.matter)
