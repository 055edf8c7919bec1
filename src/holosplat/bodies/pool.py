"""Bodies that were tried in a search, of which those are chosen that explain most together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csr_array, vstack

from .poses import Explained, Pose

MOVES, MOST_MOVES = 40, 40_000
"""Changes of the choice that are tried, for each candidate and in all: these take about a second."""
HOT, COLD = 0.5, 1e-3
"""First and last temperature, over what a body is worth in the median."""
LEFT_OUT, PUT_IN = 0.15, 0.1
"""Probability that a body is left out, or put in; else one is put in for another."""
FEW, PART = 8, 4
"""The best of so many that are drawn is put in, or of one in so many, in turns."""


@dataclass
class Pool:
    """Candidates and the shadows they cast.

    What a choice of them leaves of the shadows counts by its square here, so that a table of products says what each
    change of the choice is worth, and thousands are tried in a second: simulated annealing (Kirkpatrick, Gelatt &
    Vecchi 1983, Science 220, 671). Other parts of the field are looked at in other tries; the choice puts the best of
    all together.
    """

    every: Explained
    poses: list[Pose] = field(default_factory=list)
    _rows: list[csr_array] = field(default_factory=list)
    _own: list[float] = field(default_factory=list)

    def add(self, poses: Sequence[Pose]) -> None:
        """Further candidates."""
        for pose in poses:
            self.poses.append(pose)
            self._rows.append(csr_array(self.every.images([pose]).reshape(1, -1).astype(np.float32)))
            self._own.append(self.every.strained([pose]) + float(self.every.hidden([pose])))

    def chosen(self, draws: np.random.Generator) -> list[Pose]:
        """The choice of bodies that explains most together."""
        if not self.poses:
            return []
        images = csr_array(vstack(self._rows))
        products = (images @ images.T).toarray().astype(np.float64) / self.every.noise**2
        gains = images @ self.every.seen.thickness.ravel() / self.every.noise**2
        return [self.poses[k] for k in np.flatnonzero(annealed(products, gains - self._own, draws))]


def annealed(products: np.ndarray, gains: np.ndarray, draws: np.random.Generator) -> np.ndarray:
    """[C] x, true or false, with the least ½ xᵀ G x - gᵀ x that was found, G the products [C, C], g the gains [C]."""
    count, own = len(gains), 0.5 * np.diag(products)
    x, slope, value = np.zeros(count, dtype=bool), -gains, 0.0
    best, least, unit = x.copy(), 0.0, float(np.median(own))
    moves = min(MOST_MOVES, MOVES * count)
    for move in range(moves):
        temperature = unit * (COLD + (HOT - COLD) * (1 - move / moves) ** 2)
        inside, kind = np.flatnonzero(x), draws.random()
        out = int(draws.choice(inside)) if len(inside) and not LEFT_OUT < kind < LEFT_OUT + PUT_IN else None
        change = own[out] - slope[out] if out is not None else 0.0
        into = None
        if kind > LEFT_OUT or out is None:
            drawn = draws.integers(count, size=FEW if move % 2 else count // PART + 1)
            costs = slope[drawn] + own[drawn] - (products[drawn, out] if out is not None else 0.0)
            costs[x[drawn]] = np.inf
            into = int(drawn[costs.argmin()])
            change += float(costs.min())
        if change < 0 or draws.random() < np.exp(-change / temperature):
            for k, sign in ((out, -1.0), (into, 1.0)):
                if k is not None:
                    x[k] = sign > 0
                    slope = slope + sign * products[k]
            value += change
            if value < least:
                best, least = x.copy(), value
    return best
