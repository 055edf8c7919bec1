"""A forecast as the prior of the frames of its times: a filter, which predicts and is then corrected (Kalman 1960)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..checks import require
from ..fit.problem import Batch
from ..matter import Matter
from ..mesh import TriangleMesh, across, areas, normals
from ..representations import MovingSurfaces, TimeBasis
from .elastic import OfPaths, Rest
from .forecast import SAME_TIME, Forecast, on_paths, places_of


def second_order_field(draws: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """A random smooth field A ξ + B ξ ξ of places ξ [P, 3], whose terms have a mean square of one where |ξ| is one."""
    first, second = (draws.normal(size=size) / 3**0.5 for size in ((3, 3), (3, 3, 3)))
    return lambda xi: xi @ first.T + np.einsum("ijk,pj,pk->pi", second, xi, xi)


def require_reach(forecast: Forecast, times: np.ndarray) -> None:
    """`InputError` for a forecast that does not reach over the `times` [T] s, or has no standard errors."""
    first, last = float(forecast.times[0]), float(forecast.times[-1])
    slack = SAME_TIME * float(np.median(np.diff(times)))
    require(
        bool(first - slack <= times[0] and times[-1] <= last + slack),
        f"the forecast must reach over the times of the frames, {times[0]:.6g} to {times[-1]:.6g} s, but it goes from "
        f"{first:.6g} to {last:.6g} s; give it more --times, or follow fewer by --time-frames.",
    )
    require(
        bool((np.nan_to_num(forecast.band) > 0).all()),
        "the forecast must have standard errors, but it has none; make it with --half-sets, of a run of six times or "
        "more.",
    )


@dataclass(frozen=True)
class Expected:
    """Where a forecast has bodies at the times of frames, and how surely.

    bodies: their triangles, unit and material; times: [T] s; places: of each body [T, P, 3] m; band: [T, B] m, standard
    error of each surface along its normals (rms over it), which is taken to be one number at a time;
    rest: their shape at rest in this unit, None where it is not known
    """

    bodies: MovingSurfaces
    times: np.ndarray
    places: Sequence[np.ndarray]
    band: np.ndarray
    rest: Rest | None = None

    @classmethod
    def of(cls, forecast: Forecast, times: np.ndarray, unit: float, matter: Matter) -> Expected:
        """At the `times` [T] s of frames; unit: their pixel size [m]. Errors: those of `require_reach`."""
        require_reach(forecast, times)
        first, last = float(forecast.times[0]), float(forecast.times[-1])
        within = np.clip(times, first, last)
        band = np.stack([np.interp(within, forecast.times, one) for one in forecast.band.T], axis=1)
        there = forecast.bodies
        bodies = MovingSurfaces(
            *(there.coefficients.detach() * (there.unit_length / unit), there.faces, there.of_body, there.basis),
            *(unit, matter, there.lines),
        )
        rest = forecast.rest
        if rest is not None and unit != there.unit_length:
            mesh = rest.elastic.membrane.mesh
            rest = Rest.of(replace(mesh, vertices=there.unit_length * mesh.vertices), rest.stiffness, unit)
        return cls(bodies, times, places_of(bodies, within), band, rest)

    @property
    def count(self) -> int:
        """Number of bodies, which are the first ones of a fit."""
        return self.bodies.count

    def on(self, basis: TimeBasis) -> MovingSurfaces:
        """The bodies on paths of a basis."""
        return on_paths(self.bodies, self.times, list(self.places), basis)

    def astray(self, bodies: MovingSurfaces, seed: int, side: int) -> tuple[Expected, MovingSurfaces]:
        """The prior of one half of the frames (side 1, or -1), and what the fit of that half begins with.

        It has half the information, about places that are one standard error off to that side, by a random field of
        second order; `bodies` begin as far off. So half the difference of the halves has the variance 1/(p + 1/s²) of
        frames of information p and a forecast of standard error s: the forecast's own where p is 0.
        """
        draws, places, begun = np.random.default_rng([seed, 2]), list(self.places), places_of(bodies, self.times)
        for k, (own, error) in enumerate(zip(self.places, self.band.T)):
            off = side * _away(own, self.bodies.body(k)[1].numpy(), error, draws)
            places[k], begun[k] = own + off, begun[k] + off
        return replace(self, places=places, band=2**0.5 * self.band), on_paths(bodies, self.times, begun, bodies.basis)

    def deviation(self, found: MovingSurfaces) -> float:
        """Distance along normals of the first of `found` bodies from their places (rms over bodies and times), in the
        forecast's standard errors: about one or less where these are right."""
        faces = (self.bodies.body(k)[1].numpy() for k in range(self.count))
        pairs = zip(self.places, places_of(found, self.times), faces)
        away = np.stack([across(one, other, own) for one, other, own in pairs], axis=1)
        return float(np.square(away / self.band).mean() ** 0.5)


def _away(places: np.ndarray, faces: np.ndarray, error: np.ndarray, draws: np.random.Generator) -> np.ndarray:
    """[T, P, 3] m: a random field of second order about a body's middle, of an rms `error` [T] m along its normals."""
    field, found = second_order_field(draws), list[np.ndarray]()
    for place, size in zip(places, error):
        mesh, shape = TriangleMesh(place, faces), place - place.mean(0)
        away = field(shape / np.sqrt(np.square(shape).sum(1).mean()))
        along = np.average((away * normals(mesh)).sum(1) ** 2, weights=areas(mesh)) ** 0.5
        found.append(size / along * away)
    return np.array(found)


class NearExpected(OfPaths):
    """Σ over bodies of the mean over times of (d/s)², d the distance along normals from where a forecast has a body
    (rms over its surface), and s the standard error of that: of bodies beside its own, nothing."""

    def __init__(self, weight: float, expected: Expected, basis: TimeBasis) -> None:
        """basis: of the paths, in pixels."""
        super().__init__("forecast", weight)
        unit, shares = expected.bodies.unit_length, list[np.ndarray]()
        normal, faces = list[np.ndarray](), [expected.bodies.body(k)[1].numpy() for k in range(expected.count)]
        for k, own in enumerate(expected.places):
            meshes = [TriangleMesh(place, faces[k]) for place in own]
            normal.append(np.stack([normals(mesh) for mesh in meshes]))
            parts = np.stack([areas(mesh) / areas(mesh).sum() for mesh in meshes])
            shares.append(parts * (unit / expected.band[:, k, None]) ** 2 / len(expected.times))

        def together(parts: list[np.ndarray]) -> Tensor:
            return torch.from_numpy(np.concatenate(parts, axis=1))

        self._normals, self._shares = together(normal), together(shares)
        self._along = (self._normals * together([own / unit for own in expected.places])).sum(2)
        self._weights = torch.from_numpy(basis.weights(expected.times))

    def value(self, paths: Tensor, batch: Batch) -> Tensor:
        """As the class says."""
        count = self._normals.shape[1]
        places = torch.einsum("tk,kpx->tpx", self._weights, paths[:, :count])
        away = (self._normals * places).sum(2) - self._along
        return (self._shares * away.square()).sum()
