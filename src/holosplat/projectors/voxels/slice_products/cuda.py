"""Products with slice matrices on the GPU, in float32: a sparse matrix times a dense array, gathered row by row.

Sums run in a fixed order: results are bitwise the same in every run. Nothing waits for the device.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

from collections.abc import Callable

import triton
import triton.language as tl
from torch import Tensor

from ....launch import launching

BLOCK, WARPS = 128, 1
"""Columns of the dense array that a program takes, and its warps."""


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
    """[M, S] of a matrix [M, N] and a dense array [N, S].

    entries: of the matrix: starts of rows (int64), columns (int64) and values (float32).
    """
    dense = dense.detach().float().contiguous()
    rows, count = len(entries[0]) - 1, dense.shape[1]
    out = dense.new_empty(rows, count)
    grid = (rows, triton.cdiv(count, BLOCK))
    with launching(dense):
        _multiply[grid](*entries, dense, out, count, BLOCK, num_warps=WARPS)
    return out


@triton.jit(do_not_specialize=["S"])
def _multiply(starts, columns, values, dense, out, S, BLOCK: tl.constexpr):
    row = tl.program_id(0).to(tl.int64)
    s = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    there = s < S
    sum = tl.zeros((BLOCK,), tl.float32)
    for k in range(tl.load(starts + row), tl.load(starts + row + 1)):
        sum += tl.load(values + k) * tl.load(dense + tl.load(columns + k) * S + s, mask=there, other=0.0)
    tl.store(out + row * S + s, sum, mask=there)
