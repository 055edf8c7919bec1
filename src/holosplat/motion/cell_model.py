"""A model of whole cells in a channel, put on surfaces that were seen, and fitted to how these moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ..checks import InputError
from ..mesh import TriangleMesh, areas, normals
from ..ranges import Signed, Small, ranged
from ..specimens.flow.suspension import Channel, Medium
from ..specimens.membrane.model import Elasticity, Membrane
from ..specimens.membrane.rest import resting_cell
from .membrane_fit import Bound, CellFlow, Unknowns, Velocity, advanced, dressed, scaled

ENDLESS = 1e-3
"""Length of the channel [m]: no field holds cells that feel each other around it."""
FREQUENCY = 4
"""Of the membranes' meshes: 162 nodes."""
STABLE = 0.9
"""Fastest time of a membrane in units of viscosity × radius over the modulus of area."""
SHEARED = 0.25
"""Longest step times the greatest shear rate of the channel: after 20 steps, places are off by a nanometre."""
REACH = 3.0
"""Cells whose centres are farther apart than so many radii do not feel each other's flow."""
PRIOR = 0.01
"""Standard deviation of what is wrong with the flow about a cell, as a share of the peak: what walls would answer."""
NOISE = 0.03e-6
"""Of the paths' surfaces along their normals [m]: what tracks of four beams have."""
INDEPENDENT = 20.0
"""Points of a surface whose errors are independent: its fit is smooth."""
CHANGES = (0.02, 0.3)
"""Relative changes of peak and shear modulus in finite differences."""
FINER = (1, 4, 16)
"""By how much steps are shortened where the motion is not smooth; the fastest time by its square."""
ROUGH = 0.01e-6
"""Error of a step over a cell [m] from which on it is too long: cells that overlap push each other apart at once."""
LEAP = 3.0
"""How far a node gets at most, in the way of the flow and a radius; beyond, the motion has become unstable."""
AXES = "xyz"
Range = tuple[float, float]


@dataclass(frozen=True)
@ranged
class ChannelFrame:
    """A rectangular channel in the object frame.

    axis: of the flow; across: its extents [m] along the two other axes, in the order x, y, z; centre: [m] of its
    section, of which the part along the flow does not matter; back: whether the flow goes the other way along the axis.
    Errors: `InputError` for extents that are none.
    """

    across: tuple[Small, Small]
    axis: Literal["x", "y", "z"] = "y"
    centre: tuple[Signed, Signed, Signed] = (0.0, 0.0, 0.0)
    back: bool = False

    @property
    def channel(self) -> Channel:
        """In its own frame, with a peak of 1 m/s."""
        return Channel((ENDLESS, *self.across), 1.0)

    def inward(self, points: np.ndarray) -> np.ndarray:
        """`points` [..., 3] [m] of the object frame in the channel's, whose x is along the flow."""
        return (points - np.asarray(self.centre)) @ self.rotation.T + self._middle()

    def outward(self, points: np.ndarray) -> np.ndarray:
        """The other way."""
        return (points - self._middle()) @ self.rotation + np.asarray(self.centre)

    def outside(self, points: Tensor) -> Tensor:
        """As `outward`, of a tensor."""
        turn, middle, centre = (torch.from_numpy(np.asarray(x)) for x in (self.rotation, self._middle(), self.centre))
        return (points - middle) @ turn + centre

    @property
    def rotation(self) -> np.ndarray:
        """[3, 3] from the object frame to the channel's."""
        along = AXES.index(self.axis)
        order = [along, *(k for k in range(3) if k != along)]
        rotation = np.eye(3)[order]
        rotation[0] *= -1 if self.back else 1
        rotation[2] *= np.sign(np.linalg.det(rotation))
        return rotation

    def _middle(self) -> np.ndarray:
        return np.array([0.0, *(0.5 * extent for extent in self.across)])


@dataclass(frozen=True)
class Fitted:
    """The model fitted to a window of times.

    unknowns: peak and modulus; told: standard errors of their logarithms over those before, by name (near 1: the window
    says nothing); wrong: velocity [C, 3] [m/s] and gradient [C, 3, 3] [1/s] of a flow beside; left: [C] m, along the
    normals at the window's end, what the model misses.
    """

    unknowns: Unknowns
    told: dict[str, float]
    wrong: tuple[Tensor, Tensor]
    left: np.ndarray


class _Unstable(Exception):
    """Nodes have left the reach of any smooth motion."""


