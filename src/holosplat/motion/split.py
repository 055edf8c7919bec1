"""The motion of a body in parts, each a polynomial of time: its centre, its turn, its stretch and the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.transform import Rotation

PARTS = ("centre", "turn", "stretch", "rest")
MOST_REST = 1
"""Highest power of time of the rest: of the next one, fits of paths hold more noise than motion, and half-sets do not
notice, for both begin at the same fit and keep its fine noise."""
POOLED = 2.0
"""What a coefficient's variance in the other bodies counts against a body's own, which one difference tells."""


@dataclass(frozen=True)
class Window:
    """Times [s] from `first` to `last`, whose Legendre polynomials are used up to `degree`."""

    first: float
    last: float
    degree: int = 2

    def scaled(self, times: np.ndarray) -> np.ndarray:
        """Times [T] such that the window is -1 … 1."""
        return 2 * (np.asarray(times, dtype=np.float64) - self.first) / (self.last - self.first) - 1

    def coefficients(self, times: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Least-squares coefficients [D + 1, …] of polynomials through `values` [T, …] at `times` [T]."""
        flat = np.reshape(values, (len(times), -1))
        found = legendre.legfit(self.scaled(times), flat, min(self.degree, len(times) - 1))
        full = np.zeros((self.degree + 1, flat.shape[1]))
        full[: len(found)] = found
        return full.reshape(self.degree + 1, *np.shape(values)[1:])

    def values(self, times: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """[T, …] at `times` [T], in the window or beyond."""
        weights = legendre.legvander(self.scaled(times), len(coefficients) - 1)
        return np.tensordot(weights, coefficients, axes=1)


@dataclass(frozen=True)
class Split:
    """Coefficients of one body's parts: centre and turn [D + 1, 3] [m, rad], stretch [D + 1, 3, 3], rest [D + 1, P, 3]
    [m]; shape [P, 3] [m], the reference about its middle, to which turn, stretch and rest are relative."""

    shape: np.ndarray
    centre: np.ndarray
    turn: np.ndarray
    stretch: np.ndarray
    rest: np.ndarray

    @classmethod
    def of(cls, places: np.ndarray, times: np.ndarray, window: Window, weights: np.ndarray, reference: int) -> Split:
        """The parts of the places [T, P, 3] [m] of a body's vertices at `times` [T].

        weights: [P] of the vertices, such as the areas around them; reference: number of the time of the shape.
        """
        weights = weights / weights.sum()
        centre = np.einsum("p,tpx->tx", weights, places)
        local = places - centre[:, None]
        shape = local[reference]
        turns = np.array([_turn(shape, one, weights) for one in local])
        own = np.einsum("tji,tpj->tpi", turns, local) - shape
        second = np.einsum("p,pi,pj->ij", weights, shape, shape)
        moments = np.einsum("p,pi,tpj->tij", weights, shape, own)
        stretch = np.linalg.solve(second, moments)
        rest = own - np.einsum("pi,tij->tpj", shape, stretch)
        vectors = Rotation.from_matrix(turns).as_rotvec()
        found = (window.coefficients(times, part) for part in (centre, vectors, stretch, rest))
        return cls(shape, *found)

    def places(self, times: np.ndarray, window: Window) -> np.ndarray:
        """[T, P, 3] [m] at `times` [T], beyond the window too."""
        centre, vectors, stretch, rest = (window.values(times, getattr(self, name)) for name in PARTS)
        own = self.shape + np.einsum("pi,tij->tpj", self.shape, stretch) + rest
        turns = Rotation.from_rotvec(vectors).as_matrix()
        return centre[:, None] + np.einsum("tij,tpj->tpi", turns, own)

    def stiffened(self, window: Window) -> Split:
        """The same motion of a body that keeps the shape of the window's last time."""
        last = [window.values(np.array([window.last]), part)[0] for part in (self.stretch, self.rest)]
        still = [np.concatenate([one[None], np.zeros((window.degree, *one.shape))]) for one in last]
        return Split(self.shape, self.centre, self.turn, *still)


def shrunk(splits: Sequence[Split], halves: tuple[Sequence[Split], Sequence[Split]] | None) -> list[Split]:
    """Each coefficient moved towards what it is without data, as far as two half-sets of the data disagree on it.

    A coefficient q has the variance σ² = (q₁ - q₂)²/4 in a body, of which the median over bodies counts `POOLED` times
    as much as its own; how large it is in truth, τ², is the median of q² less that of σ². It is multiplied by
    τ²/(τ² + σ²) (empirical Bayes; Efron & Morris 1973, J. Am. Stat. Assoc. 68, 117). Without data centres go with
    their median velocity, and all else stays. The rest has one factor a power of time, and none above `MOST_REST`. The
    means over the window (power 0) are kept. Without `halves` all of this is.
    """
    changed = []
    for name in ("centre", "turn", "stretch"):
        values = np.array([getattr(one, name) for one in splits])
        usual = np.zeros_like(values)
        if name == "centre":
            usual[:, 1] = np.median(values[:, 1], axis=0)
        noise = 0 * values if halves is None else _differences(halves, name) ** 2 / 4
        factors = believed(noise, (values - usual) ** 2)
        factors[:, 0] = 1.0
        changed.append(usual + factors * (values - usual))
    rests = [factor[:, None, None] * one.rest for factor, one in zip(_rest_factors(splits, halves), splits)]
    return [Split(one.shape, *parts) for one, *parts in zip(splits, *changed, rests)]


def believed(noise: np.ndarray, square: np.ndarray) -> np.ndarray:
    """τ²/(τ² + σ²) [B, …], from the `noise` squared and the `square` of coefficients [B, …]; 1 without noise."""
    usual = np.median(noise, axis=0)
    own = (POOLED * usual + noise) / (POOLED + 1)
    true = np.maximum(np.median(square, axis=0) - usual, 0)
    return np.where(own > 0, true / np.maximum(true + own, np.finfo(float).tiny), 1.0)


def _differences(halves: tuple[Sequence[Split], Sequence[Split]], name: str) -> np.ndarray:
    return np.array([getattr(a, name) - getattr(b, name) for a, b in zip(*halves)])


def _rest_factors(splits: Sequence[Split], halves: tuple[Sequence[Split], Sequence[Split]] | None) -> np.ndarray:
    """[B, D + 1] of the rest's powers of time."""
    square = np.array([(one.rest**2).mean((1, 2)) for one in splits])
    noise = 0 * square
    if halves is not None:
        noise = np.array([((a.rest - b.rest) ** 2).mean((1, 2)) / 4 for a, b in zip(*halves)])
    factors = believed(noise, square)
    factors[:, 0], factors[:, MOST_REST + 1 :] = 1.0, 0.0
    return factors


def _turn(shape: np.ndarray, other: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The rotation R [3, 3] with which R shape comes nearest to `other`, both [P, 3] about their middles."""
    left, _, right = np.linalg.svd(np.einsum("p,pi,pj->ij", weights, other, shape))
    sign = np.sign(np.linalg.det(left @ right))
    return left @ np.diag([1.0, 1.0, sign]) @ right
