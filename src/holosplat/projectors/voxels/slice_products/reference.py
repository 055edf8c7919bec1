"""Products with slice matrices in plain torch: its own sparse ones."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from torch import Tensor


class Products:
    """Both products with a matrix [M, N]."""

    def __init__(self, entries: Callable[[bool], tuple[Tensor, Tensor, Tensor]], shape: tuple[int, int]) -> None:
        """entries: of the matrix, or transposed: starts of rows (int64), columns (int64), values (float32)."""
        with warnings.catch_warnings():  # torch calls its CSR support beta
            warnings.simplefilter("ignore")
            self._forward = torch.sparse_csr_tensor(*entries(False), size=shape, check_invariants=False)
            self._adjoint = torch.sparse_csr_tensor(*entries(True), size=shape[::-1], check_invariants=False)

    def project(self, volume: Tensor) -> Tensor:
        """Voxels and slices [N, S] → rays and slices [M, S]."""
        return self._forward @ volume

    def backproject(self, lines: Tensor) -> Tensor:
        """The adjoint: [M, S] → [N, S]."""
        return self._adjoint @ lines
