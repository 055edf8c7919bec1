"""Terms on neural fields and pixel-aligned networks: total variation, thickness, frames and line integrals; and on
space-time fields: equations of motion of density and velocity at random places and times.

The equations are in the units of the field's `Frame`: places in halves of the longest edge, times in halves of the
scan, where a density ρ and a velocity v obey

    ∂ρ/∂t + v · ∇ρ + ρ ∇ · v = 0                                            (continuity)
    Re (∂v/∂t + (v · ∇) v) + ∇p - Δv = 0,   Re = half² / (ν duration)        (Navier and Stokes; Re = 0: Stokes)

with the kinematic viscosity ν [m²/s] (Landau and Lifshitz 1987, "Fluid Mechanics", eqs. 1.3 and 15.7).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from holosplat.fit.problem import FIXED, Batch, LossPart
from holosplat.fit.terms import FrameTerm
from holosplat.fit.total_variation import total_variation
from holosplat.geometry import Views
from holosplat.model import Model
from holosplat.ranges import Natural, Small, Weight, checked_dataclass
from holosplat.representations import VoxelGrid

from .neural_field import NeuralField, Samples, uniform
from .perceptron import Jet
from .pixel_aligned import PixelAlignedField
from .space_time import Frame, SpaceTimeField

APART = 0.5
"""Distance [voxel edges] of the two points between which a field's variation is measured."""


