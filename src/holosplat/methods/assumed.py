"""The materials of a first volume: the one that stands for all matter, or the levels of those that are known."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, bucketize

from ..backends import Backend
from ..baselines.material import DEFAULT, MaterialEstimate, estimate_delta, estimate_ratio
from ..matter import DeltaBeta, KnownRatio, MaterialPrior
from ..progress import Progress
from ..scan import Scan


def assumed_material(
    scan: Scan,
    prior: MaterialPrior,
    on_progress: Progress,
    backend: Backend = "auto",
    options: MaterialEstimate = DEFAULT,
) -> DeltaBeta:
    """δ and β of one material for all matter: as known, or as the training frames `scan` suggest.

    Where several are known, it has the δ of the first, and the ratio of an equal mixture. What is estimated has the
    sign of δ that the prior says, or is above the medium where it says none.
    """
    if prior.materials:
        deltas, betas = zip(*prior.materials)
        return DeltaBeta(deltas[0], deltas[0] * sum(betas) / sum(deltas)) if betas[1:] else prior.materials[0]
    how = (on_progress, backend, options, prior.delta_sign)
    ratio = prior.ratio if isinstance(prior, KnownRatio) else estimate_ratio(scan, *how)
    delta = estimate_delta(scan, ratio, *how, prior.two_sided)
    return DeltaBeta(delta, delta / ratio)


ALIKE = 1e-6
"""Difference of β, as a share, below which two materials have one ratio."""


@dataclass(frozen=True)
class KnownLevels:
    """Known materials, all of one sign of δ, in an occupancy of `unit` [δ, β]; none where no density is known."""

    materials: tuple[DeltaBeta, ...]
    unit: DeltaBeta

    @property
    def occupancies(self) -> tuple[float, ...]:
        """The occupancy of each, rising."""
        return tuple(sorted(delta / self.unit.delta for delta, _ in self.materials))

    def absorbed(self, u: Tensor) -> Tensor | None:
        """β beside that of an occupancy u [Z, Y, X] of the unit, as large as between the two levels that are nearest;
        None where all matter has the unit's ratio."""
        knots = sorted((delta / self.unit.delta, beta) for delta, beta in self.materials)
        beside = [0.0, *(beta - level * self.unit.beta for level, beta in knots)]
        if max(map(abs, beside)) <= ALIKE * abs(self.unit.beta):
            return None
        at, values = u.new_tensor([0.0, *(level for level, _ in knots)]), u.new_tensor(beside)
        right = bucketize(u, at).clamp(1, len(at) - 1)
        share = ((u - at[right - 1]) / (at[right] - at[right - 1])).clamp(0, 1)
        return values[right - 1] + share * (values[right] - values[right - 1])
