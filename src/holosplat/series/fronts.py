"""Spherical fronts, such as those of shocks: place, step and speed with their errors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.special import ndtr

from ..checks import require
from ..inference import MARGIN
from ..methods.spherical import ProfileErrors
from ..motion.track_linking import path_degree
from ..volume import Volume

FRONT_COLUMNS = (
    *("number", "time_s", "x_m", "y_m", "z_m", "radius_m", "radius_error_m"),
    *("step_delta", "step_error_delta", "speed_m_s", "speed_error_m_s", "kind"),
)
SHELL, THINNEST, BEHIND, NARROWEST, MOST_FITTED = 0.3, 2.0, 1.5, 0.3, 20_000
"""Half the thickness of the shell in which a front is fitted, as a share of its radius, and in voxels at least; how far
that goes behind it, and the least width of the front [voxels]; voxels of the shell, at most."""
PLACED = 0.08
"""Error of the place of a jump whose values are linear between radii [spacings]: the root mean square over all places
between two radii, of values by least squares."""
DEEPER = 4 / 3
"""How much deeper a second fit goes."""
BETWEEN = 6**-0.5
"""Width of a jump after linear interpolation [spacings]: the standard deviation of a triangle."""


@dataclass(frozen=True)
class Front:
    """A spherical front in a volume. centre: `(x, y, z)` m; radius: [m]; step: mean δ behind it, as deep as `BEHIND`,
    less that before it; errors: [5] standard errors of centre, radius and step"""

    centre: np.ndarray
    radius: float
    step: float
    errors: np.ndarray

    @classmethod
    def of(cls, volume: Volume, told: ProfileErrors | None = None, seed: int = 0) -> Front:
        """The spherical front that runs from the middle of the matter.

        The radial mean shows where; then centre, radius, width, step and level before it are fitted to the voxels of a
        shell by least squares. The shell ends `BEHIND` the front, since δ falls off deeper.

        told: errors of matter that is spherical by construction, and linear between radii, so that the width is known;
        its covariance goes through the slopes of the fitted numbers. Else eighths of the directions left out
        in turn (jackknife) give the errors, since errors of neighbouring voxels go together. That δ falls off behind
        the front shifts the radius by the square of the depth that is fitted. A fit that goes `DEEPER` tells by how
        much (Richardson 1911); that is taken off, and added to the error of the radius, as is what `PLACED` says.
        Errors: `InputError` where nothing is in the volume.
        """
        unit = float(min(volume.grid.voxel_size))
        x, y, z = (axis / unit for axis in volume.grid.axes())
        places = np.stack(np.meshgrid(z, y, x, indexing="ij"), axis=-1).reshape(-1, 3)[:, ::-1]
        highest = float(np.abs(volume.delta).max(initial=1e-30))
        values = volume.delta.ravel() / highest
        require(bool(values.any()), "a front needs matter that changes, but the volume is empty; check the run.")
        centre = np.average(places, axis=0, weights=values**2)
        numbers = np.array([*centre, _jump(places - centre, values), BETWEEN, 0.0])
        random, near, of, widest, falls = np.random.default_rng(seed), places, values, BETWEEN, 0.0
        for deeper in (1.0, 1.0, 1.0, DEEPER):
            widest = BETWEEN * 1.0001 if told else _half_shell(numbers[3]) / 2
            depth = numbers[3] - np.linalg.norm(places - numbers[:3], axis=1)
            behind = deeper * max(BEHIND, 2 * numbers[4])
            shell = np.flatnonzero((depth < behind) & (depth > -_half_shell(numbers[3])))
            chosen = shell if len(shell) <= MOST_FITTED else random.choice(shell, MOST_FITTED, replace=False)
            found = _fitted(places[chosen], values[chosen], numbers, widest)
            if deeper == 1:
                numbers, near, of = found, places[chosen], values[chosen]
        falls = (numbers[3] - found[3]) / (DEEPER**2 - 1)
        if told is None:
            octant = (near > numbers[:3]) @ np.array([1, 2, 4])
            kept = [_fitted(near[octant != k], of[octant != k], numbers, widest) for k in range(8)]
            errors = np.sqrt(7 * np.var(np.array(kept)[:, [0, 1, 2, 3, 5]], axis=0))
        else:
            hats = told.hats(unit * np.linalg.norm(near - numbers[:3], axis=1))
            change = np.linalg.pinv(_slopes(near, of, numbers))[:2] @ hats
            variances = np.einsum("ij,jk,ik->i", change, told.covariance / highest**2, change)
            errors = np.array([*(each / unit for each in told.centre), *np.sqrt(variances)])
        errors[3] = np.hypot(errors[3], PLACED * (told.spacing / unit if told else 1.0))
        errors[3] = np.hypot(errors[3], falls)
        scale = np.array([unit] * 4 + [highest])
        final = (numbers[[0, 1, 2, 3, 5]] + [0, 0, 0, falls, 0]) * scale
        return cls(final[:3], float(final[3]), float(final[4]), errors * scale)

    @property
    def kind(self) -> Literal["compression", "rarefaction"]:
        """Whether δ behind the front is above that before it."""
        return "compression" if self.step > 0 else "rarefaction"


def _jump(places: np.ndarray, values: np.ndarray) -> float:
    """Radius of the jump that explains the largest share of the variance of the radial profile from a shell behind it
    outwards, by least squares of a profile that is even in that shell, and even beyond: a front runs into what is even.

    The profile has means over rings a voxel thick about the middle of `places` [N, 3]; each counts by its voxels. To
    the variance of each counts `MARGIN` of all, below which none matters in practice, such as that of ripple.
    """
    ring = np.linalg.norm(places, axis=1).astype(int)
    last = max(5, int(np.abs(places).max()))  # beyond it directions are missing
    count, total = (np.bincount(ring, weight, last + 1)[: last + 1] for weight in (None, values))
    sums = [np.concatenate([[0.0], np.cumsum(part)]) for part in (count, total, total**2 / np.maximum(count, 1))]

    def uneven(first: np.ndarray | int, end: np.ndarray | int) -> np.ndarray:
        many, all_of, squares = (part[end] - part[first] for part in sums)
        return squares - all_of**2 / np.maximum(many, 1)

    radii, end = np.arange(2, last), last + 1
    behind = radii - int(THINNEST)
    whole = uneven(behind, end)
    explained = whole - uneven(behind, radii) - uneven(radii, end)
    return float(radii[(explained / (whole + MARGIN * uneven(0, end) + 1e-30)).argmax()])


def _half_shell(radius: float) -> float:
    return max(SHELL * radius, THINNEST)


def _design(places: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """What step and level [N, 2] multiply, for centre, radius, width."""
    depth = numbers[3] - np.linalg.norm(places - numbers[:3], axis=1)
    return np.stack([ndtr(depth / numbers[4]), np.ones_like(depth)], axis=1)


def _best(shape: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(shape, values, rcond=None)[0]


def _fitted(places: np.ndarray, values: np.ndarray, start: np.ndarray, widest: float) -> np.ndarray:
    """Centre, radius, width, and step that fit best."""

    def missed(numbers: np.ndarray) -> np.ndarray:
        shape = _design(places, numbers)
        return shape @ _best(shape, values) - values

    reach = np.array([0.5 * start[3]] * 4 + [np.inf])
    low, high = start[:5] - reach, start[:5] + reach
    low[4], high[4] = NARROWEST, widest
    found = least_squares(missed, np.clip(start[:5], low, high), bounds=(low, high)).x
    return np.append(found, _best(_design(places, found), values)[0])


def _slopes(places: np.ndarray, values: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Derivatives [N, 3] of the fitted profile by radius, step and level."""
    shape, nudge = _design(places, numbers), 1e-4 * np.eye(5)[3]
    ends = [_design(places, numbers[:5] + sign * nudge) for sign in (1, -1)]
    return np.concatenate([(ends[0] - ends[1]) @ _best(shape, values)[:, None] / 2e-4, shape], axis=1)


