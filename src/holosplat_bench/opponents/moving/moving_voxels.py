"""Matter on voxels at several times, as Objects: a volume for each time, and a few volumes that courses of time mix."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from holosplat.backends import in_main_memory
from holosplat.checks import require, require_shapes
from holosplat.display import of_object
from holosplat.geometry import Grid, Poses, Views
from holosplat.matter import Matter
from holosplat.representations.flow import TimeBasis
from holosplat.representations.voxels import VoxelGrid
from holosplat.volume import LineIntegrals, Volume


class OnVoxels:
    """Base of moving objects whose matter is an occupancy of one material on one grid at any time.

    A kind of it says `values(time)`, and which attributes are its trainable tensors (`names`), or `parameters()`, how
    tensors take the place of these (`_put`), and `state()`.

    grid: the voxels; times: [T] [s], in order, which it is made for; matter: of one material; upper: bound of the
    occupancy (0: none). Errors: `InputError` for more than one material, and times that do not grow.
    """

    kind: ClassVar[str]
    names: ClassVar[tuple[str, ...]] = ()
    _repr_html_ = of_object

    def __init__(self, grid: Grid, times: Sequence[float] | np.ndarray, matter: Matter, upper: float = 0.0) -> None:
        when = np.asarray(times, dtype=np.float64).reshape(-1)
        require(matter.single, "voxels of several times need one material, but there are two, or δ and β are apart.")
        require(len(when) >= 2 and bool((np.diff(when) > 0).all()), "times must be two or more, and must grow.")
        require(upper >= 0, f"upper must not be negative, but it is {upper:g}.")
        self.grid, self.times, self.matter, self.upper, self.backend = grid, when, matter, float(upper), "cpu"
        self._still = VoxelGrid(torch.zeros(1, *grid.shape), grid, matter)

    def values(self, time: float) -> Tensor:
        """Occupancies [Z, Y, X] at `time` [s]."""
        raise NotImplementedError

    def parameters(self) -> dict[str, Tensor]:
        """The trainable tensors, by name."""
        return {name: getattr(self, name) for name in self.names}

    def _put(self, parameters: Mapping[str, Tensor]) -> None:
        for name in self.names:
            setattr(self, name, parameters.get(name, getattr(self, name)))

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same matter of."""
        return {**self.parameters(), **self._plain()}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Self:
        """The same matter with other tensors in the place of those named; it shares the projectors that are ready."""
        found = copy.copy(self)
        found._put(parameters)
        return found

    def between(self, time: float) -> Tensor:
        """What each of the times counts at `time` [s] [T], float64: linear between them, and held beyond."""
        return torch.from_numpy(shares(self.times, time))

    @property
    def basis(self) -> TimeBasis:
        """Straight lines in time from the first time to the last, by which others ask where these are."""
        return TimeBasis(float(self.times[0]), float(self.times[-1]), 1)

    def at(self, time: float) -> VoxelGrid:
        """The matter on voxels at `time` [s], between frames too; differentiable in the parameters."""
        return self._still.with_parameters({"values": self.values(float(time))[None]})

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D) at the first time."""
        return self.at(float(self.times[0])).project(views)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid` at the first time."""
        return self.at(float(self.times[0])).voxelise(grid)

    def on(self, backend: str) -> Self:
        """The same for another backend (resolved); it runs on the CPU."""
        found = self.with_parameters({name: tensor.cpu() for name, tensor in self.parameters().items()})
        found.backend = in_main_memory(backend)
        return found

    def enclosing_grid(self, most_voxels: int) -> Grid:
        """The grid itself, whatever its size."""
        return self.grid

    def _plain(self) -> dict[str, Any]:
        """What `_from_plain` reads of `state()`."""
        return {
            "shape": list(self.grid.shape),
            "voxel_size": list(self.grid.voxel_size),
            "origin": list(self.grid.origin),
            "times_s": self.times.tolist(),
            "matter": self.matter.as_dict(),
            "upper": self.upper,
        }


def from_plain(state: Mapping[str, Any]) -> tuple[Grid, np.ndarray, Matter, float]:
    """Grid, times [s], matter and bound of an object `OnVoxels` that a `state()` tells."""
    size, origin = (tuple(float(v) for v in state[name]) for name in ("voxel_size", "origin"))
    grid = Grid(tuple(int(n) for n in state["shape"]), size, origin)  # type: ignore[arg-type]
    times = np.array([float(time) for time in state["times_s"]])
    return grid, times, Matter.from_dict(state["matter"]), float(state["upper"])


def shares(nodes: np.ndarray, place: float) -> np.ndarray:
    """What each of `nodes` [K], in order, counts at `place` [K]: linear between them, and held beyond."""
    return np.array([np.interp(place, nodes, row) for row in np.eye(len(nodes))])


