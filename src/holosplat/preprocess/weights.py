"""The flat field of one frame: the weights of its components by which the corrected frame varies least."""

from __future__ import annotations

import numpy as np

from ..checks import require
from .eigen_flats import EigenFlats

FAINTEST = 0.02
"""A flat field is not let fall below this part of the mean one."""
REACH = 6.0
"""Bound of the weights, in standard deviations of the weights of the flat frames."""
ITERATIONS = 200
BINNINGS, SAMPLES = (8, 4, 2), 6
"""Binning, where none is asked for: the coarsest that leaves so many samples for each weight."""


class TotalVariationWeights:
    """Finds the weights of eigen flat fields for one frame after another.

    After Van Nieuwenhove et al. (2015), Opt. Express 23, 27975, sect. 2.3: the weights minimise the total variation of
    the frame divided by its flat field, both averaged over `binning × binning` pixels so that noise weighs less. The
    total variation is taken of the quotient's logarithm: the total variation of the quotient itself favours a flat
    field that is bright at the object, and with strong fringes it prefers that flat field to the true one.
    """

    def __init__(self, flats: EigenFlats, binning: int | None = None) -> None:
        area = flats.mean.size / (SAMPLES * max(len(flats), 1))
        if binning is None:
            binning = next((b for b in BINNINGS if b**2 <= area and 2 * b <= min(flats.mean.shape)), 1)
        require(binning >= 1, f"binning must be at least 1, but it is {binning}.")
        fits = min(flats.mean.shape) >= 2 * binning
        require(fits, f"binning must leave at least 2 × 2 pixels of {flats.mean.shape}, but it is {binning}.")
        self.binning = binning
        self.mean = _binned(flats.mean, binning)
        # In units of a standard deviation each, so that all weights are of order one.
        self.components = np.empty((len(flats), *self.mean.shape))
        for k, (deviation, component) in enumerate(zip(flats.deviations, flats.components)):
            self.components[k] = _binned(deviation * component, binning)
        self.deviations = flats.deviations
        self._inverse = np.linalg.pinv(self.components.reshape(len(flats), self.mean.size).T)

    def __call__(self, light: np.ndarray) -> np.ndarray:
        """Weights [K] for a dark-subtracted frame `light` [H, W], to be used with `EigenFlats.light`."""
        frame = _binned(light, self.binning)
        frame = np.maximum(frame, FAINTEST * frame.mean())
        if len(self.components) == 0:
            return np.zeros(0)
        from scipy.optimize import minimize  # which takes long to load

        start = np.clip(self._projected(frame), -REACH, REACH)
        edge = float(np.median(_slopes(self._logarithm(frame, start)[0])[2])) + 1e-12
        bounds = [(-REACH, REACH)] * len(start)
        found = minimize(
            lambda w: self._variation(frame, w, edge),
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": ITERATIONS},
        )
        return found.x * self.deviations

    def _projected(self, frame: np.ndarray) -> np.ndarray:
        """Least-squares weights of the frame itself, as if it held no object: where the search begins."""
        scaled = frame * (self.mean.sum() / frame.sum())
        return self._inverse @ (scaled - self.mean).reshape(-1)

    def _logarithm(self, frame: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The logarithm [h, w] of the corrected frame, and its derivative by the flat field's logarithm's argument."""
        light = self.mean + np.tensordot(weights, self.components, 1)
        free = light > FAINTEST * self.mean
        light = np.where(free, light, FAINTEST * self.mean)
        return np.log(frame / light), -1.0 * free / light

    def _variation(self, frame: np.ndarray, weights: np.ndarray, edge: float) -> tuple[float, np.ndarray]:
        """Total variation Σ √(|∇q|² + edge²) of the logarithm q, and its gradient by the weights [K]."""
        quotient, by_light = self._logarithm(frame, weights)
        down, right, slope = _slopes(quotient, edge)
        pull = np.zeros_like(quotient)  # the adjoint of forward differences, on ∇q/|∇q|
        for along, axis in ((down / slope, 0), (right / slope, 1)):
            pull += np.roll(along, 1, axis) - along
        return float(slope.sum()), np.tensordot(self.components, pull * by_light, 2)


def _slopes(image: np.ndarray, edge: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Forward differences of `image` [h, w] down and to the right (0 at the last), and √(|∇|² + edge²)."""
    down = np.diff(image, axis=0, append=image[-1:])
    right = np.diff(image, axis=1, append=image[:, -1:])
    return down, right, np.sqrt(down**2 + right**2 + edge**2)


def _binned(image: np.ndarray, factor: int) -> np.ndarray:
    """Means over `factor × factor` pixels; rows and columns that do not fill one are cut."""
    h, w = (n // factor for n in image.shape)
    return image[: h * factor, : w * factor].reshape(h, factor, w, factor).mean((1, 3))
