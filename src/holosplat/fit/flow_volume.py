"""The likeliest volume of continuous matter that a flow carries, by the frames of all times, and the likeliest flow.

On its way matter may become more or less, by a smooth field of the volume's places (`Fading`).

The volume is that of the flow's reference time. At the time t, a voxel has what the flow brought there: the value where
it came from, linear between voxels. Times are looked at one after another, so that memory does not grow with their
number.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from ..representations.flow import Fading, Flow, fading_factor
from .smooth_volume import ContinuousPrior, Slope, VolumeProblem
from .whitened import WhitenedFrames

SPARSE = 6.0
"""Distance [pixels] at most of the points that a flow carries back exactly; what lies between is linear."""


class FlowProblem:
    """½ χ² of the frames of several times and the prior of the volume u [Z, Y, X] ≥ 0 of the reference time.

    frames: of each time, of the same field; times: [s]; flow: what carries the volume, in `unit` pixels of the frames
    (its own pixels may be larger).
    """

    lower = 0.0

    def __init__(
        self,
        frames: Sequence[WhitenedFrames],
        times: Sequence[float],
        prior: ContinuousPrior,
        level: float,
        flow: Flow,
        unit: float,
    ) -> None:
        self.level, self._unit, self.times = level, unit, list(times)
        self._still = [VolumeProblem(one, prior, level) for one in frames]
        self.grid = self._still[0].grid
        self._points, self._coarse = _sparse_points(self._still[0], unit)
        self._fading: list[Tensor | None] = [None] * len(self.times)
        self.carry(flow)

    @property
    def count(self) -> int:
        """How many pixels all frames have."""
        return sum(one.frames.count for one in self._still)

    def carry(self, flow: Flow) -> None:
        """Take another flow."""
        with torch.no_grad():
            self._sources = [self._came_from(flow, time) for time in self.times]

    def fade(self, fading: Fading | None, flow: Flow) -> None:
        """Take another change of amplitudes, from the reference of `flow` on."""
        with torch.no_grad():
            self._fading = [None if fading is None else self._factor(fading, flow, time) for time in self.times]

    def _factor(self, fading: Fading, flow: Flow, time: float) -> Tensor:
        """The matter at `time` [Z, Y, X], as a share of what it was at the reference of `flow`."""
        values = fading.on([self._unit * torch.from_numpy(places) for places in self.grid.axes()])
        return fading_factor(values, (time - flow.reference) / (flow.basis.last - flow.basis.first))

    def at(self, u: Tensor, k: int) -> Tensor:
        """The volume [Z, Y, X] of the time numbered k."""
        return _carried(u, self._sources[k], self._fading[k])

    def __call__(self, u: Tensor) -> tuple[float, Slope]:
        """The objective and its gradient [Z, Y, X], computed at once: graphs of all times would take memory."""
        value, gradient = 0.0, torch.zeros_like(u)
        for k, still in enumerate(self._still):
            with torch.enable_grad():
                leaf = u.detach().requires_grad_()
                now = self.at(leaf, k)
                misfit = still.frames(still.lines(now.detach()))
                (pulled,) = torch.autograd.grad(now, leaf, still.backprojection(misfit.gradient))
            value, gradient = value + misfit.value, gradient + pulled
        prior, pull = self._still[0].penalty(u)
        return value + prior, lambda: pull(gradient)

    def preconditioner(self, u: Tensor) -> Callable[[Tensor], Tensor]:
        """About the inverse of the second derivative, as if nothing moved."""
        return self._still[0].preconditioner(u, len(self._still))

    def misfit(self, u: Tensor) -> list[float]:
        """½ χ² of every time."""
        return [s.frames(s.lines(self.at(u, k).detach())).value for k, s in enumerate(self._still)]

    @torch.no_grad()
    def residuals(self, u: Tensor) -> Tensor:
        """[F, H, W] of the amplitudes of all frames, over their noise: white where nothing is left unexplained."""
        left = list[Tensor]()
        for k, still in enumerate(self._still):
            frames = still.frames
            missing = torch.fft.rfft2(frames.amplitudes(still.lines(self.at(u, k))) - frames.measured)
            left.append(torch.fft.irfft2(missing / frames.power.sqrt(), s=frames.shape))
        return torch.cat(left)

    def flow_misfit(self, u: Tensor, flow: Flow) -> float:
        """½ χ² of `u` carried by `flow`; its gradient is added to those of the flow's parameters, time by time."""
        value = 0.0
        for time, still, factor in zip(self.times, self._still, self._fading):
            source = self._came_from(flow, time)
            value += _pulled(still, _carried(u, source, factor))
        return value

    def fading_misfit(self, u: Tensor, fading: Fading, flow: Flow) -> float:
        """½ χ² of `u` carried by the flow that was taken, with other amplitudes; the gradient is added to that of the
        fading's coefficients. flow: whose times count."""
        value = 0.0
        for time, still, source in zip(self.times, self._still, self._sources):
            value += _pulled(still, _carried(u, source, self._factor(fading, flow, time)))
        return value

    def _came_from(self, flow: Flow, time: float) -> Tensor | None:
        """Reference positions of each voxel's matter at `time`, as `grid_sample` takes them; None: unchanged."""
        if time == flow.reference:
            return None
        moved = flow.carried(self._points.to(flow.potential), time, flow.reference) / self._unit
        z, y, x = self._coarse
        field = moved.reshape(z, y, x, 3).permute(3, 0, 1, 2)[None]
        fine = interpolate(field, size=self.grid.shape, mode="trilinear", align_corners=True)[0].permute(1, 2, 3, 0)
        origin, size = (torch.tensor(v, dtype=fine.dtype) for v in (self.grid.origin, self.grid.voxel_size))
        counts = torch.tensor(self.grid.shape[::-1], dtype=fine.dtype)
        return 2 * (fine - origin) / (size * (counts - 1).clamp_min(1)) - 1


