"""Adam on the GPU: one Triton launch for every four arrays."""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from ...launch import launching

BLOCK = 1024
MOST = 4
"""Arrays of one launch."""


def step(
    parameters: list[Tensor], gradients: list[Tensor], first: list[Tensor], second: list[Tensor], factors: Tensor
) -> None:
    """One step of Adam on K float32 arrays, in place; arguments as the package's `step`, already checked.

    `parameter -= factors[k] · first / (√second + factors[-1])`, after `first` and `second` have moved towards the
    gradient (by 0.1) and its square (by 0.001). factors: float32, on the device; nothing waits for it.
    """
    arrays = list(zip(parameters, [g.contiguous() for g in gradients], first, second))
    with launching(factors):
        for start in range(0, len(arrays), MOST):
            _launch(arrays[start : start + MOST], factors[start:])


def _launch(arrays: list[tuple[Tensor, ...]], factors: Tensor) -> None:
    """One launch for up to `MOST` arrays, whose factors come first; the last of all is the divisor's."""
    sizes = [parameter.numel() for parameter, *_ in arrays] + [0] * (MOST - len(arrays))
    arrays = arrays + [arrays[0]] * (MOST - len(arrays))  # no program reads those
    ends = [sum(triton.cdiv(n, BLOCK) for n in sizes[: k + 1]) for k in range(MOST)]
    if ends[-1]:
        pointers = [array for group in arrays for array in group]
        _step[(ends[-1],)](*pointers, factors, factors.numel() - 1, *sizes, *ends[:-1], BLOCK, num_warps=4)


@triton.jit
def _move(parameter, gradient, first, second, rate, epsilon, block, count, BLOCK: tl.constexpr):
    at = block.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = at < count
    g = tl.load(gradient + at, mask=inside, other=0.0)
    m = tl.load(first + at, mask=inside, other=0.0)
    v = tl.load(second + at, mask=inside, other=0.0)
    m += 0.1 * (g - m)
    v += 0.001 * (g * g - v)
    tl.store(first + at, m, mask=inside)
    tl.store(second + at, v, mask=inside)
    p = tl.load(parameter + at, mask=inside, other=0.0)
    tl.store(parameter + at, p - rate * m / (tl.sqrt(v) + epsilon), mask=inside)


@triton.jit(do_not_specialize=["LAST", "n0", "n1", "n2", "n3", "end0", "end1", "end2"])
def _step(
    p0, g0, m0, v0, p1, g1, m1, v1, p2, g2, m2, v2, p3, g3, m3, v3, factors, LAST,
    n0, n1, n2, n3, end0, end1, end2, BLOCK: tl.constexpr,
):  # fmt: skip
    # Programs up to end0 have blocks of the first array, up to end1 of the second, and so on.
    block, epsilon = tl.program_id(0), tl.load(factors + LAST)
    if block < end0:
        _move(p0, g0, m0, v0, tl.load(factors), epsilon, block, n0, BLOCK)
    elif block < end1:
        _move(p1, g1, m1, v1, tl.load(factors + 1), epsilon, block - end0, n1, BLOCK)
    elif block < end2:
        _move(p2, g2, m2, v2, tl.load(factors + 2), epsilon, block - end1, n2, BLOCK)
    else:
        _move(p3, g3, m3, v3, tl.load(factors + 3), epsilon, block - end2, n3, BLOCK)