def front_rows(numbers: Sequence[int], times: Sequence[float], fronts: Sequence[Front]) -> Iterable[list[object]]:
    """Rows of `FRONT_COLUMNS`. The speed is that of a polynomial of time through the radii, weighted by their errors,
    of the degree, up to two, that predicts those left out. Its error follows from those of the radii, all larger where
    these scatter more about it (Birge 1932)."""
    radii, when = np.array([front.radius for front in fronts]), np.asarray(times, dtype=np.float64)
    speeds = np.full((len(fronts), 2), np.nan)
    if len(fronts) > 2:
        scaled = (when - when[0]) / (when[-1] - when[0])
        degree = max(1, path_degree(scaled, radii[:, None], 2))
        weights = 1 / np.maximum([front.errors[3] for front in fronts], 1e-9 * radii.max())
        slope = np.stack([k * scaled ** max(k - 1, 0) for k in range(degree, -1, -1)], axis=1) / (when[-1] - when[0])
        design = np.vander(scaled, degree + 1) * weights[:, None]
        inverse = np.linalg.pinv(design)
        left = weights * radii - design @ (inverse @ (weights * radii))
        birge = max(1.0, float(left @ left) / max(len(left) - degree - 1, 1)) ** 0.5
        errors = birge * np.linalg.norm(slope @ inverse, axis=1)
        speeds = np.stack([slope @ (inverse @ (weights * radii)), errors], axis=1)
    for number, time, front, speed in zip(numbers, when, fronts, speeds):
        told = [*front.centre, front.radius, front.errors[3], front.step, front.errors[4], *speed]
        yield [number, f"{time:.9g}", *(f"{value:.6g}" for value in told), front.kind]
