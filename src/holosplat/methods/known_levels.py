"""Materials that are known, as levels of an occupancy: where they lie, and what each absorbs by its own ratio δ/β."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, bucketize

from ..matter import DeltaBeta

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