class FieldVariation:
    """∫ |∇u| over the field's mask [voxel edges²], from differences along random directions: E |∇u · e| = |∇u| / 2."""

    names = ("variation",)

    def __init__(self, weight: float, probes: int, generator: torch.Generator) -> None:
        """probes: pairs of points a step."""
        self._weight, self._probes, self._generator = weight, probes, generator
        self.resolved = {"variation": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        field, generator = model.object, self._generator
        assert isinstance(field, NeuralField)
        cells = field.mask.nonzero().flip(1)
        chosen = (uniform(generator, self._probes) * len(cells)).long()
        at = cells[chosen] + uniform(generator, self._probes, 3)
        along = torch.randn(self._probes, 3, generator=generator, device=at.device)
        first, second = field(torch.cat((at, at + APART * normalize(along, dim=1)))).split(self._probes)
        total = (second - first).abs().mean(dim=0).sum() * (2 * len(cells) / APART)
        return [LossPart("variation", self._weight, total)]


class RetrievedThickness:
    """Σ of squared differences from retrieved thickness over all pixels [voxel edges²], mean over views.

    target: [V, H, W] in voxel edges; share: of the pixels that a step looks at, drawn anew each time.
    """

    names = ("thickness",)
    resolved = FIXED

    def __init__(self, target: Tensor, views: Views, share: float, generator: torch.Generator) -> None:
        self._target, self._views, self._share, self._generator = target, views, share, generator

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        field = model.object
        assert isinstance(field, NeuralField)
        total = sum((self._view(field, v) for v in range(len(self._views))), start=self._target.new_zeros(()))
        return [LossPart("thickness", 1.0, total / (self._share * len(self._views)))]

    def _view(self, field: NeuralField, v: int) -> Tensor:
        chosen = uniform(self._generator, self._target[v].numel()) < self._share
        every = field.kept_samples(self._views, v)
        kept = chosen[every.pixel]
        rays = Samples(every.pixel[kept], every.depth[kept])
        found = field.thickness(self._views, v, rays, uniform(self._generator, len(rays.pixel)))[0].flatten()
        return (found - self._target[v].flatten())[chosen].square().sum()


class AlignedFrames:
    """The parts of a data term, and ∫ |∇u| of the field's voxels [voxel edges²], smoothed below `smoothing`."""

    def __init__(self, frames: FrameTerm, weight: float, smoothing: float) -> None:
        self._frames, self._weight, self._smoothing = frames, weight, smoothing
        self.names = (*frames.names, "variation")
        self.resolved = {**frames.resolved, "variation": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The parts of the data term, and the variation."""
        voxels = _voxels(model)
        seen = self._frames(replace(model, object=voxels), batch)
        return [*seen, LossPart("variation", self._weight, _variation(voxels.values, self._smoothing))]


class AlignedLines:
    """½ Σ of squared differences from retrieved thickness over all pixels [pixels²], mean over views, and ∫ |∇u|.

    target: [V, H, W] in pixels of one material, on the pixels of `views`. No waves.
    """

    names = ("thickness", "variation")

    def __init__(self, target: Tensor, views: Views, weight: float, smoothing: float) -> None:
        self._target, self._views, self._weight, self._smoothing = target, views, weight, smoothing
        self.resolved = {"variation": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """Both parts."""
        voxels, target = _voxels(model), self._target
        views = self._views if batch.index is None else self._views[batch.index.numpy()]
        lines = voxels.project(views).channels[:, 0] / self._views.finest
        missing = lines - (target if batch.index is None else target[batch.index])
        return [
            LossPart("thickness", 1.0, 0.5 * missing.square().sum((1, 2)).mean()),
            LossPart("variation", self._weight, _variation(voxels.values, self._smoothing)),
        ]


def _voxels(model: Model) -> VoxelGrid:
    assert isinstance(model.object, PixelAlignedField)
    return model.object.at(0.0)


def _variation(values: Tensor, smoothing: float) -> Tensor:
    return total_variation(values, smoothing, "cpu") * values.numel()


@checked_dataclass
class Equations:
    """Which equations bind density and velocity, and how much each counts beside frames.

    A weight multiplies ∫ r² over the field [voxel edges³], mean over the scan's times; misfits of frames are sums of
    squares of thickness [pixels], mean over frames. A weight of zero leaves the equation out.
    """

    continuity: Weight = 0.3
    """r: what an occupancy changes by, from one time to the next, that the flow does not explain."""
    divergence: Weight = 10.0
    """r: what a volume grows by, from one time to the next, as a share. A velocity without divergence by construction
    needs none, and has none."""
    momentum: Weight = 0.01
    """r: what the flow bends by over half the field, beyond what a pressure explains [voxel edges, from one time to the
    next]."""
    viscosity: Small | None = None
    """Kinematic viscosity ν [m²/s], with which inertia counts (Navier and Stokes); without, it does not (Stokes)."""
    points: Natural = 1024
    """Random places of a step, all at one random time, for continuity."""
    momentum_points: Natural = 128
    """The same for momentum, whose derivatives are of third order."""

    def reynolds(self, frame: Frame) -> float:
        """Re of a field; 0 without a viscosity."""
        return 0.0 if self.viscosity is None else frame.half**2 / (self.viscosity * frame.duration)


def continuity(density: Jet, velocity: Jet) -> Tensor:
    """∂ρ/∂t + ∇ · (ρ v) [P]."""
    carried = (velocity.value * density.slope).sum(-1)
    return density.rate + carried + density.value * divergence(velocity)


def divergence(velocity: Jet) -> Tensor:
    """∇ · v [P]."""
    return velocity.slope.diagonal(dim1=-2, dim2=-1).sum(-1)


def momentum(velocity: Jet, pressure: Jet, reynolds: float = 0.0) -> Tensor:
    """Re (∂v/∂t + (v · ∇) v) + ∇p - Δv [P, 3]; velocity: with its Laplacian."""
    assert velocity.curved is not None
    slow = pressure.slope - velocity.curved
    if reynolds == 0:
        return slow
    carried = (velocity.slope * velocity.value[:, None]).sum(-1)
    return reynolds * (velocity.rate + carried) + slow


class EquationTerm:
    """The equations of a space-time field as terms of a fit."""

    def __init__(self, equations: Equations, views: float, interval: float, generator: torch.Generator) -> None:
        """views: frames of a time, for misfits are means over frames; interval: from one time to the next [s]."""
        self._equations, self._interval, self._generator = equations, interval, generator
        weights = {name: getattr(equations, name) / views for name in ("continuity", "divergence", "momentum")}
        self._weights = {name: weight for name, weight in weights.items() if weight > 0}
        self.names = tuple(self._weights)
        self.resolved = dict(self._weights)

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The parts in use; a velocity without divergence by construction has none of that name."""
        field = model.object
        assert isinstance(field, SpaceTimeField)
        step = self._interval / field.frame.duration
        values = self._moving(field, step)
        if "momentum" in self._weights:
            places, time = self._drawn(field, self._equations.momentum_points)
            flow, pressure = field.flow(places, time, curved=True)
            left = momentum(flow, pressure, self._equations.reynolds(field.frame))
            values["momentum"] = (step * field.edges * left).square().sum(-1).mean()
        size = float(field.coefficients.new_tensor(field.grid.shape).prod())
        return [LossPart(name, self._weights[name], size * values[name]) for name in self.names if name in values]

    def _moving(self, field: SpaceTimeField, step: float) -> dict[str, Tensor]:
        """Mean squares of what continuity leaves, and of the divergence where there can be one."""
        if not {"continuity", "divergence"} & set(self.names):
            return {}
        places, time = self._drawn(field, self._equations.points)
        density, found = field.density(places, time), dict[str, Tensor]()
        if field.options.velocity.solenoidal:
            velocity = field.velocities(places, time)
            if "continuity" in self._weights:
                left = density.rate + (velocity * density.slope).sum(-1)
                found["continuity"] = (step * left).square().mean()
            return found
        velocity, _ = field.flow(places, time)
        if "continuity" in self._weights:
            found["continuity"] = (step * continuity(density, velocity)).square().mean()
        if "divergence" in self._weights:
            found["divergence"] = (step * divergence(velocity)).square().mean()
        return found

    def _drawn(self, field: SpaceTimeField, count: int) -> tuple[Tensor, float]:
        """Places [count, 3] in the field and a time, in the units of its frame."""
        like, ends = field.coefficients, field.grid.shape[::-1]
        reach = like.new_tensor([n / max(ends) for n in ends])
        places = (2 * uniform(self._generator, count, 3).to(like) - 1) * reach
        return places, 2 * float(uniform(self._generator, 1)) - 1


class SpaceTimeVariation:
    """∫ |∇u| [voxel edges²] of a space-time field at one of its times, drawn anew in each step; smoothed below
    `smoothing`."""

    names = ("variation",)

    def __init__(self, weight: float, smoothing: float, times: Sequence[float], generator: torch.Generator) -> None:
        self._weight, self._smoothing, self._times, self._generator = weight, smoothing, times, generator
        self.resolved = {"variation": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        field = model.object
        assert isinstance(field, SpaceTimeField)
        drawn = min(int(float(uniform(self._generator, 1)) * len(self._times)), len(self._times) - 1)
        values = field.values(self._times[drawn])
        total = total_variation(values[None], self._smoothing, "cpu") * values.numel()
        return [LossPart("variation", self._weight, total)]
