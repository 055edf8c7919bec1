"""Density control: where Gaussians are added (clone, split) and which are removed."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ..geometry import Views
from ..model import Model
from ..ranges import Natural, Share, checked_dataclass
from ..representations.gaussians import GaussianCloud, unit_quaternions
from .optimiser import Leaves, Trainable

CENTRES = "object.centres"


@checked_dataclass
class DensityControl:
    """Options of densification and pruning."""

    every: int = 0
    """Steps between events (0: never, as after a phase start, which has its Gaussians)."""
    start: Share = 0.1
    """First event, as a share of all steps."""
    stop: Share = 0.7
    """Last event that adds Gaussians, as a share of all steps: what came last needs time to settle."""
    prune_stop: Share = 0.0
    """Last event that removes some, as a share of all steps (0: as `stop`)."""
    grow_fraction: Share = 0.05
    """Share of Gaussians that is cloned or split, those with the largest mean position gradient."""
    grow_gradient: float = 0.0
    """Mean position gradient [loss a pixel] above which Gaussians are cloned or split (0: `grow_fraction` of them)."""
    split_scale_px: float = 0.7
    """Longest axis [pixels] up to which a Gaussian is cloned; longer ones are split in two."""
    max_count: Natural = 200_000
    """No growth beyond so many Gaussians."""
    faint: float = 0.01
    """Gaussians whose peak is below this share of the material are removed."""
    huge_px: float = 20.0
    """Gaussians with a longer axis [pixels] are removed."""
    needle: float = 30.0
    """Gaussians with a larger ratio of longest to shortest axis are removed; so are those outside every view."""

    def due(self, step: int, steps: int) -> bool:
        """Whether an event takes place after `step`."""
        last = max(self.stop, self.prune_stop)
        return self.every > 0 and (step + 1) % self.every == 0 and self.start * steps <= step + 1 <= last * steps

    def grows(self, step: int, steps: int) -> bool:
        """Whether the event after `step` adds Gaussians, too."""
        return step + 1 <= self.stop * steps


class DensityEvent:
    """An event of a fit of Gaussians: adds and removes some of them, where the options say so.

    views: whose fields of view bound the volume.
    """

    def __init__(self, options: DensityControl, views: Views) -> None:
        self._options, self._views = options, views
        self.total: Tensor | None = None
        """The position gradients [N] of each Gaussian since the last event, added up."""
        self.steps = 0
        """The number of steps since the last event."""

    def on_gradients(self, leaves: Leaves) -> None:
        """Take in the position gradients of one step."""
        if self._options.every == 0:
            return
        gradient = leaves[CENTRES].grad
        size = leaves[CENTRES].new_zeros(len(leaves[CENTRES])) if gradient is None else gradient.norm(dim=1)
        self.total = size if self.total is None else self.total.to(size.device).add_(size)
        self.steps += 1

    def after_step(self, trainable: Trainable, step: int, steps: int, generator: torch.Generator) -> bool:
        """Clone or split where the position gradient is largest, then prune, when it is due."""
        if not self._options.due(step, steps):
            return False
        self.control(trainable, generator, self._options.grows(step, steps))
        return True

    def control(self, trainable: Trainable, generator: torch.Generator, grows: bool = True) -> tuple[int, int]:
        """One event, due or not, which adds Gaussians if it `grows`; returns (added, removed)."""
        before = len(_cloud(trainable))
        added = _grow(trainable, self._chosen(before), generator, self._options) if grows else 0
        cloud = _cloud(trainable)
        keep = torch.nonzero(~doomed(cloud, self._views, self._options))[:, 0]
        if 0 < len(keep) < len(cloud):
            trainable.resize("object", keep)
        self.total, self.steps = None, 0
        return added, before + added - len(_cloud(trainable))

    def _chosen(self, count: int) -> Tensor | None:
        """Indices of those of `count` Gaussians that are cloned or split; None for none."""
        options, total = self._options, self.total
        if total is None:
            return None
        most = min(int(options.grow_fraction * count), options.max_count - count)
        if options.grow_gradient > 0:
            steep = int((total > options.grow_gradient * self.steps).count_nonzero())
            most = min(steep, options.max_count - count)
        return torch.topk(total, most).indices.sort().values if most > 0 else None

    def columns(self, model: Model) -> dict[str, float]:
        """The number of Gaussians."""
        assert isinstance(model.object, GaussianCloud)
        return {"count": len(model.object)}

    def state_dict(self) -> dict[str, Any]:
        """The gradients of the steps since the last event."""
        return {"total": None if self.total is None else self.total.cpu().clone(), "steps": self.steps}

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state."""
        self.total, self.steps = state["total"], int(state.get("steps", 0))  # older checkpoints know of no threshold


