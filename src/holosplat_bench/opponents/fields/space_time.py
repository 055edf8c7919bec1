"""Matter and its velocity as fields of space and time: an occupancy of B-splines, and a flow of a small perceptron."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from holosplat.backends import in_main_memory
from holosplat.checks import require, require_shapes
from holosplat.display import of_object
from holosplat.geometry import Grid, Poses, Views
from holosplat.matter import Matter
from holosplat.ranges import Positive, checked_dataclass
from holosplat.representations.flow import Lattice, TimeBasis
from holosplat.representations.voxels import VoxelGrid, along_axes
from holosplat.tables import from_table, to_table
from holosplat.volume import LineIntegrals, Volume

from .perceptron import Jet, VelocityNetwork

FLOW = "flow."
"""Before the names of the velocity's weights."""
COEFFICIENTS = "coefficients"
"""The name of those of the occupancy's splines."""
EMPTIEST = 0.01
"""Distance of an occupancy from its bounds, as a share of them, that a start may have: beyond it nothing pulls."""


@checked_dataclass
class SpaceTime:
    """Options of the field."""

    cell_px: Positive = 2.0
    """Distance of the nodes of the occupancy's splines in space [voxel edges]."""
    degree: int = 2
    """Of its splines of time."""
    pieces: int = 0
    """Of these (0: as many coefficients as times)."""
    velocity: VelocityNetwork = field(default_factory=VelocityNetwork)
    """The network of the velocity."""

    def basis(self, times: np.ndarray) -> TimeBasis:
        """The splines of `times` [T] [s]."""
        degree = min(self.degree, len(times) - 1)
        return TimeBasis(float(times[0]), float(times[-1]), degree, self.pieces or max(1, len(times) - degree))


@dataclass(frozen=True)
class Frame:
    """The units of the equations: places from the middle of the field in halves of its longest edge, times from the
    middle of the scan in halves of its length, so that all of it lies within -1 and 1.

    middle: `(x, y, z)` [m]; half: [m]; noon: the middle of the times [s]; duration: half of them [s].
    """

    middle: tuple[float, float, float]
    half: float
    noon: float
    duration: float

    @classmethod
    def of(cls, grid: Grid, basis: TimeBasis) -> Frame:
        """That of a grid and the times of a basis."""
        x, y, z = (float(v) for v in grid.centre)
        half = 0.5 * max(n * size for n, size in zip(grid.shape[::-1], grid.voxel_size))
        return cls((x, y, z), half, 0.5 * (basis.first + basis.last), 0.5 * (basis.last - basis.first))

    def time(self, time: float) -> float:
        """A time [s] in these units."""
        return (time - self.noon) / self.duration

    def seconds(self, time: float) -> float:
        """The time [s] of one in these units."""
        return self.noon + time * self.duration

    def places(self, points: Tensor) -> Tensor:
        """Points [P, 3] [m] in these units."""
        return (points - torch.tensor(self.middle).to(points)) / self.half


