"""A velocity field that has no divergence by construction, and where it carries points and the matter around them; and
paths through time: one basis of B-splines that all nodes share.

The velocity is the curl of a vector potential, `v = ∇ × A`, whose components are cubic B-splines of space and splines
of time. The divergence of a curl is zero whatever the coefficients, so that volumes are kept. Where gas is
lost, as in a foam, a second potential may join, `v = ∇ × A + ∇φ`, whose divergence `Δφ` a fit makes small.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from ..checks import InputError, require
from .gaussians import raw_of

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


LEVI_CIVITA = ((0, 2, 1, 1.0), (0, 1, 2, -1.0), (1, 0, 2, 1.0), (1, 2, 0, -1.0), (2, 1, 0, 1.0), (2, 0, 1, -1.0))
"""(component of v, component of A, direction of the derivative, sign) of a curl."""


@dataclass(frozen=True)
class Lattice:
    """The lattice of the coefficients of a flow.

    counts: nodes along z, y and x; cell: their distance; first: `(x, y, z)` of the first node; both in the flow's unit
    of length. Two cells beyond the outermost nodes, the flow stands still.
    """

    counts: tuple[int, int, int]
    cell: float
    first: tuple[float, float, float]

    @classmethod
    def around(cls, extents: tuple[float, float, float], cells: int) -> Lattice:
        """A lattice about the origin over a box of `extents` x, y, z, its longest edge in `cells` cells, and one more
        on every side."""
        cell = max(extents) / cells
        x, y, z = (max(1, math.ceil(e / cell - 1e-6)) + 3 for e in extents)
        return cls((z, y, x), cell, (0.5 * cell * (1 - x), 0.5 * cell * (1 - y), 0.5 * cell * (1 - z)))

    def nodes(self) -> Tensor:
        """All nodes [P, 3] `(x, y, z)`, float64."""
        axes = [f + self.cell * torch.arange(n, dtype=torch.float64) for f, n in zip(self.first, self.counts[::-1])]
        x, y, z = torch.meshgrid(*axes, indexing="ij")
        return torch.stack([x, y, z], -1).reshape(-1, 3)

    def weights(self, points: Tensor, axis: int, derivatives: int) -> list[Tensor]:
        """Cubic B-splines [P, n] along `axis` (0 is x) at `points` [P, 3], and their first `derivatives`."""
        count = self.counts[2 - axis]
        places = torch.arange(count, dtype=points.dtype, device=points.device)
        away = (points[:, axis, None] - self.first[axis]) / self.cell - places
        return self.splines(away, derivatives)

    def splines(self, away: Tensor, derivatives: int) -> list[Tensor]:
        """A cubic B-spline `away` cells from its node, and its first `derivatives`."""
        size, sign = away.abs(), away.sign()
        outer, inner = (2 - size).clamp_min(0), (1 - size).clamp_min(0)
        found = [(outer**3 - 4 * inner**3) / 6]
        if derivatives > 0:
            found.append(-sign * (outer**2 - 4 * inner**2) / (2 * self.cell))
        if derivatives > 1:
            found.append((outer - 4 * inner) / self.cell**2)
        return found


@dataclass(frozen=True)
class Flow:
    """A flow from the time `reference` [s] on, forwards and backwards.

    potential: [K, 3, Z, Y, X] coefficients of A in the basis of time, `(x, y, z)`, in unit² per length of the basis;
    lattice: where they lie; basis: of time; reference: the time [s] at which nothing has moved; steps: of the fourth
    order of Runge and Kutta over the length of the basis; sources: [K, Z, Y, X] of φ, or None. Errors: `InputError`
    where the arrays do not fit.
    """

    potential: Tensor
    lattice: Lattice
    basis: TimeBasis
    reference: float
    steps: int = 8
    sources: Tensor | None = None

    def __post_init__(self) -> None:
        wanted = (self.basis.count, 3, *self.lattice.counts)
        require(
            tuple(self.potential.shape) == wanted,
            f"the potential of a flow must have the shape {wanted}, but it has {tuple(self.potential.shape)}.",
        )
        fits = self.sources is None or tuple(self.sources.shape) == (wanted[0], *wanted[2:])
        require(fits, f"sources of a flow must have the shape {(wanted[0], *wanted[2:])}.")
        require(self.steps >= 1, f"a flow needs at least one step, but has {self.steps}.")

    @classmethod
    def still(cls, lattice: Lattice, basis: TimeBasis, reference: float, steps: int = 8, sources: bool = False) -> Flow:
        """A flow that stands still, float32."""
        potential = torch.zeros(basis.count, 3, *lattice.counts)
        return cls(potential, lattice, basis, reference, steps, potential[:, 0].clone() if sources else None)

    def parameters(self) -> dict[str, Tensor]:
        """The trainable tensors, by name."""
        sources = {} if self.sources is None else {"sources": self.sources}
        return {"potential": self.potential, **sources}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Flow:
        """The same lattice and basis with other coefficients."""
        potential = parameters.get("potential", self.potential)
        return replace(self, potential=potential, sources=parameters.get("sources", self.sources))

    def velocity(self, points: Tensor, time: float) -> Tensor:
        """v [P, 3] at `points` [P, 3] at `time` [s], in units of length per length of the basis."""
        return self._moving(points, time, False)[0]

    def gradient(self, points: Tensor, time: float) -> Tensor:
        """∂vᵢ/∂xⱼ [P, 3, 3] at `points` [P, 3] at `time` [s]."""
        found = self._moving(points, time, True)[1]
        assert found is not None
        return found

    def carried(self, points: Tensor, start: float, end: float) -> Tensor:
        """Carry `points` [P, 3] from the time `start` [s] to the time `end`, before or after."""
        return self._integrated(points, start, end, False)[0]

    def carried_with_jacobian(self, points: Tensor, start: float, end: float) -> tuple[Tensor, Tensor]:
        """See `carried`, and ∂xᵢ(end)/∂xⱼ(start) [P, 3, 3]: how the flow turns and stretches what is around them."""
        found = self._integrated(points, start, end, True)
        assert found[1] is not None
        return found[0], found[1]

    def _integrated(self, points: Tensor, start: float, end: float, jacobian: bool) -> tuple[Tensor, Tensor | None]:
        length = self.basis.last - self.basis.first
        part = (end - start) / length if length > 0 else 0.0
        count = math.ceil(abs(part) * self.steps - 1e-9)
        turned = torch.eye(3).to(points).expand(len(points), 3, 3) if jacobian else None
        for k in range(count):
            at, h = start + (end - start) * k / count, part / count
            points, turned = self._step(points, turned, at, h, length)
        return points, turned

    def _step(self, x: Tensor, f: Tensor | None, time: float, h: float, length: float) -> tuple[Tensor, Tensor | None]:
        """One step of Runge and Kutta of `h` lengths of the basis, of points and of their Jacobian."""

        def slope(part: float, before: tuple[Tensor, Tensor | None] | None) -> tuple[Tensor, Tensor | None]:
            at = x if before is None else x + part * h * before[0]
            v, g = self._moving(at, time + part * h * length, f is not None)
            if f is None or g is None:
                return v, None
            own = f if before is None or before[1] is None else f + part * h * before[1]
            return v, g @ own

        first = slope(0.0, None)
        second = slope(0.5, first)
        third = slope(0.5, second)
        fourth = slope(1.0, third)
        every = (first, second, third, fourth)
        moved = x + h / 6 * sum((w * s[0] for w, s in zip((2, 2, 1), every[1:])), start=every[0][0])
        if f is None:
            return moved, None
        slopes = [s[1] for s in every if s[1] is not None]
        return moved, f + h / 6 * sum((w * s for w, s in zip((2, 2, 1), slopes[1:])), start=slopes[0])

    def _moving(self, points: Tensor, time: float, gradient: bool) -> tuple[Tensor, Tensor | None]:
        weights = torch.from_numpy(self.basis.weights(time)[0]).to(points)
        fields = self.potential if self.sources is None else torch.cat([self.potential, self.sources[:, None]], 1)
        now = torch.einsum("k,kczyx->czyx", weights, fields.to(points))
        slopes, curved = _derivatives(self.lattice, now, points, gradient)
        v = _curl(slopes)
        g = None if curved is None else torch.stack([_curl(curved[..., j]) for j in range(3)], -1)
        if self.sources is None:
            return v, g
        return v + slopes[:, 3], None if g is None or curved is None else g + curved[:, 3]

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same flow of."""
        place = {"counts": list(self.lattice.counts), "cell": self.lattice.cell, "first": list(self.lattice.first)}
        plain = {"lattice": place, "basis": self.basis.as_dict(), "reference_s": self.reference, "steps": self.steps}
        return {**self.parameters(), **plain}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Flow:
        """The flow that `state` described."""
        place = state["lattice"]
        z, y, x = (int(n) for n in place["counts"])
        a, b, c = (float(v) for v in place["first"])
        lattice, basis = Lattice((z, y, x), float(place["cell"]), (a, b, c)), TimeBasis.from_dict(state["basis"])
        reference, steps = float(state["reference_s"]), int(state["steps"])
        return cls(state["potential"], lattice, basis, reference, steps, state.get("sources"))


