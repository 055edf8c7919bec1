"""How much cells are deformed: numbers of their nodes [..., P, 3] [m] that neither place nor direction changes."""

from __future__ import annotations

import numpy as np


def gyration_axes(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root-mean-square extents [..., 3] [m] along the principal axes, rising, and these axes [..., 3, 3] (columns)."""
    local = nodes - nodes.mean(axis=-2, keepdims=True)
    values, axes = np.linalg.eigh(np.einsum("...pi,...pj->...ij", local, local) / nodes.shape[-2])
    return np.sqrt(np.maximum(values, 0)), axes


def elongation(nodes: np.ndarray) -> np.ndarray:
    """(longest - middle)/(longest + middle) [...] of the extents: 0 for a cell at rest, towards 1 for a thread."""
    extents, _ = gyration_axes(nodes)
    return (extents[..., 2] - extents[..., 1]) / (extents[..., 2] + extents[..., 1])


def shape_change(nodes: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Root-mean-square distance [...] [m] of nodes from a `reference` [..., P, 3], moved and turned to fit best.

    The rotation is Kabsch's (1976, Acta Cryst. A 32, 922).
    """
    first = nodes - nodes.mean(axis=-2, keepdims=True)
    second = np.broadcast_to(reference - reference.mean(axis=-2, keepdims=True), first.shape)
    left, values, right = np.linalg.svd(np.einsum("...pi,...pj->...ij", first, second))
    values[..., 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))
    squares = (first**2).sum((-2, -1)) + (second**2).sum((-2, -1)) - 2 * values.sum(-1)
    return np.sqrt(np.maximum(squares, 0) / nodes.shape[-2])
