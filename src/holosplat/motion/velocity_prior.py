"""The prior of velocities: a field that bodies share, chosen by leave-one-out likelihood.

The field is a `Flow`, `v = ∇ × A` of cubic B-splines, which has no divergence. It is one of a few families, of one
cell: uniform, turning, a parabolic profile along the usual velocity, all that is linear and all that is quadratic in
space; each steady, or changing evenly with time. Bodies move with it up to a scatter, which lasts (one is slower than
the fluid at its middle) or passes. Family and scatter are those under which velocities are likeliest as the
other bodies predict them (leave one out), by a distribution with long tails (Student's). So bodies which follow no
field leave the scatter large, one that goes its own way counts little, and the more freedom a family has the more it
must explain. For given paths the likeliest field of a family solves linear equations, so that a fit of paths needs no
other unknowns (variable projection: Golub & Pereyra 1973, SIAM J. Numer. Anal. 10, 413).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from scipy.linalg import null_space
from scipy.optimize import minimize
from scipy.special import gammaln
from torch import Tensor

from ..fit.problem import Batch, LossPart
from ..model import Model
from ..representations import Flow, Lattice, MovingSurfaces, TimeBasis
from .terms import COEFFICIENTS

TAILS = 4.0
"""Degrees of freedom of Student's distribution: few enough that a body five scatters off counts a quarter."""
WIDE = 10.0
"""Standard deviation of each field of a family, over the root mean square of all velocities: any is as likely."""
TURNS, TRIES = 3, 120
"""Turns of what bodies count and of the likeliest scatter, and values of that which are tried in each."""
LEAST, MOST = 1e-3, 10.0
"""Range of scatters, over the spread of velocities."""
BEGUN = ((0.3, 0.3, 0.1), (0.01, 0.01, 0.01))
"""Scatter from which the search begins, the likelier one: along the usual velocity, across it, and of what passes."""
WEISZFELD = 30
"""Steps towards the usual velocity."""
MARGIN = 1.5
"""The box of the field, over that of the paths from which it begins: a fit may move bodies out of that."""
POWERS = np.array([p for n in range(3) for p in product(range(3), repeat=3) if sum(p) == n])
"""[10, 3] powers of the monomials of degree two at most."""


def without_divergence(degree: int) -> np.ndarray:
    """[F, 3, 10], a basis of the polynomial fields of this degree alone that have no divergence."""
    own = np.flatnonzero(POWERS.sum(1) == degree)
    slopes = np.zeros((10, 3, len(own)))
    for axis, (column, power) in product(range(3), enumerate(POWERS[own])):
        if power[axis]:
            row = np.flatnonzero((power - np.eye(3, dtype=int)[axis] == POWERS).all(1))
            slopes[row, axis, column] = power[axis]
    found = np.zeros((null_space(slopes.reshape(10, -1)).shape[1], 3, 10))
    found[:, :, own] = null_space(slopes.reshape(10, -1)).T.reshape(-1, 3, len(own))
    return found


def families() -> dict[str, np.ndarray]:
    """[F, 3, 10] by name, coefficients of the monomials of `POWERS`, where the usual velocity is along x."""
    uniform, linear, quadratic = (without_divergence(degree) for degree in range(3))
    profile = np.zeros((5, 3, 10))
    profile[range(5), 0, np.flatnonzero((POWERS[:, 0] == 0) & (POWERS.sum(1) > 0))] = 1.0
    turning = np.zeros((3, 3, 10))
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        turning[axis, one, _monomial(other)], turning[axis, other, _monomial(one)] = -1.0, 1.0
    more = {"turning": [turning], "profile": [profile], "linear": [linear], "quadratic": [linear, quadratic]}
    return {"uniform": uniform, **{name: np.concatenate([uniform, *parts]) for name, parts in more.items()}}


def _monomial(axis: int) -> int:
    return int(np.flatnonzero((np.eye(3, dtype=int)[axis] == POWERS).all(1))[0])


FAMILIES = families()


