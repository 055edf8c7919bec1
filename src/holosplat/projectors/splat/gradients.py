"""The autograd function of the fast backends: a backend draws a cloud, and gathers the gradients of what was drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ...launch import launching

Arrays = Sequence[Tensor]
Poses = Sequence[Tensor | None]
"""Rotations, shifts and curvatures of views; None of what there is none."""
Draw = Callable[[Any, Any], tuple[Tensor, Arrays]]
"""From the four arrays of a cloud, contiguous, and poses: what is drawn, and what the gradients need of it."""
Gather = Callable[[Any, Any, Any, Tensor, bool], tuple[Arrays, Poses]]
"""From cloud, poses, what was kept and the gradient of what was drawn: those of the cloud, and, if wanted, of poses."""


def drawn(cloud: Arrays, poses: Poses, draw: Draw, gather: Gather) -> Tensor:
    """What `draw` gives of `cloud`, with the gradients that `gather` gives, once."""
    return _Drawn.apply(*cloud, *poses, draw, gather)  # type: ignore[no-any-return]


class _Drawn(Function):
    @staticmethod
    def forward(ctx: Any, *given: Any) -> Tensor:
        cloud, poses, (draw, gather) = [a.contiguous() for a in given[:4]], given[4:7], given[7:]
        with launching(cloud[0]):
            found, kept = draw(cloud, poses)
        ctx.save_for_backward(*cloud, *poses, *kept)
        ctx.gather = gather
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        saved, of_poses = ctx.saved_tensors, any(ctx.needs_input_grad[4:7])
        with launching(gradient):
            out, moved = ctx.gather(saved[:4], saved[4:7], saved[7:], gradient.contiguous(), of_poses)
        return *out, *moved, None, None
