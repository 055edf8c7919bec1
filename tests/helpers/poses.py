"""Poses that ask for gradients, and how far gradients are from what they should be."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from holosplat.geometry import Poses, Views


def asking(views: Views) -> Poses:
    """Poses that ask for gradients."""
    poses = Poses.of(views)
    rotations, shifts = (a.clone().requires_grad_() for a in (poses.rotations, poses.shifts))
    return replace(poses, rotations=rotations, shifts=shifts)


def gradients(poses: Poses) -> tuple[Tensor, Tensor]:
    """Of rotations and shifts."""
    assert poses.rotations.grad is not None
    assert poses.shifts.grad is not None
    return poses.rotations.grad, poses.shifts.grad


def relative(found: Tensor, wanted: Tensor) -> float:
    """The norm of the difference over that of what is wanted."""
    return float((found - wanted).detach().norm() / wanted.detach().norm())
