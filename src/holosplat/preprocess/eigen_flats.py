"""Principal components of flat fields: the changes of the light from frame to frame that exceed noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..checks import require

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