def _cloud(trainable: Trainable) -> GaussianCloud:
    cloud = trainable.model.object
    assert isinstance(cloud, GaussianCloud)
    return cloud


def _grow(trainable: Trainable, chosen: Tensor | None, generator: torch.Generator, options: DensityControl) -> int:
    """Put two Gaussians in the place of each of the `chosen` ones; returns how many more there are."""
    if chosen is None:
        return 0
    cloud = _cloud(trainable)
    chosen = chosen.to(cloud.centres.device)
    large = cloud.scales.detach()[chosen].amax(dim=1) > options.split_scale_px
    clones, splits = chosen[~large], chosen[large]
    keep = torch.ones(len(cloud), dtype=torch.bool, device=chosen.device)
    keep[chosen] = False
    children = [_pair(cloud, clones, generator, shrink=1.0), _pair(cloud, splits, generator, shrink=1.6)]
    added = {name: torch.cat([pair[name] for pair in children]) for name in cloud.parameters()}
    trainable.resize("object", torch.nonzero(keep)[:, 0], added)
    return len(chosen)


def _pair(cloud: GaussianCloud, index: Tensor, generator: torch.Generator, shrink: float) -> dict[str, Tensor]:
    """Two children of each Gaussian of `index`, that share its mass, half a deviation to either side of it."""
    centres, log_scales, quaternions = (p.detach()[index] for p in (cloud.centres, cloud.log_scales, cloud.quaternions))
    scales = torch.exp(log_scales)
    axis = torch.randn(centres.shape, generator=generator).to(centres.device)
    offset = rotate(quaternions, 0.5 * scales * axis / axis.norm(dim=1, keepdim=True).clamp_min(1e-6))
    values = cloud.values_times(0.5 * shrink**3, index)
    return {
        "centres": torch.cat([centres + offset, centres - offset]),
        "log_scales": torch.cat([log_scales, log_scales]) - math.log(shrink),
        "quaternions": torch.cat([quaternions, quaternions]),
        **{name: torch.cat([rows, rows]) for name, rows in values.items()},
    }


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
        faint = cloud.strength < options.faint
        finite = torch.stack([torch.isfinite(p).all(dim=1) for p in cloud.parameters().values()]).all(dim=0)
        needle = longest > options.needle * shortest
        return faint | (longest > options.huge_px) | needle | outside(cloud, views) | ~finite


def outside(cloud: GaussianCloud, views: Views) -> Tensor:
    """[N] bool: Gaussians whose centre no view has on its detector."""
    held = {"dtype": torch.float32, "device": cloud.centres.device}
    rotations = torch.as_tensor(views.rotations, **held)
    shifts = torch.as_tensor(views.shifts / cloud.unit_length, **held)
    lab = torch.einsum("vij,nj->vni", rotations[:, :2], cloud.centres.detach()) - shifts[:, None]
    half = torch.as_tensor(views.fields[:, None], **held) / (2 * cloud.unit_length)
    return ~(lab.abs() <= half).all(dim=2).any(dim=0)
