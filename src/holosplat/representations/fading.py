"""How the amplitudes of matter in motion change with time: a smooth field of their logarithm at the reference time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import softplus

from ..checks import require
from .flow import Lattice
from .gaussians import raw_of


@dataclass(frozen=True)
class Fading:
    """What matter has at x of the reference time becomes, on its way, exp(s g₁(x) + s² g₂(x)) as much, s the time from
    the reference on [lengths of all times].

    coefficients: [2, Z, Y, X] of g₁ and g₂, cubic B-splines on `lattice`. Errors: `InputError` where they do not fit.
    """

    coefficients: Tensor
    lattice: Lattice

    def __post_init__(self) -> None:
        wanted, shape = (2, *self.lattice.counts), tuple(self.coefficients.shape)
        require(shape == wanted, f"a fading must have coefficients of the shape {wanted}, but theirs is {shape}.")

    @classmethod
    def none(cls, lattice: Lattice) -> Fading:
        """Coefficients without any change, float32."""
        return cls(torch.zeros(2, *lattice.counts), lattice)

    def with_coefficients(self, coefficients: Tensor) -> Fading:
        """The same lattice with others."""
        return replace(self, coefficients=coefficients)

    def on(self, axes: Sequence[Tensor]) -> Tensor:
        """g₁ and g₂ [2, Z, Y, X] at the crossings of places `axes` along z [Z], y [Y] and x [X]."""
        z, y, x = (self._weights(places, axis).to(self.coefficients) for axis, places in zip((2, 1, 0), axes))
        return torch.einsum("czyx,kz,jy,ix->ckji", self.coefficients, z, y, x)

    def at(self, points: Tensor) -> Tensor:
        """g₁ and g₂ [2, P] at `points` [P, 3]."""
        z, y, x = (self.lattice.weights(points, axis, 0)[0].to(self.coefficients) for axis in (2, 1, 0))
        return torch.einsum("czyx,pz,py,px->cp", self.coefficients, z, y, x)

    def of_raw(self, centres: Tensor, raw: Tensor, ends: tuple[float, float]) -> Tensor:
        """[2, N], linear and square change of the raw amplitudes `raw` [N] of Gaussians at `centres` [N, 3], which is
        that of their amplitudes at the reference and at `ends`, two times other than that."""
        amplitudes = softplus(raw)
        a, b = ends
        now, g = raw_of(amplitudes), self.at(centres).to(raw)
        first, last = (raw_of(amplitudes * faded(g, s)) - now for s in ends)
        curved = (first / a - last / b) / (a - b)
        return torch.stack([first / a - a * curved, curved])

    def _weights(self, places: Tensor, axis: int) -> Tensor:
        points = places.new_zeros(len(places), 3)
        points[:, axis] = places
        return self.lattice.weights(points, axis, 0)[0]


def faded(values: Tensor, later: float) -> Tensor:
    """The factors exp(s g₁ + s² g₂) [...] of g₁ and g₂ `values` [2, ...] at s = `later`."""
    return (later * values[0] + later**2 * values[1]).exp()
