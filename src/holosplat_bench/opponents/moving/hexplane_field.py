"""Fields of space and time by six planes of features and a small decoder, and low-rank voxels; fits of both."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from holosplat.baselines import HolographicTV
from holosplat.checks import require, require_shapes
from holosplat.fit.loop import Fit
from holosplat.geometry import Grid
from holosplat.matter import Matter
from holosplat.methods.cross_validation import assumed_material
from holosplat.methods.method import Method, Stage, Task
from holosplat.ranges import Natural, Positive, Rate, Share, Weight, checked_dataclass
from holosplat.representations import Stored, VoxelGrid
from holosplat.tables import from_table, to_table

from .each_time import EachTimeStage, require_times, usual_start
from .moving_voxels import LowRankVoxels, OnVoxels, VoxelSeries, from_plain, shares
from .times import Cost, TimesFit, times_fit

PAIRS = (("xy", "zt"), ("xz", "yt"), ("yz", "xt"))
"""The planes whose features are multiplied: one of space, and one of the third axis and the time."""
TIME_PLANES = tuple(second for _, second in PAIRS)


@checked_dataclass
class HexPlanes:
    """Options of the field."""

    features: Natural = 16
    """Features of each plane (24 to 48 as published, for scenes of many colours)."""
    hidden: Natural = 16
    """Units of the decoder's one layer."""
    cell_px: Positive = 1.0
    """Distance of the nodes of the planes in space [voxel edges]."""
    time_nodes: int = 0
    """Nodes of the planes in time (0: as many as times)."""
    empty: Share = 0.02
    """Occupancy everywhere, about, with which a fit begins: matter is rare in most fields."""

    def __post_init__(self) -> None:
        require(0 < self.empty < 1, f"empty must lie between 0 and 1, but it is {self.empty:g}.")

    def nodes(self, cells: int) -> int:
        """Nodes along an axis of so many voxels."""
        return max(2, math.ceil((cells - 1) / self.cell_px) + 1) if cells > 1 else 1

    def shapes(self, grid: Grid, times: int) -> dict[str, tuple[int, ...]]:
        """Of all parameters, by name, for the voxels of `grid` and so many times."""
        sizes = dict(zip("zyx", map(self.nodes, grid.shape))) | {"t": self.time_nodes or times}
        found: dict[str, tuple[int, ...]] = {}
        for plane in (plane for pair in PAIRS for plane in pair):
            second, first = plane  # the slower axis comes first in memory
            found[plane] = (self.features, sizes[first], sizes[second])
        found |= {f"mix_{first}": (self.hidden, self.features) for first, _ in PAIRS}
        return found | {"bias": (self.hidden,), "out": (self.hidden,), "out_bias": (1,)}

    def started(self, grid: Grid, times: int, upper: float, seed: int) -> dict[str, Tensor]:
        """Parameters at random by `seed`: planes of space even from 0.1 to 0.5, planes of time one, as in K-Planes
        (Fridovich-Keil et al. 2023, supplement), so that nothing moves yet; a decoder that says `empty`."""
        generator, found = torch.Generator().manual_seed(seed), dict[str, Tensor]()
        for name, shape in self.shapes(grid, times).items():
            if name in TIME_PLANES:
                found[name] = torch.ones(shape)
            elif name.startswith("mix_"):
                found[name] = torch.randn(shape, generator=generator) * math.sqrt(2 / (len(PAIRS) * self.features))
            elif name == "out":
                found[name] = torch.randn(shape, generator=generator) / self.hidden
            elif name.endswith("bias"):
                found[name] = torch.zeros(shape)
            else:
                found[name] = 0.1 + 0.4 * torch.rand(shape, generator=generator)
        level = self.empty / (1 - self.empty) if upper > 0 else math.expm1(self.empty)
        found["out_bias"] = torch.full((1,), math.log(level))
        return found