class SpaceTimeField:
    """Matter on the box of `grid` (cubic voxels) that a velocity field carries, or that changes as it likes.

    The occupancy is `upper · sigmoid(u)` (upper 0: softplus(u), without a bound); u is a sum of cubic B-splines of
    space and splines of time. Line integrals and volumes are those of its values at the centres of the voxels. The
    velocity is that of a perceptron (`VelocityNetwork`). What binds the two, terms of a fit say
    (`fit.terms.equations`); the field itself does not.

    coefficients: [K, Z, Y, X] of u on the nodes of `lattice` (voxel edges about the middle of the grid) in the `basis`
    of time; weights: of the network. Errors: `InputError` where the arrays do not fit, for voxels that are no cubes,
    for more than one material, and for a basis that stands still.
    """

    kind: ClassVar[str] = "space-time-field"
    """The name of this kind of Object in files."""
    _repr_html_ = of_object

    def __init__(
        self,
        coefficients: Tensor,
        weights: Mapping[str, Tensor],
        grid: Grid,
        basis: TimeBasis,
        matter: Matter,
        options: SpaceTime = SpaceTime(),
        upper: float = 1.0,
    ) -> None:
        require(np.allclose(grid.voxel_size, grid.voxel_size[0]), "a space-time field needs a grid of cubic voxels.")
        require(matter.single, "a space-time field needs one material, but there are two, or δ and β are apart.")
        require(upper >= 0, f"upper must not be negative, but it is {upper:g}.")
        require(basis.first < basis.last, "a space-time field needs times that grow; give two or more.")
        self.lattice = lattice_of(grid, options.cell_px)
        lattice = torch.empty(basis.count, *self.lattice.counts, device="meta")  # of its shape alone
        wanted = {COEFFICIENTS: lattice, **options.velocity.started(0)}
        require_shapes("{} of a space-time field", {**weights, COEFFICIENTS: coefficients}, wanted)
        self.coefficients, self.grid, self.basis, self.matter = coefficients, grid, basis, matter
        self.weights, self.options, self.upper, self.backend = dict(weights), options, float(upper), "cpu"
        self.frame = Frame.of(grid, basis)
        self._axes = _axes(self.lattice, grid)
        self._still = VoxelGrid(coefficients.new_zeros(1, *grid.shape), grid, matter)

    @classmethod
    def still(
        cls,
        values: Tensor,
        grid: Grid,
        times: np.ndarray,
        matter: Matter,
        options: SpaceTime = SpaceTime(),
        seed: int = 0,
        upper: float = 1.0,
    ) -> SpaceTimeField:
        """The field whose occupancies at `times` [T] [s] are near `values` [T, Z, Y, X], and whose flow hardly moves.

        u is taken from values smoothed to the splines' nodes, a hundredth off its bounds at least.
        """
        basis, lattice = options.basis(times), lattice_of(grid, options.cell_px)
        start = cls(
            torch.zeros(basis.count, *lattice.counts),
            options.velocity.started(seed),
            grid,
            basis,
            matter,
            options,
            upper,
        )
        most = upper or 1.0
        inner = values.float().clamp(EMPTIEST * most, (1 - EMPTIEST) * most if upper else float("inf"))
        raw = torch.logit(inner / upper) if upper else inner + torch.log(-torch.expm1(-inner))
        inverse = tuple(torch.linalg.pinv(axis.double(), rtol=1e-3) for axis in start._axes)
        nodes = torch.stack([along_axes(each, inverse) for each in raw.double()])  # pyright: ignore[reportArgumentType]
        fitted = basis.fitted(*_between(times, nodes.numpy(), basis.count))
        return start.with_parameters({"coefficients": torch.from_numpy(fitted).float()})

    def parameters(self) -> dict[str, Tensor]:
        """The trainable tensors, by name; those of the velocity begin with `flow.`."""
        return {"coefficients": self.coefficients, **{FLOW + name: weight for name, weight in self.weights.items()}}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> SpaceTimeField:
        """The same field with other tensors in the place of those named; it shares the projectors that are ready."""
        found = copy.copy(self)
        found.coefficients = parameters.get("coefficients", self.coefficients)
        found.weights = {name: parameters.get(FLOW + name, mine) for name, mine in self.weights.items()}
        return found

    def values(self, time: float) -> Tensor:
        """Occupancies [Z, Y, X] at the centres of the voxels at `time` [s]."""
        return self._bounded(along_axes(self._now(time), self._axes))

    def _now(self, time: float, derivative: int = 0) -> Tensor:
        weights = torch.from_numpy(self.basis.weights(time, derivative)[0]).to(self.coefficients)
        return torch.einsum("k,kzyx->zyx", weights, self.coefficients)

    def _bounded(self, raw: Tensor) -> Tensor:
        return self.upper * torch.sigmoid(raw) if self.upper > 0 else softplus(raw)

    def density(self, points: Tensor, time: float) -> Jet:
        """Occupancy at `points` [P, 3] at `time`, slopes by place and rate by time, all in units of `frame`."""
        unit, seconds = self.edges, self.frame.seconds(time)
        raw, rate, slope = _local(self.lattice, self._now(seconds), self._now(seconds, 1), points * unit)
        value = self._bounded(raw)
        steep = value * (1 - value / self.upper) if self.upper > 0 else torch.sigmoid(raw)
        return Jet(value, steep[:, None] * slope * unit, steep * rate * self.frame.duration)

    def flow(self, points: Tensor, time: float, *, curved: bool = False) -> tuple[Jet, Jet]:
        """Velocity and pressure at `points` [P, 3] at `time`, in units of `frame`; curved: with the Laplacian of v."""
        return self.options.velocity.jets(self.weights, _instant(points, time), curved)

    @property
    def edges(self) -> float:
        """Voxel edges in the unit of length of `frame`."""
        return self.frame.half / self.grid.voxel_size[0]

    def velocities(self, points: Tensor, time: float) -> Tensor:
        """Velocity alone [P, 3] at `points` [P, 3] at `time`, in units of `frame`."""
        return self.options.velocity.values(self.weights, _instant(points, time))

    def velocity(self, points: Tensor, time: float) -> Tensor:
        """Velocity [P, 3] [m/s] at `points` [P, 3] `(x, y, z)` [m] at `time` [s]."""
        found = self.velocities(self.frame.places(points).to(self.coefficients), self.frame.time(time))
        return found * (self.frame.half / self.frame.duration)

    def at(self, time: float) -> VoxelGrid:
        """The matter on voxels at `time` [s], between frames too."""
        return self._still.with_parameters({"values": self.values(float(time))[None]})

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D) at the first time."""
        return self.at(self.basis.first).project(views)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid` at the first time."""
        return self.at(self.basis.first).voxelise(grid)

    def on(self, backend: str) -> SpaceTimeField:
        """The field for another backend (resolved); it runs on the CPU."""
        found = self.with_parameters({name: tensor.cpu() for name, tensor in self.parameters().items()})
        found.backend = in_main_memory(backend)
        return found

    @property
    def described(self) -> str:
        """How large it is, in words."""
        z, y, x = self.lattice.counts
        flow = "without divergence" if self.options.velocity.solenoidal else "with free components"
        return f"a field of {x} × {y} × {z} nodes and {self.basis.count} in time, and a flow {flow}"

    def enclosing_grid(self, most_voxels: int) -> Grid:
        """The grid itself, whatever its size."""
        return self.grid

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same field of."""
        return {
            "coefficients": self.coefficients,
            "weights": dict(self.weights),
            "shape": list(self.grid.shape),
            "voxel_size": list(self.grid.voxel_size),
            "origin": list(self.grid.origin),
            "basis": self.basis.as_dict(),
            "matter": self.matter.as_dict(),
            "options": to_table(self.options),
            "upper": self.upper,
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> SpaceTimeField:
        """The field that `state` described; `InputError` where it does not fit together."""
        size, origin = (tuple(float(v) for v in state[name]) for name in ("voxel_size", "origin"))
        shape = tuple(int(n) for n in state["shape"])
        grid, basis = Grid(shape, size, origin), TimeBasis.from_dict(state["basis"])  # type: ignore[arg-type]
        options = from_table(SpaceTime, state["options"], "options")
        matter, upper = Matter.from_dict(state["matter"]), float(state["upper"])
        return cls(state["coefficients"], state["weights"], grid, basis, matter, options, upper)


def _between(times: np.ndarray, nodes: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and values [T, …] as they are, or, where they are fewer than `count`, on straight lines between them."""
    if len(times) >= count:
        return times, nodes
    finer = np.linspace(times[0], times[-1], 2 * count)
    index = np.clip(np.searchsorted(times, finer, side="right") - 1, 0, len(times) - 2)
    part = ((finer - times[index]) / (times[index + 1] - times[index])).reshape(-1, *[1] * (nodes.ndim - 1))
    return finer, (1 - part) * nodes[index] + part * nodes[index + 1]