def _pulled(still: VolumeProblem, now: Tensor) -> float:
    """½ χ² of the volume `now`, whose gradient goes on to what it was made of."""
    misfit = still.frames(still.lines(now.detach()))
    if now.requires_grad:
        now.backward(still.backprojection(misfit.gradient))
    return misfit.value


def _carried(u: Tensor, source: Tensor | None, factor: Tensor | None) -> Tensor:
    now = u if factor is None else u * factor
    return now if source is None else _sampled(now, source)


def _sparse_points(still: VolumeProblem, unit: float) -> tuple[Tensor, tuple[int, int, int]]:
    """Points [P, 3] of a lattice over the voxels' middles, in the flow's unit, and its counts along z, y and x."""
    axes, counts = [], []
    for places in still.grid.axes()[::-1]:
        count = max(2, round((len(places) - 1) * unit / SPARSE) + 1)
        axes.append(unit * torch.linspace(float(places[0]), float(places[-1]), count))
        counts.append(count)
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    return torch.stack([x, y, z], -1).reshape(-1, 3), (counts[0], counts[1], counts[2])


def _sampled(u: Tensor, source: Tensor) -> Tensor:
    """u [Z, Y, X] where `source` [Z, Y, X, 3] says, nothing beyond."""
    return grid_sample(u[None, None], source[None], mode="bilinear", padding_mode="zeros", align_corners=True)[0, 0]


def strain(flow: Flow, times: Sequence[float]) -> Tensor:
    """Mean over `times` of Σ |sym ∇v|² over the flow's nodes: what is not rigid (as-rigid-as-possible, for velocities).

    A velocity field without it turns and shifts as a body does (Killing's equation). With sources, their divergence is
    part of it.
    """
    nodes = flow.lattice.nodes().to(flow.potential)
    gradients = torch.stack([flow.gradient(nodes, time) for time in times])
    return (0.5 * (gradients + gradients.mT)).square().sum() / len(times)


def minimised(tensors: list[Tensor], iterations: int) -> torch.optim.LBFGS:
    """L-BFGS that changes `tensors` in so many iterations of one call of `step`."""
    return torch.optim.LBFGS(
        tensors,
        lr=1.0,
        max_iter=iterations,
        history_size=12,
        line_search_fn="strong_wolfe",
        tolerance_change=1e-7,
        tolerance_grad=1e-9,
    )


def likelier_fading(
    problem: FlowProblem, u: Tensor, fading: Fading, flow: Flow, iterations: int, spread: float
) -> tuple[Fading, list[float]]:
    """`fading` after some iterations of L-BFGS towards the likeliest one of `u`, which the problem's flow carries; and
    the objective's values.

    spread: standard deviation expected of what logarithms of amplitudes change by over all times, at each node.
    """
    leaf = fading.coefficients.detach().clone().requires_grad_()
    optimiser, values = minimised([leaf], iterations), list[float]()

    def closure() -> float:
        optimiser.zero_grad()
        value = problem.fading_misfit(u, fading.with_coefficients(leaf), flow)
        prior = 0.5 * leaf.square().sum() / spread**2
        prior.backward()
        values.append(value + float(prior.detach()))
        return values[-1]

    optimiser.step(closure)
    return fading.with_coefficients(leaf.detach()), values


def likelier_flow(
    problem: FlowProblem,
    u: Tensor,
    flow: Flow,
    iterations: int,
    spread: float = 1.0,
    divergence: float = 0.1,
) -> tuple[Flow, list[float]]:
    """`flow` after some iterations of L-BFGS towards the likeliest one that carries `u`; and the objective's values.

    spread: standard deviation expected of the strain over the length of the basis; divergence: of that of sources.
    """
    leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in flow.parameters().items()}
    times = torch.linspace(flow.basis.first, flow.basis.last, flow.basis.count).tolist()
    scale = float(flow.lattice.cell)
    optimiser = minimised(list(leaves.values()), iterations)
    values: list[float] = []

    def closure() -> float:
        optimiser.zero_grad()
        tensors = {name: (scale * leaf).detach().requires_grad_() for name, leaf in leaves.items()}
        found = flow.with_parameters(tensors)
        value = problem.flow_misfit(u, found)
        prior = 0.5 * strain(found, times) / spread**2
        if found.sources is not None:
            prior = prior + 0.5 * _divergence(found, times) / divergence**2
        prior.backward()
        for name, leaf in leaves.items():
            gradient = tensors[name].grad
            leaf.grad = None if gradient is None else scale * gradient
        values.append(value + float(prior.detach()))
        return values[-1]

    with torch.no_grad():
        for leaf in leaves.values():
            leaf /= scale
    optimiser.step(closure)
    found = {name: (scale * leaf).detach() for name, leaf in leaves.items()}
    return flow.with_parameters(found), values


def _divergence(flow: Flow, times: Sequence[float]) -> Tensor:
    nodes = flow.lattice.nodes().to(flow.potential)
    gradients = torch.stack([flow.gradient(nodes, time) for time in times])
    return gradients.diagonal(dim1=-2, dim2=-1).sum(-1).square().sum() / len(times)