class CellModel:
    """Red cells in the channel of `frame`, all of one rest shape and one set of moduli.

    meshes: whose median volume the rest shape takes; shear: modulus [N/m] at which membranes are laid on surfaces;
    viscosity: [Pa s]; frequency: of the membranes' meshes, as of `resting_cell`.
    """

    def __init__(
        self,
        frame: ChannelFrame,
        meshes: Sequence[TriangleMesh],
        shear: float,
        viscosity: float,
        frequency: int = FREQUENCY,
    ) -> None:
        self.frame = frame
        self.membrane = Membrane(scaled(resting_cell(frequency), meshes), Elasticity(skalak_shear=shear))
        self.radius = float((self.membrane.rest.surface / (4 * np.pi)).sqrt())
        self.fastest = STABLE * viscosity * self.radius / self.membrane.elasticity.global_area
        self._medium = Medium(viscosity, reach=min(REACH * self.radius, 0.5 * ENDLESS))

    def dressed(self, meshes: Sequence[TriangleMesh]) -> tuple[CellFlow, Tensor, list[Bound]]:
        """The flow, the membranes' nodes [C, P, 3] [m] in the channel's frame, and what binds surfaces to them."""
        inside = [TriangleMesh(self.frame.inward(mesh.vertices), mesh.faces) for mesh in meshes]
        nodes = dressed(inside, self.membrane)
        bound = [Bound.of(mesh.vertices, one, self.membrane.mesh.faces) for mesh, one in zip(inside, nodes)]
        tensor = torch.from_numpy(nodes)
        return CellFlow(self.membrane, tensor, self.frame.channel, self._medium), tensor, bound

    def run(
        self,
        meshes: Sequence[TriangleMesh],
        times: np.ndarray,
        unknowns: Unknowns,
        wrong: tuple[Tensor, Tensor] | None = None,
    ) -> list[np.ndarray]:
        """Run the model from the surfaces `meshes` at `times[0]`: places [T, Q, 3] [m] at `times` [T] s.

        wrong: velocity [C, 3] and gradient [C, 3, 3] of a flow beside, about each cell.
        """
        return self._run(self.dressed(meshes), times, unknowns, wrong)

    def _run(
        self,
        start: tuple[CellFlow, Tensor, list[Bound]],
        times: np.ndarray,
        unknowns: Unknowns,
        wrong: tuple[Tensor, Tensor] | None,
    ) -> list[np.ndarray]:
        flow, nodes, bound = start

        def velocity(nodes: Tensor) -> Tensor:
            found = flow.velocity(nodes, unknowns)
            if wrong is None:
                return found
            about = nodes - nodes.mean(1, keepdim=True)
            return found + wrong[0][:, None] + torch.einsum("cxy,cpy->cpx", wrong[1], about)

        states = [nodes]
        with torch.no_grad():
            for wait in np.diff(times):
                states.append(self._advance(velocity, states[-1], float(wait), float(unknowns.peak)))
        outward = self.frame.outward
        return [np.array([outward(one.places(at[cell]).numpy()) for at in states]) for cell, one in enumerate(bound)]

    def steps(self, peak: float, finer: int) -> tuple[float, float]:
        """The longest step [s], and the fastest time [s] of what relaxes in it, as of `advanced`."""
        step = SHEARED * min(self.frame.across) / (4 * max(peak, torch.finfo(torch.float64).tiny))
        return step / finer, self.fastest / finer**2

    def _advance(self, velocity: Velocity, nodes: Tensor, wait: float, peak: float) -> Tensor:
        """Nodes later, in finer steps where the usual ones are too long: where a node leaves the reach of its flow, or
        a cell is off by more than `ROUGH` in a step, by the method's own estimate."""
        reach = LEAP * (peak * wait + self.radius)

        def within(places: Tensor) -> Tensor:
            away = float((places - nodes).abs().max())
            if not away < reach:
                raise _Unstable
            return velocity(places)

        for finer in FINER:

            def check(before: Tensor, after: Tensor, step: float, last: bool = finer == FINER[-1]) -> None:
                off = 0.8 * (before - after) + 0.4 * step * (within(before) + within(after))
                if not last and float(off.square().sum(-1).mean(-1).max()) > ROUGH**2:
                    raise _Unstable

            try:
                return advanced(within, nodes, wait, *self.steps(peak, finer), check)
            except _Unstable:
                continue
        raise InputError(
            "the motion of the cells must be smooth, but it is not in steps of "
            f"{self.steps(peak, FINER[-1])[0]:.2g} s; lower the shear modulus or the peak, or raise the viscosity."
        )

    def peak_of(self, places: Sequence[np.ndarray], speeds: Sequence[np.ndarray]) -> float:
        """Peak [m/s] of the flow that carries surfaces at `places` [Q, 3] [m] with `speeds` [Q, 3] [m/s].

        A cell without force goes with the mean of the flow about it, here over its surface.
        """
        profile = [self.frame.channel.speed(torch.from_numpy(self.frame.inward(x))).mean().item() for x in places]
        along = [float(v.mean(0) @ self.frame.rotation[0]) for v in speeds]
        return float(np.dot(profile, along) / np.dot(profile, profile))

    def fitted(
        self,
        meshes: Sequence[TriangleMesh],
        seen: Sequence[np.ndarray],
        times: np.ndarray,
        ranges: dict[str, Range],
        free: bool,
    ) -> Fitted:
        """Peak and shear modulus within their ranges, and the flow beside, that tell best how the surfaces moved.

        From `meshes`, to places `seen` of each [T, Q, 3] [m] at `times` [T] s, along their normals. One step of Gauss
        and Newton from the ranges' geometric means, whose ends are two standard deviations away.
        free: whether there is a flow beside.
        """
        start = self.dressed(meshes)
        middle = {name: float(np.sqrt(low * high)) for name, (low, high) in ranges.items()}
        said = self._run(start, times, Unknowns.of(**middle), None)
        compared = [_Compared.of(mesh, one, places, times) for mesh, one, places in zip(meshes, seen, said)]
        slopes, widths = [], {}
        for (name, (low, high)), change in zip(ranges.items(), CHANGES):
            if high > low:
                changed = self._run(start, times, Unknowns.of(**(middle | {name: middle[name] * (1 + change)})), None)
                slopes.append([one.along(places) / np.log1p(change) for one, places in zip(compared, changed)])
                widths[name] = 0.25 * float(np.log(high / low))
        speed = PRIOR * middle["peak"] if free else 0.0
        values, errors, wrong, left = _solve(compared, slopes, list(widths.values()), (speed, self.radius))
        moved = {name: middle[name] * float(np.exp(value)) for name, value in zip(widths, values)}
        told = {name: error / width for (name, width), error in zip(widths.items(), errors)}
        return Fitted(Unknowns.of(**(middle | moved)), told, self._inward(wrong), left)

    def _inward(self, wrong: np.ndarray) -> tuple[Tensor, Tensor]:
        """Velocities and gradients [C, 12] of the object frame in the channel's."""
        turn = self.frame.rotation
        velocity, gradient = wrong[:, :3] @ turn.T, turn @ wrong[:, 3:].reshape(-1, 3, 3) @ turn.T
        return torch.from_numpy(velocity.copy()), torch.from_numpy(gradient.copy())