def lattice_of(grid: Grid, cell: float) -> Lattice:
    """Nodes `cell` voxel edges apart about the middle of `grid`, over all of it and one more on every side."""
    x, y, z = (float(n) for n in grid.shape[::-1])
    found = Lattice.around((x, y, z), max(1, round(max(x, y, z) / cell)))
    return found


def _instant(points: Tensor, time: float) -> Tensor:
    """Points [P, 3] at `time`: [P, 4]."""
    return torch.cat([points, torch.full_like(points[:, :1], time)], 1)


def _local(lattice: Lattice, now: Tensor, later: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Values [P] of the splines of `now` and of `later`, both [Z, Y, X], at `points` [P, 3], and ∂/∂x_j [P, 3] of
    `now`: of the 64 nodes about each point, for all others are zero there."""
    weights, index = list[list[Tensor]](), list[Tensor]()
    for axis, count in enumerate(lattice.counts[::-1]):
        place = (points[:, axis] - lattice.first[axis]) / lattice.cell
        near = place.floor()[:, None] + torch.arange(-1, 3).to(place)
        inside = (near >= 0) & (near < count)
        weights.append([inside * w for w in lattice.splines(place[:, None] - near, 1)])
        index.append(torch.where(inside, near, 0).long())
    (x, y, z), (_, ny, nx) = index, lattice.counts
    flat = (z[:, :, None, None] * ny + y[:, None, :, None]) * nx + x[:, None, None]
    found = torch.stack([now.flatten(), later.flatten()], 1)[flat]
    values = [torch.einsum("pzyxc,pz,py,px->pc", found, *(w[0] for w in weights[::-1]))]
    for axis in range(3):
        z, y, x = (weights[a][a == axis] for a in (2, 1, 0))
        values.append(torch.einsum("pzyx,pz,py,px->p", found[..., 0], z, y, x)[:, None])
    return values[0][:, 0], values[0][:, 1], torch.cat(values[1:], 1)


def _axes(lattice: Lattice, grid: Grid) -> tuple[Tensor, Tensor, Tensor]:
    """The splines at the centres of the voxels along z, y and x: [cells, nodes] each, float32."""
    found = []
    for axis, count in enumerate(grid.shape[::-1]):
        places = torch.zeros(count, 3, dtype=torch.float64)
        places[:, axis] = torch.arange(count, dtype=torch.float64) - 0.5 * (count - 1)
        found.append(lattice.weights(places, axis, 0)[0].float())
    x, y, z = found
    return z, y, x