class VoxelSeries(OnVoxels):
    """A volume of each time: occupancies linear in time between these.

    volumes: [T, Z, Y, X] float32. Errors: `InputError` if the shapes do not fit.
    """

    kind: ClassVar[str] = "voxel-series"
    names: ClassVar[tuple[str, ...]] = ("volumes",)

    def __init__(
        self, volumes: Tensor, grid: Grid, times: Sequence[float] | np.ndarray, matter: Matter, upper: float = 0.0
    ) -> None:
        super().__init__(grid, times, matter, upper)
        require_shapes("{} of a voxel series", {"volumes": volumes}, {"volumes": (len(self.times), *grid.shape)})
        self.volumes = volumes

    def values(self, time: float) -> Tensor:
        """Occupancies [Z, Y, X] at `time` [s]."""
        weights = shares(self.times, time)
        return torch.stack([float(weights[k]) * self.volumes[k] for k in np.flatnonzero(weights)]).sum(0)

    @property
    def described(self) -> str:
        """How large it is, in words."""
        return " × ".join(map(str, self.grid.shape)) + f" voxels at {len(self.times)} times"

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> VoxelSeries:
        """The series that `state` described; `InputError` where it does not fit together."""
        return cls(state["volumes"], *from_plain(state))


class LowRankVoxels(OnVoxels):
    """Occupancies that are sums of a few volumes, each times a course of time: a matrix of voxels and times of low rank
    (partial separability: Liang 2007, "Spatiotemporal imaging with partially separable functions", eq. 2).

    What is below zero, or above `upper` (0: no such bound), counts as these (`held`).

    volumes: [R, Z, Y, X]; courses: [R, T], linear between the times. Errors: `InputError` if the shapes do not fit.
    """

    kind: ClassVar[str] = "low-rank-voxels"
    names: ClassVar[tuple[str, ...]] = ("volumes", "courses")

    def __init__(
        self,
        factors: tuple[Tensor, Tensor],
        grid: Grid,
        times: Sequence[float] | np.ndarray,
        matter: Matter,
        upper: float = 0.0,
    ) -> None:
        """factors: the volumes and the courses."""
        super().__init__(grid, times, matter, upper)
        volumes, courses = factors
        rank = volumes.shape[0] if volumes.ndim else 0
        require(rank >= 1, "voxels of low rank need one volume at least.")
        wanted = {"volumes": (rank, *grid.shape), "courses": (rank, len(self.times))}
        require_shapes("{} of voxels of low rank", {"volumes": volumes, "courses": courses}, wanted)
        self.volumes, self.courses = volumes, courses

    @classmethod
    def nearest(cls, series: VoxelSeries, rank: int) -> LowRankVoxels:
        """The least-squares approximation of `series` of `rank` (at most the number of times).

        By the eigenvectors of the products of times, so that no matrix of voxels is decomposed (Eckart & Young 1936).
        Courses have a mean square of one.
        """
        count = len(series.times)
        flat = series.volumes.reshape(count, -1)
        found = np.linalg.eigh((flat @ flat.T).double().numpy())[1][:, ::-1][:, : min(rank, count)]
        signs = np.where(found.sum(0) < 0, -1.0, 1.0)  # or they would be those of the library
        courses = torch.from_numpy(np.ascontiguousarray((found * signs).T * np.sqrt(count))).to(flat)
        volumes = (courses @ flat / count).reshape(-1, *series.grid.shape)
        return cls((volumes, courses), series.grid, series.times, series.matter, series.upper)

    def values(self, time: float) -> Tensor:
        """Occupancies [Z, Y, X] at `time` [s]."""
        course = self.courses @ self.between(time).to(self.courses)
        return held(torch.tensordot(course, self.volumes, dims=1), self.upper)

    @property
    def described(self) -> str:
        """How large it is, in words."""
        voxels = " × ".join(map(str, self.grid.shape))
        return f"{len(self.courses)} volumes of {voxels} voxels that mix at {len(self.times)} times"

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> LowRankVoxels:
        """The matter that `state` described; `InputError` where it does not fit together."""
        return cls((state["volumes"], state["courses"]), *from_plain(state))


def held(values: Tensor, upper: float) -> Tensor:
    """`values` of any shape between 0 and `upper` (0: no upper bound).

    Beyond a bound the slope is that of the values themselves where a descent along it leads back, and zero where it
    would lead further away.
    """
    found = _Held.apply(values, upper if upper > 0 else float("inf"))
    assert isinstance(found, Tensor)
    return found


class _Held(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, upper: float) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(values)
        ctx.upper = upper
        return values.clamp(0.0, upper)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        (values,) = ctx.saved_tensors
        away = ((values < 0) & (upstream > 0)) | ((values > ctx.upper) & (upstream < 0))
        return upstream.masked_fill(away, 0.0), None