class HexPlaneField(OnVoxels):
    """Occupancies from six planes of features (Cao & Johnson 2023, "HexPlane: a fast representation for dynamic
    scenes", eq. 2), for the planes xy, xz, yz of space and zt, yt, xt of space and time:

        u = g(XY ⊙ ZT, XZ ⊙ YT, YZ ⊙ XT),   occupancy = upper · sigmoid(u)   (upper 0: softplus(u))

    with features linear between nodes, and a decoder g of one layer of rectified units. It is evaluated at the centres
    of all voxels, where a plane of time is a line, so that the decoder's first layer needs no feature of any voxel.

    weights: by name, of the shapes that `options.shapes` says: planes [F, nodes, nodes] (of xy: y before x; of zt: t
    before z), `mix_xy`, `mix_xz`, `mix_yz` [H, F], `bias` [H], `out` [H], `out_bias` [1]. Errors: `InputError` if the
    shapes do not fit.
    """

    kind: ClassVar[str] = "hexplane-field"

    def __init__(
        self,
        weights: Mapping[str, Tensor],
        grid: Grid,
        times: Sequence[float] | np.ndarray,
        matter: Matter,
        upper: float = 0.0,
        options: HexPlanes = HexPlanes(),
    ) -> None:
        super().__init__(grid, times, matter, upper)
        wanted = options.shapes(grid, len(self.times))
        require_shapes("{} of a hexplane field", weights, wanted)
        self.options, self._weights = options, {name: weights[name] for name in wanted}
        self._nodes = np.linspace(self.times[0], self.times[-1], options.time_nodes or len(self.times))
        self._axes = {axis: hats(n, options.nodes(n)) for axis, n in zip("zyx", grid.shape)}

    def parameters(self) -> dict[str, Tensor]:
        """The trainable tensors, by name."""
        return dict(self._weights)

    def _put(self, parameters: Mapping[str, Tensor]) -> None:
        self._weights = {name: parameters.get(name, mine) for name, mine in self._weights.items()}

    def values(self, time: float) -> Tensor:
        """Occupancies [Z, Y, X] at `time` [s]."""
        (z, y, x), own = self.grid.shape, self._weights
        one = self._mixed("xy", "zt", time).reshape(z, -1, y, x).transpose(0, 1)
        two = self._mixed("xz", "yt", time).reshape(y, -1, z, x).permute(1, 2, 0, 3)
        three = self._mixed("yz", "xt", time).reshape(x, -1, z, y).permute(1, 2, 3, 0)
        hidden = torch.relu(one + two + three + own["bias"][:, None, None, None])
        raw = torch.tensordot(own["out"], hidden, dims=1) + own["out_bias"]
        return self.upper * torch.sigmoid(raw) if self.upper > 0 else softplus(raw)

    def _mixed(self, space: str, other: str, time: float) -> Tensor:
        """The part of the first layer [n, H, m] that a pair of planes adds, n voxels along the axis of `other`."""
        second, first = space
        plane, line = self._weights[space], self._weights[other]
        axes = {axis: self._axes[axis].to(plane) for axis in {first, second, other[0]}}
        flat = (axes[first] @ plane @ axes[second].T).flatten(1)
        now = torch.from_numpy(shares(self._nodes, time)).to(line)
        along = axes[other[0]] @ torch.einsum("t,ftn->nf", now, line)
        return (self._weights[f"mix_{space}"] * along[:, None]) @ flat

    @property
    def described(self) -> str:
        """How large it is, in words."""
        z, y, x = map(self.options.nodes, self.grid.shape)
        return f"six planes of {self.options.features} features, {x} × {y} × {z} × {len(self._nodes)} nodes"

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same field of."""
        return {"weights": dict(self._weights), "options": to_table(self.options), **self._plain()}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> HexPlaneField:
        """The field that `state` described; `InputError` where it does not fit together."""
        return cls(state["weights"], *from_plain(state), from_table(HexPlanes, state["options"], "options"))


def hats(cells: int, nodes: int) -> Tensor:
    """[cells, nodes]: what each of `nodes`, even from the first of `cells` to the last, counts at each cell; linear."""
    if nodes == 1:
        return torch.ones(cells, 1)
    places = np.linspace(0.0, nodes - 1.0, cells)
    return torch.from_numpy(np.clip(1 - np.abs(places[:, None] - np.arange(nodes)), 0, None)).float()


@checked_dataclass
class HexPlane(Method):
    """Options of a field of six planes: its start is random, as published."""

    kind: ClassVar[str] = "hexplane"
    of_series: ClassVar[bool] = True
    likelier: ClassVar[bool] = True

    planes: HexPlanes = field(default_factory=HexPlanes)
    """The planes and the decoder."""
    rate: Rate = 0.1
    """Adam's first rate of the planes (0.02 as published, for a hundred times the steps)."""
    decoder_rate: Rate = 0.02
    """The same of the decoder (0.001 as published)."""
    roughness: Weight = 1e-4
    """Weight of squared differences of features between nodes of a plane in space, their mean times the voxels."""
    jerkiness: Weight = 1e-4
    """The same of squared second differences in time (K-Planes: Fridovich-Keil et al. 2023, eq. 5)."""
    fit: TimesFit = field(default_factory=TimesFit)
    """The fit through the waves."""

    def stages(self) -> Sequence[Stage]:
        """One."""
        return (HexPlaneStage(self),)


