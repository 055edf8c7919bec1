"""The quantity that a report shows of matter: δ, or µ where the frames show absorption alone."""

from __future__ import annotations

from dataclasses import dataclass

from ..units import wavenumber
from .style import scientific


@dataclass(frozen=True)
class Quantity:
    """symbol: its letter; factor: by which δ (or β, which then stands for it) is multiplied; unit: empty for none."""

    symbol: str
    factor: float
    unit: str

    def text(self, value: float) -> str:
        """A δ, or the β that stands for it, as this quantity with its unit."""
        return f"{scientific(self.factor * value)}\u00a0{self.unit}".rstrip()

    def label(self, power: str = "") -> str:
        """The name of an axis in units of `power`, such as 10⁻⁷."""
        unit = " ".join(filter(None, (power, self.unit)))
        return f"{self.symbol} ({unit})" if unit else self.symbol


DELTA = Quantity("δ", 1.0, "")


def attenuation(energy_kev: float) -> Quantity:
    """The attenuation coefficient µ = 4πβ/λ [m⁻¹] at `energy_kev` [keV]."""
    return Quantity("µ", 2 * float(wavenumber(energy_kev)), "m⁻¹")
