"""Consistency of beams in one plane, row by row: mass, and centre of mass. No volume is needed.

Beams normal to the object's y axis all look through the same slices. Of a slice with mass F and first moment G [2],
each view's row has the mass F and the first moment `n · G`, with n the direction of its columns in the slice (Helgason
1980; Ludwig 1966: the moments of order 0 and 1 of the Radon transform). Of two or three beams there are no other
conditions on what a slice of values of any sign can show: without knowing the matter, this is all that they tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, map_coordinates

from ..geometry import Views
from ..inference import Score
from ..rotations import angles_about_y

COUNT = 6
"""Numbers of each view: shifts x, y [pixels], turns about x, y, z of the lab [rad], as `derivatives.NUMBERS` begins;
and the logarithm of a factor of its masses, beside the mean of all views."""
FACTOR = 5
"""Place of the factor."""
RETRIEVED = 0.05
"""Standard deviation of the factor: masses are retrieved to some per cent."""
BLUR = 1.0
"""Standard deviation of a Gaussian along columns [pixels]: the slopes of rows are differences of neighbours."""
ROUNDS, FIRST = 8, 3
"""Steps, and how many of them find shifts alone, without which turns are nonsense."""
ALIKE = 8
"""Neighbouring rows whose errors may be alike: retrieval spreads them over fringes."""
FLAT = np.deg2rad(0.1)
"""Beams that leave their plane by less [rad] lie in it."""


EVEN = 1e-6
"""Pixel sizes that differ by a smaller share are equal."""


def plane_angles(views: Views) -> np.ndarray | None:
    """Angles [V] [rad] about the object's y axis; None unless all beams are normal to it, see it upright, and
    have pixels of one size."""
    if np.ptp(views.pixel_sizes) > EVEN * views.pixel_sizes.max():
        return None
    if np.abs(views.rotations[:, 1] - np.array([0.0, 1.0, 0.0])).max() > FLAT:
        return None
    return angles_about_y(views.rotations)


@dataclass(frozen=True)
class Rows:
    """Row moments of V images: masses, first and second moments along x, each [V, H]; heights [H] [pixels]."""

    mass: np.ndarray
    first: np.ndarray
    second: np.ndarray
    heights: np.ndarray

    @classmethod
    def of(cls, images: np.ndarray) -> Rows:
        """images: [V, H, W]; moments are about the middle."""
        h, w = images.shape[1:]
        x = np.arange(w) + 0.5 - w / 2
        return cls(images.sum(2), images @ x, images @ x**2, np.arange(h) + 0.5 - h / 2)


@dataclass(frozen=True)
class RowPrior:
    """Prior of the parameters of V views.

    expected: [V, 5] standard deviations about zero of shifts [pixels] and turns [rad]; 0: as they begin
    drifts: [5] of half of what they change by from the first time to the last, likewise
    begin: [2, V, 6] numbers and rates to begin with
    """

    expected: np.ndarray
    drifts: np.ndarray
    begin: np.ndarray

    @classmethod
    def of(cls, expected: np.ndarray, count: int) -> RowPrior:
        """The same [5] for all `count` views, that do not drift, from the plan on."""
        return cls(np.tile(expected, (count, 1)), np.zeros(COUNT - 1), np.zeros((2, count, COUNT)))

    def deviations(self, shifts_alone: bool) -> np.ndarray:
        """[2, V, 6] of numbers and rates; turns are free later than shifts."""
        found = np.zeros((2, len(self.expected), COUNT))
        found[0, :, :FACTOR] = self.expected * ([1, 1, 0, 0, 0] if shifts_alone else 1)
        some = (self.expected > 0).any(axis=1)
        found[0, some, FACTOR] = RETRIEVED
        found[1, some, :FACTOR] = 0.0 if shifts_alone else self.drifts
        return found


@dataclass(frozen=True)
class RowEstimate:
    """Estimates from the rows of V views.

    numbers, rates: [V, 6] of `COUNT`, at the middle of the times, and how much more at their end
    information, rate_information: [V · 6, V · 6] of either, without what is expected
    covariance: [2 · V · 6, 2 · V · 6] of numbers and rates, with it; 0 for those that stay
    before, after: [V] rms of what the view's rows have against being of one object, as a share of all rows' moments
    left: the same after it, a block for `ALIKE` rows of a view at a time, a band for the masses and the first moments
    """

    numbers: np.ndarray
    rates: np.ndarray
    information: np.ndarray
    rate_information: np.ndarray
    covariance: np.ndarray
    before: np.ndarray
    after: np.ndarray
    left: Score


def by_rows(images: np.ndarray, views: Views, prior: RowPrior, when: np.ndarray) -> RowEstimate:
    """The numbers of V views that bring the rows of images [T, V, H, W] (any unit) to agree.

    views: planned, in one plane, lengths in pixels; when: [T] times from -1 to 1. Damped Gauss–Newton steps, as
    `newton.step`; motions in the image's plane are undone in the images, the others are small.
    """
    angles, width, half = plane_angles(views), images.shape[-1], len(views) * COUNT
    assert angles is not None
    weights = (width**-0.5, (12 / width**3) ** 0.5)
    stack = _Stack(gaussian_filter1d(images / images.std(), BLUR, axis=2), views.shifts, angles, weights, when)
    both = prior.begin
    residuals, columns = stack.at(both)
    before = stack.by_view(residuals)
    covariance = np.zeros((both.size, both.size))
    for done in range(ROUNDS if prior.expected.any() else 0):
        deviations = prior.deviations(done < FIRST).reshape(-1)
        free = deviations > 0
        information, noise = columns.T @ columns, _noise(residuals, images.shape[2])
        hessian = information[np.ix_(free, free)] / noise + np.diag(deviations[free] ** -2)
        step = np.zeros(free.size)
        slope = (columns.T @ residuals)[free] / noise - both.reshape(-1)[free] / deviations[free] ** 2
        step[free] = np.linalg.solve(hessian, slope)
        both = both + step.reshape(both.shape)
        both[0, :, FACTOR] -= both[0, :, FACTOR].mean()
        residuals, columns = stack.at(both)
        covariance = np.zeros((both.size, both.size))
        covariance[np.ix_(free, free)] = np.linalg.inv(hessian)
    noise = _noise(residuals, images.shape[2])
    own, moving = (columns[:, part].T @ columns[:, part] / noise for part in (slice(half), slice(half, None)))
    after, left = stack.by_view(residuals), stack.score(residuals)
    return RowEstimate(both[0], both[1], own, moving, covariance, before, after, left)


def _noise(residuals: np.ndarray, height: int) -> float:
    """The variance of residuals [R] of frames of `height` rows, as if rows were independent: by sums of neighbours."""
    size = min(ALIKE, height)
    rows = residuals.reshape(-1, height)[:, : height - height % size]
    sums = rows.reshape(len(rows), -1, size).sum(2)
    return max(float(np.mean(sums**2)) / size, float(np.mean(residuals**2)), 1e-18)


@dataclass(frozen=True)
class _Stack:
    """Images [T, V, H, W] of all times and what their rows have against being of one object."""

    images: np.ndarray
    shifts: np.ndarray
    angles: np.ndarray
    weights: tuple[float, float]
    when: np.ndarray

    def at(self, both: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals [R] and derivatives [R, 2 · V · 6] by numbers and rates, at those [2, V, 6]."""
        residuals, columns = [], []
        for images, when in zip(self.images, self.when):
            numbers = both[0] + when * both[1]
            lit = images * np.exp(-numbers[:, FACTOR])[:, None, None]
            rows = Rows.of(replaced(lit, self.shifts + numbers[:, :2], numbers[:, 4]))
            left, slopes = conditions(rows, self.angles + numbers[:, 3], self.weights)
            residuals.append(left - slopes[:, :, 2] @ numbers[:, 2])
            slopes = slopes.reshape(len(left), -1)
            columns.append(np.concatenate([slopes, when * slopes], axis=1))
        return np.concatenate(residuals), np.concatenate(columns)

    def by_view(self, residuals: np.ndarray) -> np.ndarray:
        """[V] rms of residuals [R], as a share of the rms of all rows' moments, weighed as their conditions are."""
        times, views = self.images.shape[:2]
        rows = [Rows.of(at) for at in self.images]
        moments = [(w * part) ** 2 for r in rows for w, part in zip(self.weights, (r.mass, r.first))]
        return np.sqrt((residuals.reshape(times, 2, views, -1) ** 2).mean((0, 1, 3)) / np.mean(moments))

    def score(self, residuals: np.ndarray) -> Score:
        """Of residuals [R]."""
        times, views, height = self.images.shape[:3]
        size = min(ALIKE, height)
        rows = np.square(residuals.reshape(times, 2, views, height)[..., : height - height % size])
        return Score(rows.reshape(times, 2, views, -1, size).mean(-1).swapaxes(1, 3).reshape(-1, 2))


