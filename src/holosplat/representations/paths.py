"""Paths through time: one basis of B-splines that all nodes share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..checks import InputError, require

MOST_DEGREE = 5


@dataclass(frozen=True)
class TimeBasis:
    """B-splines of time on even pieces between two instants (de Boor 2001, "A Practical Guide to Splines", chapter 9).

    first, last: these instants [s]; degree: of the polynomials; pieces: their number, of which one is a polynomial.

    Beyond both ends the outermost polynomials go on. Errors: `InputError` for a degree or number out of range, and for
    instants that do not grow, unless the basis stands still (degree 0, one piece).
    """

    first: float
    last: float
    degree: int = 2
    pieces: int = 1

    def __post_init__(self) -> None:
        require(
            0 <= self.degree <= MOST_DEGREE,
            f"the degree of paths must lie between 0 and {MOST_DEGREE}, but it is {self.degree}; choose another.",
        )
        require(self.pieces >= 1, f"the pieces of paths must be at least 1, but they are {self.pieces}.")
        still = self.degree == 0 and self.pieces == 1
        if not (np.isfinite([self.first, self.last]).all() and (self.first < self.last or still)):
            raise InputError(
                f"paths must lead from one time to a later one, but they go from {self.first:g} to {self.last:g} s; "
                "give frames of two times at least."
            )

    @property
    def count(self) -> int:
        """How many coefficients a path has."""
        return self.degree + self.pieces

    @property
    def span(self) -> float:
        """Length of a piece [s]."""
        return (self.last - self.first) / self.pieces

    def weights(self, times: np.ndarray | float, derivative: int = 0) -> np.ndarray:
        """What each coefficient counts at `times` [T] [s]: [T, K], or its derivative [1/s^derivative]."""
        t = np.atleast_1d(np.asarray(times, dtype=np.float64))
        if derivative > self.degree:
            return np.zeros((len(t), self.count))
        if self.degree == 0 and self.pieces == 1:
            return np.ones((len(t), 1))
        from scipy.interpolate import BSpline  # which takes a second to load

        found = BSpline(self._knots(), np.eye(self.count), self.degree)((t - self.first) / self.span, derivative)
        return np.asarray(found) / self.span**derivative

    def _knots(self) -> np.ndarray:
        """Those of all splines, in pieces, for times may be tiny."""
        ends = [np.repeat(end, self.degree) for end in (0.0, float(self.pieces))]
        return np.concatenate([ends[0], np.arange(self.pieces + 1.0), ends[1]])

    def fitted(self, times: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Least-squares coefficients [K, …] of paths through `places` [T, …] at `times` [T].

        Where the times leave coefficients open, these are the smallest that go with them.
        """
        weights = self.weights(times)
        flat = np.asarray(places, dtype=np.float64).reshape(len(weights), -1)
        return np.linalg.lstsq(weights, flat, rcond=1e-9)[0].reshape(self.count, *np.shape(places)[1:])

    def gram(self, times: np.ndarray) -> np.ndarray:
        """[K, K]: mean over `times` of the products of weights, so that cᵀ G c is the mean square of a path."""
        weights = self.weights(times)
        return weights.T @ weights / len(weights)

    def curvature(self) -> np.ndarray:
        """[K - 2, K]: from coefficients to those of the second derivative, whose unit of time is a piece.

        Of straight lines in pieces it is the change of slope where they meet. (de Boor 2001, chapter 10, eq. 16.)
        """
        if self.count < 3 or self.degree < 1:
            return np.zeros((0, self.count))
        found, knots = np.eye(self.count), self._knots()
        for degree in (self.degree, self.degree - 1):
            rows = np.diff(found, axis=0)
            wide = knots[degree + 1 : degree + 1 + len(rows)] - knots[1 : 1 + len(rows)]
            found = rows * (degree / wide)[:, None] if degree else rows
            knots = knots[1:-1]
        return found

    def as_dict(self) -> dict[str, float | int]:
        """Plain values, which `from_dict` reads."""
        return {"first_s": self.first, "last_s": self.last, "degree": self.degree, "pieces": self.pieces}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TimeBasis:
        """The basis that `as_dict` described."""
        ends = float(values["first_s"]), float(values["last_s"])
        return cls(*ends, int(values["degree"]), int(values["pieces"]))


def path_positions(basis: TimeBasis, coefficients: Tensor, time: float, derivative: int = 0) -> Tensor:
    """Places [P, 3] at `time` [s] of paths with `coefficients` [K, P, 3], or their derivative by the time."""
    weights = torch.from_numpy(basis.weights(time, derivative)[0]).to(coefficients)
    return torch.einsum("k,kpx->px", weights, coefficients)
