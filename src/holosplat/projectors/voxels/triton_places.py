"""Places of a block of consecutive voxels, for kernels that give every voxel a lane."""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import triton
import triton.language as tl

BLOCK, WARPS = 256, 8
"""Voxels of a program at a time, and its warps."""


@triton.jit
def places(block, Y, X, BLOCK: tl.constexpr):
    """Places (int64) and z, y, x (z int64) of the `BLOCK` voxels of a number `block`, in a volume of Y × X a slice."""
    first = block.to(tl.int64) * BLOCK  # quotients in 64 bits are slow, so there is one a program, not one a lane
    row = first // X
    lane = tl.arange(0, BLOCK)
    x = (first - row * X).to(tl.int32) + lane
    down = x // X
    z = row // Y
    y = (row - z * Y).to(tl.int32) + down
    deep = y // Y
    return first + lane, z + deep, y - deep * Y, x - down * X
