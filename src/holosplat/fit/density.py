"""Density control: where Gaussians are added (clone, split) and which are removed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..geometry import Views
from ..representations.gaussians import GaussianCloud, raw_of, unit_quaternions
from .trainable import Trainable


@dataclass(frozen=True)
class DensityControl:
    """Options of densification and pruning; lengths in detector pixels.

    every: steps between events (0: never), between the steps `start` and `stop` (fractions of all steps);
    grow_fraction: the share of Gaussians, those with the largest mean position gradient, that is cloned (axes
    up to `split_scale_px`) or split in two (longer ones); max_count: no growth beyond;
    faint: Gaussians whose peak is below this share of the material are removed; huge_px: a longest axis above;
    needle: a longest-to-shortest axis ratio above; those whose centre lies outside every view's field go too.
    """

    every: int = 0
    start: float = 0.1
    stop: float = 0.7
    grow_fraction: float = 0.05
    split_scale_px: float = 0.7
    max_count: int = 200_000
    faint: float = 0.01
    huge_px: float = 20.0
    needle: float = 30.0

    def due(self, step: int, steps: int) -> bool:
        """Whether an event takes place after `step`."""
        inside = self.start * steps <= step + 1 <= self.stop * steps
        return self.every > 0 and inside and (step + 1) % self.every == 0


class GradientRecord:
    """The mean position gradient of each Gaussian since the last event."""

    def __init__(self) -> None:
        self.total: Tensor | None = None

    def add(self, gradient: Tensor) -> None:
        """Take in the position gradients [N, 3] of one step."""
        size = gradient.norm(dim=1)
        self.total = size if self.total is None else self.total.add_(size)

    def clear(self) -> None:
        """Forget everything."""
        self.total = None


def control_density(
    trainable: Trainable,
    record: GradientRecord,
    views: Views,
    options: DensityControl,
    generator: torch.Generator,
) -> tuple[int, int]:
    """One event: clone or split where the position gradient is largest, then prune; returns (added, removed)."""
    before = len(trainable.cloud)
    added = _grow(trainable, record, options, generator)
    keep = torch.nonzero(~doomed(trainable.cloud, views, options))[:, 0]
    removed = len(trainable.cloud) - len(keep)
    if 0 < removed < len(trainable.cloud):
        trainable.resize(keep)
    record.clear()
    return added, before + added - len(trainable.cloud)


def _grow(trainable: Trainable, record: GradientRecord, options: DensityControl, generator: torch.Generator) -> int:
    cloud = trainable.cloud
    count = min(int(options.grow_fraction * len(cloud)), options.max_count - len(cloud))
    if record.total is None or count <= 0:
        return 0
    chosen = torch.topk(record.total, count).indices.sort().values
    large = cloud.scales.detach()[chosen].amax(dim=1) > options.split_scale_px
    clones, splits = chosen[~large], chosen[large]
    keep = torch.ones(len(cloud), dtype=torch.bool, device=chosen.device)
    keep[chosen] = False
    children = [_pair(cloud, clones, generator, shrink=1.0), _pair(cloud, splits, generator, shrink=1.6)]
    trainable.resize(torch.nonzero(keep)[:, 0], tuple(torch.cat(parts) for parts in zip(*children)))
    return count


def _pair(
    cloud: GaussianCloud, index: Tensor, generator: torch.Generator, shrink: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Two children of each Gaussian of `index`, that share its mass, half a deviation to either side of it."""
    centres, log_scales, quaternions, _ = (p.detach()[index] for p in cloud.parameters)
    scales = torch.exp(log_scales)
    axis = torch.randn(centres.shape, generator=generator).to(centres.device)
    offset = rotate(quaternions, 0.5 * scales * axis / axis.norm(dim=1, keepdim=True).clamp_min(1e-6))
    amplitude = cloud.amplitudes.detach()[index] * 0.5 * shrink**3
    children = (
        torch.cat([centres + offset, centres - offset]),
        torch.cat([log_scales, log_scales]) - math.log(shrink),
        torch.cat([quaternions, quaternions]),
        torch.cat([raw_of(amplitude)] * 2),
    )
    return children


def rotate(quaternions: Tensor, vectors: Tensor) -> Tensor:
    """`R(q) v` for quaternions [N, 4] and vectors [N, 3]."""
    q = unit_quaternions(quaternions)
    w, axis = q[:, :1], q[:, 1:]
    t = 2 * torch.cross(axis, vectors, dim=1)
    return vectors + w * t + torch.cross(axis, t, dim=1)


def doomed(cloud: GaussianCloud, views: Views, options: DensityControl) -> Tensor:
    """[N] bool: Gaussians that are faint, huge, needle-like, outside every view's field, or not finite."""
    with torch.no_grad():
        scales = cloud.scales
        longest, shortest = scales.amax(dim=1), scales.amin(dim=1)
        faint = cloud.amplitudes.amax(dim=1) < options.faint
        finite = torch.stack([torch.isfinite(p).all(dim=1) for p in cloud.parameters]).all(dim=0)
        needle = longest > options.needle * shortest
        return faint | (longest > options.huge_px) | needle | outside(cloud, views) | ~finite


def outside(cloud: GaussianCloud, views: Views) -> Tensor:
    """[N] bool: Gaussians whose centre no view has on its detector."""
    held = {"dtype": torch.float32, "device": cloud.centres.device}
    rotations = torch.as_tensor(views.rotations, **held)
    shifts = torch.as_tensor(views.shifts / cloud.unit_length, **held)
    lab = torch.einsum("vij,nj->vni", rotations[:, :2], cloud.centres.detach()) - shifts[:, None]
    half = torch.tensor([views.width, views.height], **held) / (2 * cloud.unit_length)
    return ~(lab.abs() <= half).all(dim=2).any(dim=0)