@dataclass(frozen=True)
class _Compared:
    """A cell's surface compared with the model: missed [T, Q] [m] along normals, root weights [Q], and what a velocity
    and a gradient beside would change [T, Q, 12] [m per m/s, per 1/s]."""

    said: np.ndarray
    normals: np.ndarray
    roots: np.ndarray
    missed: np.ndarray
    beside: np.ndarray

    @classmethod
    def of(cls, mesh: TriangleMesh, seen: np.ndarray, said: np.ndarray, times: np.ndarray) -> _Compared:
        weights = areas(mesh)
        roots = np.sqrt(weights / weights.sum() * INDEPENDENT / (len(times) - 1)) / NOISE
        outward = np.array([normals(TriangleMesh(x, mesh.faces)) for x in seen[1:]])
        about = said[1:] - said[1:].mean(1, keepdims=True)
        linear = np.einsum("tqi,tqj->tqij", outward, about).reshape(*outward.shape[:2], 9)
        waits = (times[1:] - times[0])[:, None, None]
        found = cls(said, outward, roots, np.zeros(0), waits * np.concatenate([outward, linear], axis=2))
        return replace(found, missed=found.along(seen))

    def along(self, places: np.ndarray) -> np.ndarray:
        """[T, Q] how far `places` are off what was said, along normals."""
        return ((places[1:] - self.said[1:]) * self.normals).sum(2)


def _solve(
    compared: Sequence[_Compared], slopes: list[list[np.ndarray]], widths: list[float], beside: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The likeliest values of the common unknowns and their standard errors, the flows beside [C, 12], and what is left
    at the last time [C] m, root-mean-square.

    slopes: of each common unknown, of each cell [T, Q]; widths: their prior deviations; beside: of the flow's velocity
    [m/s] (0: there is none), and the radius over which its gradient makes as much.
    """
    common, speed = len(widths), beside[0]
    size = common + 12 * len(compared) * (speed > 0)
    matrix, right = np.zeros((size, size)), np.zeros(size)
    matrix[range(common), range(common)] = 1 / np.square(widths)
    columns = []
    for c, one in enumerate(compared):
        parts = [slope[c][..., None] for slope in slopes] + ([one.beside] if speed else [])
        where = [*range(common), *(range(common + 12 * c, common + 12 * c + 12) if speed else ())]
        columns.append((where, np.concatenate(parts, axis=2) if parts else np.zeros((*one.missed.shape, 0))))
        rows = (columns[-1][1] * one.roots[:, None]).reshape(one.missed.size, -1)
        matrix[np.ix_(where, where)] += rows.T @ rows
        right[where] += rows.T @ (one.missed * one.roots).ravel()
        if speed:
            own = where[common:]
            matrix[own, own] += np.repeat([1 / speed**2, (beside[1] / speed) ** 2], [3, 9])
    found = np.linalg.solve(matrix, right) if size else right
    errors = np.sqrt(np.diag(np.linalg.inv(matrix))[:common]) if size else right
    wrong = found[common:].reshape(-1, 12) if speed else np.zeros((len(compared), 12))
    left = []
    for (where, columns_of), one in zip(columns, compared):
        misses = one.missed[-1] - columns_of[-1] @ found[where]
        left.append(np.sqrt((misses**2 * one.roots**2).sum() / (one.roots**2).sum()))
    return found[:common], errors, wrong, np.array(left)
