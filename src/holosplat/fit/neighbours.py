"""Sparse matrices of neighbours on any device: products, and the membrane's equation solved by products alone."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from scipy.sparse import csr_array, diags_array
from torch import Tensor


class Neighbours:
    """A sparse matrix [P, Q] float64 as lists of equal length: every row's columns and weights, padded with zeros.

    On a device where rows are short and alike in length, as of neighbours on a mesh.
    """

    def __init__(self, matrix: csr_array, on: torch.device) -> None:
        """on: where it multiplies."""
        counts = np.diff(matrix.indptr)
        there = np.arange(counts.max(initial=0)) < counts[:, None]
        columns, weights = np.zeros(there.shape, dtype=np.int64), np.zeros(there.shape)
        columns[there], weights[there] = matrix.indices, matrix.data
        self._columns, self._weights = torch.from_numpy(columns).to(on), torch.from_numpy(weights).to(on)

    def __matmul__(self, x: Tensor) -> Tensor:
        """The product [P, C] with x [Q, C] float64 on the same device; nothing waits for it."""
        found = x.index_select(0, self._columns.flatten()).reshape(*self._columns.shape, x.shape[1])
        return (self._weights[..., None] * found).sum(1)


def membrane_inverse(
    edges: csr_array, stiffness: float, on: torch.device, error: float = 1e-9
) -> Callable[[Tensor], Tensor]:
    """The inverse of 1 + λΔ, Δ = D - W, for x [P, C] float64 on a device, by a fixed number of products.

    edges: W [P, P], symmetric, not negative; D: its rows' sums; stiffness: λ; error: of what is found, relative, in the
    norm of the diagonal M = 1 + λD.

    Chebyshev's iteration (Saad 2003, "Iterative Methods for Sparse Linear Systems", section 12.3) with the
    preconditioner M: the eigenvalues of λ M⁻¹W lie between -ρ and ρ = 1 - 1/(1 + λ d), d the largest in D, so that
    those of M⁻¹(1 + λΔ) lie around 1, and n steps leave less than 1/T_n(1/ρ) of the error, T_n Chebyshev's polynomial.
    """
    sums = edges.sum(1)
    diagonal = 1 + stiffness * sums
    reach = 1 - 1 / float(diagonal.max())
    step = Neighbours(csr_array(diags_array(stiffness / diagonal) @ edges), on)
    inverse = torch.from_numpy(1 / diagonal).to(on)[:, None]
    weights = _weights(reach, math.ceil(math.acosh(1 / error) / math.acosh(1 / reach)) if reach > 0 else 1)

    def solve(x: Tensor) -> Tensor:
        start = inverse * x
        before, found = torch.zeros_like(start), start
        for weight in weights:
            before, found = found, torch.lerp(before, torch.add(start, step @ found), weight)
        return found

    return solve


def _weights(reach: float, steps: int) -> list[float]:
    """What each step but the first, which is Jacobi's, takes of Jacobi's next one; the rest is that before the last."""
    found, last = list[float](), 2.0
    for _ in range(steps - 1):
        last = 1 / (1 - 0.25 * reach**2 * last)
        found.append(last)
    return found
