"""The two-view ambiguity: bodies whose shadows in two beams have the same size and tilt.

Parallel beams along d₁ and d₂ determine the second moments Q of a body up to one number: with N = d₁ d₂ᵀ + d₂ d₁ᵀ, the
shadows of Q + s N have the same moments for every s. Two of these have the same volume: s = 0, and
s = 2 a₁₂/(a₁₁ a₂₂ - a₁₂²), a = dᵢᵀ Q⁻¹ dⱼ (det(1 + s Q⁻¹ N) = (1 + s a₁₂)² - s² a₁₁ a₂₂ is one there). A search that
takes bodies for ellipsoids of a known volume finds the one or the other; finer details of the frames distinguish them.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from ..geometry import Views

ALIKE = 1e-4
"""Largest component of the difference of two directions that are one."""


def two_beams(views: Views) -> np.ndarray | None:
    """[2, 3] the directions of the beams, of either sense; None unless there are two."""
    found = list[np.ndarray]()
    for direction in views.rotations[:, 2]:
        if all(min(np.abs(direction - one).max(), np.abs(direction + one).max()) > ALIKE for one in found):
            found.append(direction)
    return np.array(found) if len(found) == 2 else None


def twin_of(second: np.ndarray, beams: np.ndarray) -> np.ndarray:
    """The second moments [3, 3] of the twin of a body of moments `second`, in their unit; beams: [2, 3]."""
    (a, b), (_, c) = beams @ np.linalg.inv(second) @ beams.T
    shear = np.outer(*beams)
    return second + 2 * b / (a * c - b**2) * (shear + shear.T)


def twin_map(second: np.ndarray, beams: np.ndarray) -> np.ndarray:
    """The matrix T [3, 3] of determinant one that takes a body of second moments `second` [3, 3] to its twin.

    Axes of the ellipsoid become those of the other one, in the order of their lengths, by the smallest turn.
    """
    (values, axes), (lengths, frame) = np.linalg.eigh(second), np.linalg.eigh(twin_of(second, beams))
    signs = [np.array(one) for one in product((1.0, -1.0), repeat=3)]
    turns = [(frame * sign) @ axes.T for sign in signs]
    sign = signs[int(np.argmax([np.trace(turn) if np.linalg.det(turn) > 0 else -np.inf for turn in turns]))]
    return (frame * sign * np.sqrt(lengths / values)) @ axes.T


def distance(second: np.ndarray, beams: np.ndarray) -> float:
    """How far a body of moments `second` [3, 3] is from its twin, over the root mean square of its extent.

    The Wasserstein distance of normal distributions of these moments (Givens & Shortt 1984, Michigan Math. J. 31, 231).
    """
    other, (values, axes) = twin_of(second, beams), np.linalg.eigh(second)
    root = (axes * np.sqrt(values)) @ axes.T
    common = np.sqrt(np.maximum(np.linalg.eigvalsh(root @ other @ root), 0)).sum()
    return float(np.sqrt(max(np.trace(second) + np.trace(other) - 2 * common, 0) / np.trace(second)))


def map_near(second: np.ndarray, beams: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Of all matrices [3, 3] that take a body of moments `second` to its twin, the one nearest to the matrix `near`.

    They are Q'^½ R Q^-½ of any rotation R: that of the polar decomposition of Q'^-½ `near` Q^½.
    """
    (before, less), (after, more) = _roots(second), _roots(twin_of(second, beams))
    left, _, right = np.linalg.svd(more @ near @ before)
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return after @ turn @ less


def _roots(second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The symmetric square root of `second` [3, 3], and its inverse."""
    values, axes = np.linalg.eigh(second)
    return (axes * np.sqrt(values)) @ axes.T, (axes / np.sqrt(values)) @ axes.T