def replaced(images: np.ndarray, shifts: np.ndarray, rolls: np.ndarray) -> np.ndarray:
    """Images [V, H, W] as detectors without these shifts [V, 2] [pixels] and rolls [V] [rad] would see them."""
    h, w = images.shape[1:]
    y, x = np.meshgrid(np.arange(h) + 0.5 - h / 2, np.arange(w) + 0.5 - w / 2, indexing="ij")
    found = []
    for image, (at_x, at_y), roll in zip(images, shifts, rolls):
        c, s = np.cos(roll), np.sin(roll)
        there = np.stack([s * x + c * y - at_y + h / 2 - 0.5, c * x - s * y - at_x + w / 2 - 0.5])
        found.append(map_coordinates(image, there, order=1))
    return np.array(found)


def conditions(rows: Rows, angles: np.ndarray, weights: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Inconsistency of the rows of beams at `angles` [V] [rad] about y: residuals [R], and how they
    grow [R, V, 6] with the numbers of the views; R = 2 V H, those of masses, then those of first moments, so weighed.

    A turn about x moves mass at depth z along y, one about y along x; the mean depth of a row is that of its slice's
    first moment, the mixed moment of depth and x that of its second. Derivatives are those of the slices that fit all
    views best: so motions of the whole object stay undetermined.
    """
    count, height = rows.mass.shape
    c, s = np.cos(angles), np.sin(angles)
    across, along = np.stack([c, s], axis=1), np.stack([-s, c], axis=1)
    flat = _products(across, across)
    slices = np.linalg.lstsq(across, rows.first, rcond=1e-6)[0]
    tensor = np.linalg.lstsq(flat, rows.second, rcond=1e-6)[0]
    mass, first, second = np.broadcast_to(rows.mass.mean(0), rows.mass.shape), across @ slices, flat @ tensor
    depth, mixed = along @ slices, _products(across, along) @ tensor
    own = np.zeros((2, count, height, COUNT))
    own[0, ..., 1], own[0, ..., 2], own[0, ..., 4] = _slope(mass), _slope(depth), -_slope(first)
    own[1, ..., 0], own[1, ..., 1], own[1, ..., 2] = -mass, _slope(first), _slope(mixed)
    own[1, ..., 3], own[1, ..., 4] = depth, -rows.heights * mass - _slope(second)
    own[0, ..., FACTOR], own[1, ..., FACTOR] = mass, first
    residuals, columns = [], []
    for values, parts, space, weight in zip((rows.mass, rows.first), own, (np.ones((count, 1)), across), weights):
        left = np.eye(count) - space @ np.linalg.pinv(space)
        residuals.append(weight * (left @ values).reshape(-1))
        columns.append(weight * np.einsum("uv,vhk->uhvk", left, parts).reshape(-1, count, COUNT))
    return np.concatenate(residuals), np.concatenate(columns)


def _products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[V, 3] coefficients of a symmetric tensor (xx, xz, zz) in `a · Q b`, of directions [V, 2]."""
    return np.stack([a[:, 0] * b[:, 0], a[:, 0] * b[:, 1] + a[:, 1] * b[:, 0], a[:, 1] * b[:, 1]], axis=1)


def _slope(values: np.ndarray) -> np.ndarray:
    """Central differences along rows [V, H]."""
    return np.gradient(values, axis=1)