def _curl(slopes: Tensor) -> Tensor:
    """∇ × A [P, 3] of ∂A_c/∂x_j [P, C, 3]."""
    parts: list[list[Tensor]] = [[], [], []]
    for component, of, along, sign in LEVI_CIVITA:
        parts[component].append(sign * slopes[:, of, along])
    return torch.stack([a + b for a, b in parts], -1)


def _derivatives(lattice: Lattice, fields: Tensor, points: Tensor, second: bool) -> tuple[Tensor, Tensor | None]:
    """∂/∂x_j [P, C, 3] and, if asked for, ∂²/∂x_i∂x_j [P, C, 3, 3] of C `fields` [C, Z, Y, X] at `points` [P, 3]."""
    most = 2 if second else 1
    x, y, z = (lattice.weights(points, axis, most) for axis in range(3))
    c, nz, ny, nx = fields.shape
    sheets = fields.permute(1, 0, 2, 3).reshape(nz, c * ny * nx)
    found: dict[tuple[int, int, int], Tensor] = {}
    for k in range(most + 1):
        planes = (z[k] @ sheets).reshape(len(points), c, ny, nx)
        for j in range(most + 1 - k):
            rows = torch.einsum("pcyx,py->pcx", planes, y[j])
            for i in (most - k - j,) if not second else range(most + 1 - k - j):
                if 1 <= i + j + k <= most:
                    found[i, j, k] = torch.einsum("pcx,px->pc", rows, x[i])
    slopes = torch.stack([found[1, 0, 0], found[0, 1, 0], found[0, 0, 1]], -1)
    if not second:
        return slopes, None
    mixed = {(0, 1): found[1, 1, 0], (0, 2): found[1, 0, 1], (1, 2): found[0, 1, 1]}
    pure = [found[2, 0, 0], found[0, 2, 0], found[0, 0, 2]]
    rows = [[pure[a] if a == b else mixed[min(a, b), max(a, b)] for b in range(3)] for a in range(3)]
    return slopes, torch.stack([torch.stack(row, -1) for row in rows], -2)


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
        first, last = (raw_of(amplitudes * fading_factor(g, s)) - now for s in ends)
        curved = (first / a - last / b) / (a - b)
        return torch.stack([first / a - a * curved, curved])

    def _weights(self, places: Tensor, axis: int) -> Tensor:
        points = places.new_zeros(len(places), 3)
        points[:, axis] = places
        return self.lattice.weights(points, axis, 0)[0]


def fading_factor(values: Tensor, later: float) -> Tensor:
    """The factors exp(s g₁ + s² g₂) [...] of g₁ and g₂ `values` [2, ...] at s = `later`."""
    return (later * values[0] + later**2 * values[1]).exp()
