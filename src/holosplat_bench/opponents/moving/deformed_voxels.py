"""Canonical voxels that a network displaces (after D-NeRF), fitted through the waves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.checks import require_shapes
from holosplat.fit.loop import Fit
from holosplat.geometry import Grid
from holosplat.matter import Matter
from holosplat.methods.cross_validation import assumed_material
from holosplat.methods.method import Method, Stage, Task, quiet
from holosplat.ranges import Natural, Pixels, Positive, Rate, Weight, checked_dataclass
from holosplat.representations import Stored, VoxelGrid
from holosplat.representations.voxels import along_axes
from holosplat.tables import from_table, to_table

from .each_time import require_times, usual_start
from .hexplane_field import hats
from .moving_voxels import OnVoxels, from_plain, held
from .times import Cost, DrawnTimes, TimesFit, times_fit

NETWORK = "network."
"""Before the names of the weights."""


@checked_dataclass
class Deformation:
    """Options of the network and of the canonical voxels."""

    layers: Natural = 3
    """Layers of rectified units (eight as published, for scenes of many parts)."""
    hidden: Natural = 64
    """Units of a layer (256 as published)."""
    place_frequencies: int = 4
    """Octaves of sines and cosines of the place, from half a wave over the field on (ten as published: finer ones let
    parts of a pixel move by themselves)."""
    time_frequencies: int = 2
    """The same of the time (four as published)."""
    cell_px: Positive = 4.0
    """Distance of the places at which the network is asked [voxel edges]; between them displacements are linear."""
    beyond_px: Pixels = 24.0
    """Canonical voxels beyond the field on every side [voxel edges], from which matter enters."""
    reach_px: Positive = 10.0
    """Displacement of an output of one [voxel edges], from the middle of the times to their ends."""

    @property
    def margin(self) -> int:
        """Canonical voxels beyond the field on every side."""
        return max(1, round(self.beyond_px))

    def canonical_shape(self, grid: Grid) -> tuple[int, int, int]:
        """Canonical voxels of a field on `grid`."""
        z, y, x = (n + 2 * self.margin for n in grid.shape)
        return z, y, x

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of the network's weights, by name."""
        first = 3 * (1 + 2 * self.place_frequencies) + 1 + 2 * self.time_frequencies
        found: dict[str, tuple[int, ...]] = {}
        for k, (before, after) in enumerate(pairwise([first, *[self.hidden] * self.layers, 3])):
            found |= {f"weight{k}": (after, before), f"bias{k}": (after,)}
        return found

    def started(self, seed: int) -> dict[str, Tensor]:
        """Weights at random by `seed` (He et al. 2015), but for those of the output, which are zero: nothing moves."""
        generator, found = torch.Generator().manual_seed(seed), dict[str, Tensor]()
        for name, shape in self.shapes().items():
            still = name.startswith("bias") or name.endswith(str(self.layers))
            size = 0.0 if still else math.sqrt(2 / shape[-1])
            found[name] = size * torch.randn(shape, generator=generator)
        return found


