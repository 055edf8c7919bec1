"""The Triton kernel of `cuda.py`: a sparse matrix times a dense array, gathered row by row without atomics."""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

BLOCK, WARPS = 128, 1
"""Columns of the dense array that a program takes, and its warps."""


def product(entries: tuple[Tensor, Tensor, Tensor], dense: Tensor) -> Tensor:
    """[M, S] of a matrix [M, N] and a dense array [N, S], float32 and contiguous.

    entries: of the matrix: starts of rows (int64), columns (int64) and values (float32).
    """
    rows, count = len(entries[0]) - 1, dense.shape[1]
    out = dense.new_empty(rows, count)
    grid = (rows, triton.cdiv(count, BLOCK))
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
