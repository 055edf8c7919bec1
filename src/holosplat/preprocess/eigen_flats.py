"""Changing flat fields: their principal components, and the weights by which a corrected frame varies least."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..checks import require
from ..frames import block_means

ROWS = 64
"""Rows of all flat frames held at once."""
TRACY_WIDOM = (-1.2065, 1.268)
"""Mean and standard deviation of the largest eigenvalue of pure noise, once standardised (Tracy & Widom 1996)."""
OBVIOUS = 4.0
"""An eigenvalue of so many times the median one, and the width of noise's spectrum, needs no test."""
DEVIATIONS = 2.0
"""An eigenvalue counts that exceeds the mean of noise's by so many standard deviations."""


@dataclass(frozen=True)
class EigenFlats:
    """Flat fields as a mean and components: `mean + Σ w_k components_k`, with w of mean 0 and the given deviations.

    mean: [H, W].
    components: [K, H, W], orthogonal, of mean square 1.
    deviations: [K].
    eigenvalues: [F - 1] mean square of each principal component's share in a frame, of which the first K are kept.
    """

    mean: np.ndarray
    components: np.ndarray
    deviations: np.ndarray
    eigenvalues: np.ndarray

    def __len__(self) -> int:
        return len(self.components)

    def light(self, weights: np.ndarray) -> np.ndarray:
        """The flat field [H, W] of `weights` [K]."""
        return self.mean + np.tensordot(weights, self.components, 1)


def eigen_flats(
    rows_of: Callable[[slice], np.ndarray], brightness: np.ndarray, shape: tuple[int, int], most: int | None = None
) -> EigenFlats:
    """Principal components of F flat frames of `shape` (H, W), each scaled to the mean brightness of all.

    `rows_of(rows)` gives [F, R, W]: those rows of all frames, dark-subtracted; it is asked for all rows twice.
    brightness: [F], the frames' means, positive. As many components are kept as `significant` finds, and no more than
    `most`. Van Nieuwenhove et al. (2015), Opt. Express 23, 27975, sect. 2.2.
    """
    require(len(brightness) >= 2, "the components of flat frames need two or more; take plain correction.")
    h, w = shape
    blocks = [slice(start, min(start + ROWS, h)) for start in range(0, h, ROWS)]
    relative = np.asarray(brightness, dtype=np.float64) / np.mean(brightness)
    mean, gram, squares = np.empty(shape), np.zeros((len(relative),) * 2), np.zeros(2)
    for rows in blocks:
        block = rows_of(rows) / relative[:, None, None]
        mean[rows] = block.mean(0)
        centred = (block - mean[rows]).reshape(len(block), -1)
        gram += centred @ centred.T
        variances = (centred**2).sum(0)
        squares += variances.sum(), (variances**2).sum()
    values, vectors = np.linalg.eigh(gram)
    values, vectors = np.clip(values[::-1], 0, None), vectors[:, ::-1]
    # Photon noise of a scaled frame goes as 1/√brightness: made alike before it is compared with white noise.
    whitened = np.linalg.eigvalsh(gram * np.sqrt(np.outer(relative, relative)))[:0:-1]
    kept = significant(np.clip(whitened, 0, None), squares[0] ** 2 / max(squares[1], 1e-300))
    kept = kept if most is None else min(kept, most)
    scale = np.sqrt(values[:kept] / (h * w))  # so that components have the mean square 1
    components = np.empty((kept, h, w))
    for rows in blocks:
        centred = rows_of(rows) / relative[:, None, None] - mean[rows]
        components[:, rows] = np.tensordot((vectors[:, :kept] / scale).T, centred, 1)
    degrees = len(relative) - 1
    return EigenFlats(mean, components, scale / math.sqrt(degrees), values[:-1] / (h * w * degrees))


def significant(eigenvalues: np.ndarray, pixels: float) -> int:
    """How many of the falling `eigenvalues` [F - 1] of centred frames' products stand out of independent noise.

    Parallel analysis (Horn 1965, Psychometrika 30, 179) asks which eigenvalues exceed those of random frames. Drawing
    such frames is not needed: the largest eigenvalue of n pixels of white noise in m frames follows the law of Tracy
    and Widom (Johnstone 2001, Ann. Stat. 29, 295, theorem 1.1). Each eigenvalue is tested against the ones below it.
    `pixels`: the largest possible number of independent pixels; neighbours that share noise (a scintillator) make it
    smaller, and the spread of the lower eigenvalues gives it (as in Patterson et al. 2006, PLoS Genet. 2, e190).
    """
    most = len(eigenvalues) // 2
    wide = OBVIOUS * (1 + math.sqrt(len(eigenvalues) / max(pixels, 1.0))) ** 2 * float(np.median(eigenvalues))
    kept = min(most, int((eigenvalues > wide).sum()))
    while kept < most:
        n = min(pixels, _effective(eigenvalues[kept:]))
        found = next((k for k in range(kept, most) if not _stands_out(eigenvalues[k:], n)), most)
        if found == kept:
            break
        kept = found
    return kept


def _stands_out(eigenvalues: np.ndarray, n: float) -> bool:
    """Whether the first of `eigenvalues` exceeds the largest eigenvalue expected of noise with their sum."""
    m, total = len(eigenvalues), float(eigenvalues.sum())
    if m < 2 or total <= 0:
        return False
    centre = (math.sqrt(n - 1) + math.sqrt(m)) ** 2
    width = (math.sqrt(n - 1) + math.sqrt(m)) * (1 / math.sqrt(n - 1) + 1 / math.sqrt(m)) ** (1 / 3)
    mean, deviation = TRACY_WIDOM
    return bool(eigenvalues[0] > total / (m * n) * (centre + width * (mean + DEVIATIONS * deviation)))


def _effective(eigenvalues: np.ndarray) -> float:
    """The number of independent pixels by the spread of noise's eigenvalues; at least 2.

    Of a Wishart matrix of order m, n degrees of freedom: E tr(G²) = mn (n + m + 1), E tr(G) = mn.
    """
    m, total, squares = len(eigenvalues), float(eigenvalues.sum()), float((eigenvalues**2).sum())
    spread = m * squares - total**2
    return max(2.0, (m + 1) * total**2 / spread) if spread > 0 else math.inf


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
        self.mean = block_means(flats.mean, binning)
        # In units of a standard deviation each, so that all weights are of order one.
        self.components = np.empty((len(flats), *self.mean.shape))
        for k, (deviation, component) in enumerate(zip(flats.deviations, flats.components)):
            self.components[k] = block_means(deviation * component, binning)
        self.deviations = flats.deviations
        self._inverse = np.linalg.pinv(self.components.reshape(len(flats), self.mean.size).T)

    def __call__(self, light: np.ndarray) -> np.ndarray:
        """Weights [K] for a dark-subtracted frame `light` [H, W], to be used with `EigenFlats.light`."""
        frame = block_means(light, self.binning)
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