class DeformedVoxels(OnVoxels):
    """Matter whose occupancy at place x and time t is that of canonical voxels at x + d(x, t), after D-NeRF (Pumarola
    et al. 2021, "D-NeRF: neural radiance fields for dynamic scenes", eqs. 1 to 3).

    d is τ times the output of a perceptron of sines and cosines of x and τ, with τ = -1 at the first time and 1 at the
    last: it is zero at the middle of the times, when the canonical matter is seen as it is (D-NeRF sets it to zero at
    the first). Occupancies lie between 0 and `upper` (0: no such bound), linear between voxels and 0 beyond.

    canonical: on voxels of the same size, `options.margin` more on every side; weights: of the network. Errors:
    `InputError` if the shapes do not fit.
    """

    kind: ClassVar[str] = "deformed-voxels"

    def __init__(
        self,
        parts: tuple[Tensor, Mapping[str, Tensor]],
        grid: Grid,
        times: Sequence[float] | np.ndarray,
        matter: Matter,
        upper: float = 0.0,
        options: Deformation = Deformation(),
    ) -> None:
        """parts: the canonical occupancies and the network's weights."""
        super().__init__(grid, times, matter, upper)
        canonical, weights = parts
        wanted = {"canonical": options.canonical_shape(grid)} | options.shapes()
        require_shapes("{} of deformed voxels", {"canonical": canonical, **weights}, wanted)
        self.canonical, self.weights, self.options = canonical, dict(weights), options
        self._axes = tuple(hats(n, max(1, round((n - 1) / options.cell_px) + 1)) for n in grid.shape)
        self._encoded = _waves(_lattice([a.shape[1] for a in self._axes], grid), options.place_frequencies)

    @classmethod
    def still(
        cls,
        values: Tensor,
        grid: Grid,
        times: Sequence[float] | np.ndarray,
        matter: Matter,
        upper: float = 0.0,
        options: Deformation = Deformation(),
        seed: int = 0,
    ) -> DeformedVoxels:
        """Matter with the occupancies `values` [Z, Y, X] at all times, and nothing beyond the field."""
        canonical = torch.nn.functional.pad(values.float(), (options.margin,) * 6)
        return cls((canonical, options.started(seed)), grid, times, matter, upper, options)

    def parameters(self) -> dict[str, Tensor]:
        """The trainable tensors, by name; those of the network begin with `network.`."""
        return {"canonical": self.canonical, **{NETWORK + name: weight for name, weight in self.weights.items()}}

    def _put(self, parameters: Mapping[str, Tensor]) -> None:
        self.canonical = parameters.get("canonical", self.canonical)
        self.weights = {name: parameters.get(NETWORK + name, mine) for name, mine in self.weights.items()}

    def displacements(self, time: float) -> Tensor:
        """d [3, nodes along z, y, x] at `time` [s] at the places where the network is asked: `(x, y, z)` [voxel
        edges]."""
        first, last = float(self.times[0]), float(self.times[-1])
        tau = 2 * (time - first) / (last - first) - 1
        hidden = self._encoded.to(self.canonical)
        now = _waves(hidden.new_tensor([[tau]]), self.options.time_frequencies).expand(len(hidden), -1)
        hidden = torch.cat([hidden, now], 1)
        for k in range(self.options.layers + 1):
            hidden = hidden @ self.weights[f"weight{k}"].T + self.weights[f"bias{k}"]
            hidden = torch.relu(hidden) if k < self.options.layers else hidden
        return tau * self.options.reach_px * hidden.T.reshape(3, *[a.shape[1] for a in self._axes])

    def values(self, time: float) -> Tensor:
        """Occupancies [Z, Y, X] at `time` [s]."""
        z, y, x = self._axes
        moved = along_axes(self.displacements(time), (z, y, x))
        places = [torch.arange(n, dtype=moved.dtype) + self.options.margin for n in self.grid.shape[::-1]]
        x, y, z = (place.reshape([-1 if k == axis else 1 for k in (2, 1, 0)]) for axis, place in enumerate(places))
        ends = [n - 1.0 for n in self.canonical.shape[::-1]]
        points = torch.stack([2 * (p + d) / end - 1 for p, d, end in zip((x, y, z), moved, ends)], -1)
        found = grid_sample(self.canonical[None, None], points[None], align_corners=True, padding_mode="zeros")
        return held(found[0, 0], self.upper)

    @property
    def described(self) -> str:
        """How large it is, in words."""
        o, voxels = self.options, " × ".join(map(str, self.canonical.shape))
        return f"{voxels} canonical voxels, which a network of {o.layers} layers of {o.hidden} displaces"

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same matter of."""
        own = {"canonical": self.canonical, "weights": dict(self.weights)}
        return {**own, "options": to_table(self.options), **self._plain()}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> DeformedVoxels:
        """The matter that `state` described; `InputError` where it does not fit together."""
        options = from_table(Deformation, state["options"], "options")
        return cls((state["canonical"], state["weights"]), *from_plain(state), options)


def _lattice(nodes: Sequence[int], grid: Grid) -> Tensor:
    """Places [P, 3] `(x, y, z)` of the nodes along z, y, x, in halves of the longest edge from the middle."""
    half = 0.5 * max(grid.shape)
    ends = [0.5 * (cells - 1) / half if n > 1 else 0.0 for n, cells in zip(nodes, grid.shape)]
    z, y, x = (torch.linspace(-end, end, n) for n, end in zip(nodes, ends))
    return torch.stack([axis.flatten() for axis in torch.meshgrid(z, y, x, indexing="ij")[::-1]], 1)


def _waves(places: Tensor, octaves: int) -> Tensor:
    """`places` [P, D], and their sines and cosines at half a wave from -1 to 1, and octaves of it [P, D (1 + 2 L)]."""
    found = [places]
    for k in range(octaves):
        found += [torch.sin(0.5 * math.pi * 2**k * places), torch.cos(0.5 * math.pi * 2**k * places)]
    return torch.cat(found, 1)


def _fit() -> TimesFit:
    return TimesFit(drawn=DrawnTimes(opening=0.6))


@checked_dataclass
class Deformed(Method):
    """Options of canonical matter and its deformation."""

    kind: ClassVar[str] = "deformed"
    of_series: ClassVar[bool] = True
    likelier: ClassVar[bool] = True

    volume: HolographicTV = field(default_factory=usual_start)
    """The start: the time in the middle by itself."""
    deformation: Deformation = field(default_factory=Deformation)
    """The network and the canonical voxels."""
    rate: Rate = 0.02
    """Adam's first rate of the canonical occupancies."""
    network_rate: Rate = 0.002
    """The same of the network (0.0005 as published, for a thousand times the steps)."""
    strain: Weight = 0.001
    """Weight of ∫ |∇d|² [voxel edges³] of the displacement d at a time."""
    fit: TimesFit = field(default_factory=_fit)
    """The fit through the waves. Times are added from the middle on: matter that moves by more than its size from
    where a network believes it tells it nothing."""

    def stages(self) -> Sequence[Stage]:
        """One."""
        return (DeformedStage(self),)


