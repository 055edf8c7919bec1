"""Products with slice matrices on the GPU, in float32: the Triton kernel beside this file.

Sums run in a fixed order: results are bitwise the same in every run. Nothing waits for the device.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from ....launch import launching
from . import triton_slices


class Products:
    """Both products with a matrix [M, N]."""

    def __init__(self, entries: Callable[[bool], tuple[Tensor, Tensor, Tensor]], shape: tuple[int, int]) -> None:
        """entries: of the matrix, or transposed: starts of rows (int64), columns (int64), values (float32)."""
        self._forward, self._adjoint = entries(False), entries(True)
        assert (len(self._adjoint[0]) - 1, len(self._forward[0]) - 1) == shape[::-1]

    def project(self, volume: Tensor) -> Tensor:
        """Voxels and slices [N, S] → rays and slices [M, S]."""
        return _product(self._forward, volume)

    def backproject(self, lines: Tensor) -> Tensor:
        """The adjoint: [M, S] → [N, S]."""
        return _product(self._adjoint, lines)


def _product(entries: tuple[Tensor, Tensor, Tensor], dense: Tensor) -> Tensor:
    with launching(dense):
        return triton_slices.product(entries, dense.detach().float().contiguous())