@dataclass(frozen=True)
class HexPlaneStage:
    """The random field, and its fit."""

    options: HexPlane
    name: str = "six planes through the waves"

    def start(self, task: Task, before: Stored | None) -> HexPlaneField:
        """The random field; `InputError` for a scan of one time."""
        times = require_times(task.scan)
        material = assumed_material(task.scan.at_instant(len(times) // 2), task.prior, task.on_progress, "cpu")
        grid, upper, planes = Grid.of_views(task.scan.views), task.bound(1.0), self.options.planes
        weights = planes.started(grid, len(times), upper, task.seed)
        return HexPlaneField(weights, grid, times, Matter.one(*material), upper, planes)

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit to the training frames."""
        options = self.options
        planes = {plane for pair in PAIRS for plane in pair}

        def costs(views: float) -> Sequence[Cost]:
            return [Roughness(options.roughness / views), Jerkiness(options.jerkiness / views)]

        def rate(name: str) -> float:
            return options.rate if name in planes else options.decoder_rate

        return times_fit(task, start, options.fit, rate, costs)


class Roughness:
    """Mean squared differences of features between neighbours in space, of all planes, times the voxels."""

    name = "roughness"

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def __call__(self, moving: Any, seen: Sequence[tuple[float, VoxelGrid]]) -> Tensor:
        """Of the planes as they are."""
        found = list[Tensor]()
        for name, plane in moving.parameters().items():
            axes = (2,) if name in TIME_PLANES else (1, 2) if plane.ndim == 3 else ()
            found += [plane.diff(dim=axis).square().mean() for axis in axes if plane.shape[axis] > 1]
        return torch.stack(found).sum() * seen[0][1].values.numel()


class Jerkiness:
    """Mean squared second differences in time of the features of the planes of time, times the voxels."""

    name = "jerkiness"

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def __call__(self, moving: Any, seen: Sequence[tuple[float, VoxelGrid]]) -> Tensor:
        """Of the planes as they are; zero where there are no three nodes."""
        planes = [plane for name, plane in moving.parameters().items() if name in TIME_PLANES]
        if planes[0].shape[1] < 3:
            return planes[0].new_zeros(())
        bends = [plane.diff(n=2, dim=1).square().mean() for plane in planes]
        return torch.stack(bends).sum() * seen[0][1].values.numel()


@checked_dataclass
class LowRank(Method):
    """Options of voxels of low rank, and of their start."""

    kind: ClassVar[str] = "low-rank"
    of_series: ClassVar[bool] = True
    likelier: ClassVar[bool] = True

    volume: HolographicTV = field(default_factory=usual_start)
    """The start: each time by itself, of which the nearest matter of low rank is taken."""
    rank: Natural = 8
    """Volumes (at most as many as times)."""
    rate: Rate = 0.003
    """Adam's first rate of the volumes, whose courses have a mean square of one."""
    course_rate: Rate = 0.002
    """The same of the courses."""
    fit: TimesFit = field(default_factory=TimesFit)
    """The fit through the waves."""

    def stages(self) -> Sequence[Stage]:
        """Each time by itself, and the fit."""
        return (EachTimeStage(self.volume), LowRankStage(self))


@dataclass(frozen=True)
class LowRankStage:
    """The fit of volumes and courses."""

    options: LowRank
    name: str = "voxels of low rank through the waves"

    def start(self, task: Task, before: Stored | None) -> LowRankVoxels:
        """The nearest matter of low rank to the volumes of the times."""
        assert isinstance(before, VoxelSeries)
        return LowRankVoxels.nearest(before, self.options.rank)

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit to the training frames."""
        rates = {"volumes": self.options.rate, "courses": self.options.course_rate}
        return times_fit(task, start, self.options.fit, rates.__getitem__)