@dataclass(frozen=True)
class DeformedStage:
    """The matter of the time in the middle, and the fit of all times."""

    options: Deformed
    name: str = "deformed voxels through the waves"

    def start(self, task: Task, before: Stored | None) -> DeformedVoxels:
        """The matter of the time in the middle at all times; `InputError` for a scan of one time."""
        times, options = require_times(task.scan), self.options
        middle = task.scan.at_instant(len(times) // 2)
        material = assumed_material(middle, task.prior, task.on_progress, options.volume.backend)
        bound = task.bound(1.0)
        values, grid = holographic_tv(middle, material, replace(options.volume, upper=bound), quiet)
        matter = Matter.one(*material)
        return DeformedVoxels.still(values, grid, times, matter, bound, options.deformation, task.seed)

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit to the training frames."""
        options = self.options

        def costs(views: float) -> Sequence[Cost]:
            return [Strain(options.strain / views, options.deformation.cell_px)]

        def rate(name: str) -> float:
            return options.rate if name == "canonical" else options.network_rate

        return times_fit(task, start, options.fit, rate, costs)


class Strain:
    """∫ |∇d|² [voxel edges³] of the displacements of `DeformedVoxels`, mean over times."""

    name = "strain"

    def __init__(self, weight: float, cell: float) -> None:
        """cell: distance of the places at which the network is asked [voxel edges]."""
        self.weight, self._cell = weight, cell

    def __call__(self, moving: Any, seen: Sequence[tuple[float, VoxelGrid]]) -> Tensor:
        """At the times that a step looks at."""
        found = list[Tensor]()
        for time, _ in seen:
            d = moving.displacements(time)
            found += [d.diff(dim=axis).square().sum() for axis in (1, 2, 3) if d.shape[axis] > 1]
        if not found:
            return moving.canonical.new_zeros(())
        return self._cell * torch.stack(found).sum() / len(seen)