@dataclass(frozen=True)
class Expected:
    """The prior of a field, and of bodies in it.

    family: of the field; changes: whether with time; along, across, passing: standard deviations [pixels in the time of
    all frames] of a body's velocity about the field, of what lasts along the usual velocity and across it, and of
    each component of what passes; counts: [B] what bodies count, at most 1.
    """

    family: str
    changes: bool
    along: float
    across: float
    passing: float
    counts: np.ndarray

    def noise(self, direction: np.ndarray, nodes: int) -> np.ndarray:
        """[3 N, 3 N], covariance of velocities about the field at N `nodes`, those of one time side by side."""
        lasts = self.across**2 * np.eye(3) + (self.along**2 - self.across**2) * np.outer(direction, direction)
        return np.kron(np.ones((nodes, nodes)), lasts) + self.passing**2 * np.eye(3 * nodes)


@dataclass(frozen=True)
class Carrier:
    """The fields about the paths of some bodies.

    lattice: of one cell, about `middle` [3] [pixels]; frame: [3, 3], whose rows are the usual velocity's direction and
    two across it; basis: of the paths' time; nodes: [N] s, times at which velocities are compared: as many as these
    have coefficients; wide: standard deviation of each field of a family.
    """

    lattice: Lattice
    middle: np.ndarray
    frame: np.ndarray
    basis: TimeBasis
    nodes: np.ndarray
    wide: float

    @classmethod
    def about(cls, centres: np.ndarray, basis: TimeBasis) -> Carrier:
        """Of bodies whose middles have the coefficients `centres` [K, B, 3] [pixels], K two or more."""
        count = basis.count - 1
        nodes = basis.first + (basis.last - basis.first) * (np.arange(count) + 0.5) / count
        places = np.einsum("nk,kbx->nbx", basis.weights(np.r_[basis.first, nodes, basis.last]), centres).reshape(-1, 3)
        low, high = places.min(0), places.max(0)
        size = MARGIN * max(float((high - low).max()), 1.0)
        speeds = (basis.last - basis.first) * np.einsum("nk,kbx->nbx", basis.weights(nodes, 1), centres)
        frame, wide = np.linalg.svd(_median(speeds.mean(0))[None])[2], WIDE * float(np.sqrt(np.square(speeds).mean()))
        return cls(Lattice.around((size, size, size), 1), 0.5 * (low + high), frame, basis, nodes, max(wide, 1e-9))

    def seen(self, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places [B, N, 3] about the middle and velocities [B, N, 3] [pixels in the time of all frames] of bodies whose
        middles have the coefficients `centres` [K, B, 3]."""
        length = self.basis.last - self.basis.first
        places = np.einsum("nk,kbx->bnx", self.basis.weights(self.nodes), centres) - self.middle
        return places, length * np.einsum("nk,kbx->bnx", self.basis.weights(self.nodes, 1), centres)

    def fields(self, places: np.ndarray, expected: Expected) -> np.ndarray:
        """Basis fields of the family at the nodes `places` [B, N, 3]: [B, 3 N, F], twice as many where it changes."""
        powers = np.prod((places @ self.frame.T / (0.5 * self.lattice.cell / MARGIN))[..., None, :] ** POWERS, axis=-1)
        still = np.einsum("bnm,fcm,cx->bnxf", powers, FAMILIES[expected.family], self.frame)
        later = 2 * (self.nodes - self.basis.first) / (self.basis.last - self.basis.first) - 1
        both = [still, later[:, None, None] * still] if expected.changes else [still]
        return np.concatenate(both, axis=-1).reshape(len(places), 3 * len(self.nodes), -1)

    def likeliest(self, centres: np.ndarray, expected: Expected) -> np.ndarray:
        """Coefficients [F] of the likeliest field for bodies with `centres` [K, B, 3]."""
        places, speeds = self.seen(centres)
        fields = self.fields(places, expected)
        known = np.linalg.inv(expected.noise(self.frame[0], len(self.nodes)))
        weighted = np.einsum("b,bif,ij->bfj", expected.counts, fields, known)
        told = np.einsum("bfj,bjg->fg", weighted, fields) + np.eye(fields.shape[-1]) / self.wide**2
        return np.linalg.solve(told, np.einsum("bfj,bj->f", weighted, speeds.reshape(len(speeds), -1)))

    def flow(self, coefficients: np.ndarray, expected: Expected) -> Flow:
        """The field of `coefficients` [F], which moves by pixels about the middle, as other flows do."""
        parts = coefficients.reshape(2 if expected.changes else 1, -1)
        potentials = np.tensordot(parts, self._potentials(expected.family), axes=1)
        still, change = (potentials[0], potentials[1]) if expected.changes else (potentials[0], 0 * potentials[0])
        basis = TimeBasis(self.basis.first, self.basis.last, 1)
        return Flow(torch.from_numpy(np.stack([still - change, still + change])), self.lattice, basis, basis.first)

    def _potentials(self, family: str) -> np.ndarray:
        """[F, 3, Z, Y, X] of the fields of `family`: cubic splines of one cell hold them all."""
        side = self.lattice.cell * np.linspace(-0.5, 0.5, 5)
        points = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 1, 3)
        steady = Expected(family, False, 0.0, 0.0, 0.0, np.ones(1))
        wanted = replace(self, nodes=self.nodes[:1]).fields(points, steady).reshape(3 * len(points), -1)
        found = np.linalg.lstsq(_velocities(self.lattice, torch.from_numpy(points[:, 0])), wanted, rcond=1e-12)[0]
        return found.T.reshape(-1, 3, *self.lattice.counts)

    def expected(self, centres: np.ndarray) -> Expected:
        """Under which velocities of bodies with `centres` [K, B, 3], two or more, are likeliest."""
        places, speeds = self.seen(centres)
        found = [self._within(one, changes, places, speeds) for one, changes in product(FAMILIES, (False, True))]
        return max(found, key=lambda pair: pair[0])[1]

    def _within(self, family: str, changes: bool, places: np.ndarray, speeds: np.ndarray) -> tuple[float, Expected]:
        """The likeliest scatter about a family, and the logarithm of the likelihood."""
        fields, size = self.fields(places, Expected(family, changes, 0.0, 0.0, 0.0, np.ones(1))), _spread(speeds)
        counts = np.ones(len(speeds))

        def meant(logs: np.ndarray) -> Expected:
            along, across, passing = size * np.exp(np.clip(logs, np.log(LEAST), np.log(MOST)))
            return Expected(family, changes, float(along), float(across), float(passing), counts)

        def likelihood(logs: np.ndarray) -> float:
            return float(_likelihoods(*self.others(meant(logs), fields, speeds)).sum())

        logs = max((np.log(one) for one in BEGUN), key=likelihood)
        for _ in range(TURNS):
            how = {"fatol": 0.01, "maxfev": TRIES}
            logs = minimize(lambda one: -likelihood(one), logs, method="Nelder-Mead", options=how).x
            away, spreads = self.others(meant(logs), fields, speeds)
            counts = np.minimum((TAILS + away.shape[1]) / (TAILS + _squares(away, spreads)), 1.0)
        return likelihood(logs), meant(logs)

    def others(self, expected: Expected, fields: np.ndarray, speeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Differences of each body's velocities [B, 3 N] from the others' prediction, and the covariance of that
        [B, 3 N, 3 N], its own scatter included (Rasmussen & Williams 2006, eq. 5.10 – 5.12, of blocks)."""
        count, each = len(speeds), speeds[0].size
        own, flat = expected.noise(self.frame[0], len(self.nodes)), fields.reshape(count * each, -1)
        covariance = self.wide**2 * flat @ flat.T + np.kron(np.diag(1 / expected.counts), own)
        inverse = np.linalg.inv(covariance)
        spreads = np.linalg.inv(np.stack([inverse[k : k + each, k : k + each] for k in range(0, count * each, each)]))
        away = np.einsum("bij,bj->bi", spreads, (inverse @ speeds.ravel()).reshape(count, each))
        return away, spreads + (1 - 1 / expected.counts)[:, None, None] * own


def _velocities(lattice: Lattice, points: Tensor) -> np.ndarray:
    """[3 P, 3 Z Y X], from coefficients of potentials to velocities at `points` [P, 3]."""
    count = 3 * int(np.prod(lattice.counts))
    still, columns = TimeBasis(0.0, 0.0, 0), list[Tensor]()
    for one in torch.eye(count, dtype=torch.float64):
        flow = Flow(one.reshape(1, 3, *lattice.counts), lattice, still, 0.0)
        columns.append(flow.velocity(points, 0.0).ravel())
    return torch.stack(columns, 1).numpy()


def _median(vectors: np.ndarray) -> np.ndarray:
    """[3] with the least sum of distances from `vectors` [B, 3] (Weiszfeld 1937), which few strays do not turn."""
    found = vectors.mean(0)
    for _ in range(WEISZFELD):
        nearness = 1 / np.maximum(np.linalg.norm(vectors - found, axis=1), 1e-9 + 1e-6 * np.abs(vectors).max())
        found = nearness @ vectors / nearness.sum()
    return found


def _spread(speeds: np.ndarray) -> float:
    """Spread of velocities [B, N, 3] about their mean, with a least one where all are alike."""
    about, whole = (float(np.sqrt(np.square(one).mean())) for one in (speeds - speeds.mean((0, 1)), speeds))
    return max(about, 1e-3 * whole, 1e-9)


def _squares(away: np.ndarray, spreads: np.ndarray) -> np.ndarray:
    """[B] of `away` [B, D] in units of the covariances `spreads` [B, D, D]."""
    return np.einsum("bi,bi->b", away, np.linalg.solve(spreads, away[..., None])[..., 0])


def _likelihoods(away: np.ndarray, spreads: np.ndarray) -> np.ndarray:
    """Logarithms [B] of Student's density of `away` [B, D] at the covariances `spreads` [B, D, D], up to a constant."""
    size = away.shape[1]
    scale = gammaln(0.5 * (TAILS + size)) - gammaln(0.5 * TAILS) - 0.5 * np.linalg.slogdet(spreads)[1]
    return scale - 0.5 * (TAILS + size) * np.log1p(_squares(away, spreads) / TAILS)


class Carried:
    """½ Σ over bodies of |ċ - v(c)|², in units of their scatter, at the nodes; and what the field v costs.

    c is the middle of a body, and v the likeliest field for the paths as they are.
    """

    names = ("carrier",)

    def __init__(self, weight: float, start: MovingSurfaces) -> None:
        """start: two bodies or more on paths of degree one or more, which say what is expected."""
        self._weight, self._middles = weight, torch.from_numpy(middles_of(start))
        centres = self._centres(start.coefficients.detach()).numpy()
        self.carrier = Carrier.about(centres, start.basis)
        self.expected, length = self.carrier.expected(centres), start.basis.last - start.basis.first
        noise = self.expected.noise(self.carrier.frame[0], len(self.carrier.nodes))
        self._known, self._counts = (torch.from_numpy(one) for one in (np.linalg.inv(noise), self.expected.counts))
        weights = (start.basis.weights(self.carrier.nodes), length * start.basis.weights(self.carrier.nodes, 1))
        self._at, self._slope = (torch.from_numpy(one) for one in weights)
        found = {name: getattr(self.expected, name) for name in ("along", "across", "passing")}
        self.resolved = {"carrier": weight, **{f"carrier_{name}_px": value for name, value in found.items()}}

    def _centres(self, paths: Tensor) -> Tensor:
        return torch.einsum("bp,kpx->kbx", self._middles, paths)

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        return [LossPart("carrier", self._weight, self.cost(self._centres(model.parameters()[COEFFICIENTS])))]

    def cost(self, centres: Tensor) -> Tensor:
        """[] of bodies whose middles have the coefficients `centres` [K, B, 3]."""
        coefficients = self.carrier.likeliest(centres.detach().numpy(), self.expected)
        away = torch.stack(list(self._away(centres, self.carrier.flow(coefficients, self.expected))), 1).flatten(1)
        missed = torch.einsum("bi,ij,bj->b", away, self._known, away)
        return 0.5 * ((self._counts * missed).sum() + float(np.square(coefficients / self.carrier.wide).sum()))

    def _away(self, centres: Tensor, flow: Flow) -> Iterator[Tensor]:
        """[B, 3] at each node."""
        for node, at, slope in zip(self.carrier.nodes, self._at, self._slope):
            places, speeds = (torch.einsum("k,kbx->bx", w, centres) for w in (at, slope))
            yield speeds - flow.velocity(places - torch.from_numpy(self.carrier.middle), float(node))


def middles_of(bodies: MovingSurfaces) -> np.ndarray:
    """[B, P], by which the vertices' places make the middles of bodies: means of the surface, by areas at mid-time."""
    middle = 0.5 * (bodies.basis.first + bodies.basis.last)
    corners = bodies.at(middle).vertices.detach()[bodies.faces]
    areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1).numpy()
    found = np.zeros((bodies.count, bodies.coefficients.shape[1]))
    np.add.at(found, (bodies.of_body.numpy()[:, None], bodies.faces.numpy()), areas[:, None])
    return found / found.sum(1, keepdims=True)
