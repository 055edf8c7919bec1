"""Products with slice matrices by the compiled kernels, float32 in main memory."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from .... import native


class Products:
    """Both products with a matrix [M, N], of whose transpose alone the entries are asked for."""

    def __init__(self, entries: Callable[[bool], tuple[Tensor, Tensor, Tensor]], shape: tuple[int, int]) -> None:
        """entries: of the matrix, or transposed: starts of rows (int64), columns (int64), values (float32)."""
        self._adjoint, self._shape = entries(True), shape

    def project(self, volume: Tensor) -> Tensor:
        """Voxels and slices [N, S] → rays and slices [M, S]."""
        return self._call("holosplat_slices_project", volume, self._shape[0])

    def backproject(self, lines: Tensor) -> Tensor:
        """The adjoint: [M, S] → [N, S]."""
        return self._call("holosplat_slices_backproject", lines, self._shape[1])

    def _call(self, function: str, source: Tensor, rows: int) -> Tensor:
        source = source.detach().float().contiguous()
        found, sizes = torch.empty(rows, source.shape[1]), (*reversed(self._shape), source.shape[1])
        matrix = native.Slices(*sizes, *(array.data_ptr() for array in self._adjoint))
        pointers = [native.c_void_p(array.data_ptr()) for array in (source, found)]
        native.call(function, matrix, *pointers, torch.get_num_threads())
        return found
