"""Forecasts of matter in motion: Gaussians that a flow without divergence carries on after the last frames, so that
each keeps its volume and its amplitude.

A flow goes on in one of four ways. Matter stays where it is at the last time (`rest`). Slow fluid between walls keeps
the velocity of each place (`steady`). Where inertia rules, fluid keeps its velocity as far as the flow stays free of
divergence (`inertia`: Euler's equations by projection; Chorin 1968, Math. Comput. 22, 745). Or the fitted change of the
flow goes on (`paths`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ..baselines.tomography import plateau
from ..checks import require
from ..fit.flow_volume import FlowProblem, likelier_flow, minimised
from ..fit.smooth_volume import ContinuousPrior
from ..geometry import Grid
from ..inference import Decision, Score, select
from ..matter import MaterialPrior
from ..methods import Task
from ..optics.background import LightOptions
from ..progress import Progress
from ..representations import Flow, GaussianCloud, Lattice, MovingGaussians, TimeBasis
from ..scan import Scan
from .flow_reconstruction import FEWEST_PIXELS, FlowOptions
from .forecast import early_count
from .timed_frames import Frames

Way = Literal["rest", "steady", "inertia", "paths"]
REST, STEADY, INERTIA, PATHS = "rest", "steady", "inertia", "paths"
FEWEST = 4
"""Times of which halves tell a flow."""
NAME, BY = "how matter goes on", "frames of the last third of the run's times"
PROJECTION, FROM_REST = 20, 40
"""Iterations of a projection, and of a fit from rest: more change neither."""

Render = Callable[[GaussianCloud, Scan], Tensor]
"""Frames [V, H, W] of matter as it is at the time of a scan, as that takes them."""


@dataclass(frozen=True)
class FlowForecast:
    """Matter after the last frames. object: from the last frames' time on; times: [N] s of the forecast; band: [N, 1]
    m, standard error of the places of matter along an axis (rms by mass), NaN where nothing tells it."""

    object: MovingGaussians
    times: np.ndarray
    band: np.ndarray

    def usual_band(self) -> np.ndarray:
        """[N] m."""
        return self.band[:, 0]


def gone_on(matter: MovingGaussians, last: float, ahead: np.ndarray, way: Way) -> MovingGaussians:
    """`matter` from the time `last` [s] on, at the later times `ahead` [N] s, which are even.

    Its flow begins as it is at `last`; changes are linear from one time to the next. Errors: `InputError` for inertia
    of a flow with sources.
    """
    require_goes_on(matter, way)
    old, span = matter.flow, float(ahead[-1]) - last
    pace = span / (old.basis.last - old.basis.first)  # velocities are per length of the basis
    cloud = matter.at(last).detached()
    steps = len(ahead) * math.ceil(old.steps * pace / len(ahead))
    if way in (REST, STEADY):
        basis, fields = TimeBasis(last, float(ahead[-1]), 0), [_at(old, last)]
        pace *= way == STEADY
    else:
        basis = TimeBasis(last, float(ahead[-1]), 1, len(ahead))
        nodes = [last, *ahead.tolist()]
        fields = _inertial(old, nodes) if way == INERTIA else [_at(old, time) for time in nodes]
    tensors = {name: pace * torch.stack([one[name] for one in fields]) for name in fields[0]}
    flow = Flow(tensors["potential"], old.lattice, basis, last, steps, tensors.get("sources"))
    return MovingGaussians(cloud, flow)


def require_goes_on(matter: MovingGaussians, way: Way | None) -> None:
    """`InputError` for matter that fades, and for inertia of a flow with sources."""
    require(
        matter.fading is None,
        "a forecast needs matter that stays as much, but this run's fades, which no frame after it tells; reconstruct "
        "without --fading.",
    )
    require(
        way != INERTIA or matter.flow.sources is None,
        "inertia needs a flow without sources, but this one has some; take --by steady.",
    )


def _at(flow: Flow, time: float) -> dict[str, Tensor]:
    """The coefficients of its fields at `time` [s], by name."""
    weights = torch.from_numpy(flow.basis.weights(time)[0])
    return {
        name: torch.einsum("k,k...->...", weights.to(tensor), tensor.detach())
        for name, tensor in flow.parameters().items()
    }


def _mass(cloud: GaussianCloud) -> Tensor:
    """[N], of each Gaussian as a share of all: its amplitude times its volume."""
    mass = cloud.amplitudes[:, 0] * cloud.scales.prod(dim=1)
    return (mass / mass.sum()).detach()


def _inertial(flow: Flow, times: list[float]) -> list[dict[str, Tensor]]:
    """The potentials at `times`, of which the first is that of the flow.

    A step gives each place the velocity of where its fluid came from (Stam 1999, SIGGRAPH, 121, by the midpoint rule)
    and projects these velocities onto flows without divergence, by least squares over the lattice. Fluid beyond it is
    at rest.
    """
    constant = TimeBasis(flow.basis.first, flow.basis.last, 0)
    now = replace(flow, basis=constant, potential=_at(flow, times[0])["potential"][None])
    points, found = _between_nodes(flow.lattice).to(flow.potential), [now.potential[0]]
    for before, time in pairwise(times):
        part = (time - before) / (constant.last - constant.first)
        halfway = points - 0.5 * part * now.velocity(points, before)
        came_from = points - part * now.velocity(halfway, before)
        now = _projected(now, points, now.velocity(came_from, before))
        found.append(now.potential[0])
    return [{"potential": one} for one in found]


def _between_nodes(lattice: Lattice) -> Tensor:
    """[P, 3]: eight points a cell, of the cells next to the nodes."""
    shifts = 0.25 * lattice.cell * torch.tensor(list(product((-1.0, 1.0), repeat=3)), dtype=torch.float64)
    return (lattice.nodes()[:, None] + shifts).flatten(0, 1)


def _projected(flow: Flow, points: Tensor, wanted: Tensor) -> Flow:
    """The steady `flow` changed such that its velocities at `points` [N, 3] are next to those `wanted` [N, 3]."""
    missing = wanted - flow.velocity(points, flow.basis.first)
    scale = float(missing.square().mean()) + torch.finfo(missing.dtype).tiny
    leaf = flow.potential.new_zeros(flow.potential.shape).requires_grad_()
    optimiser = minimised([leaf], PROJECTION)

    def closure() -> float:
        optimiser.zero_grad()
        change = replace(flow, potential=flow.lattice.cell * leaf)
        value = (change.velocity(points, flow.basis.first) - missing).square().mean() / scale
        value.backward()
        return float(value.detach())

    optimiser.step(closure)
    return replace(flow, potential=flow.potential + flow.lattice.cell * leaf.detach())


def forecast_matter(
    history: FlowHistory, ahead: np.ndarray, way: Way | None, half_sets: bool, on_progress: Progress
) -> tuple[FlowForecast, Decision | None, Way]:
    """The matter of `history` at the later times `ahead` [N] s, which are even; what was decided; and the way in which
    it goes on. way: None for the one that tells the last third of the times best, or `steady` where the times are too
    few to ask; half_sets: whether halves and the first two thirds of the times say how sure that is."""
    decision, band, asked = None, np.full((len(ahead), 1), np.nan), half_sets and len(history.times) >= FEWEST
    if asked and way is None:
        on_progress(NAME, 0.0)
        decision = history.decided()
        way = next(one for one in history.ways() if one == decision.choice)
    way = way or STEADY
    if asked:
        on_progress("half-sets", 0.5)
        band = history.band(way, ahead)
    return FlowForecast(gone_on(history.matter, float(history.times[-1]), ahead, way), ahead, band), decision, way


class FlowHistory:
    """What a forecast of matter in motion begins with: the `matter` of a run, its training frames `train` of several
    times in even light, and flows that are fitted to parts of them, with the matter as it is.

    Errors: `InputError` for matter that fades.
    """

    def __init__(
        self, matter: MovingGaussians, train: Scan, render: Render, options: FlowOptions = FlowOptions()
    ) -> None:
        require_goes_on(matter, None)
        self.matter, self.options, self._render = matter, options, render
        light, (material, *_) = LightOptions("even", still="none", noise="white"), matter.matter.channels
        self.frames = Frames.of(Task(train, MaterialPrior.known(material), light=light), material)
        self.times = self.frames.times
        self._factor = 2 if min(train.views.shape) >= FEWEST_PIXELS else 1
        grid = Grid.of_views(train.binned(self._factor).views)
        delta = matter.at(matter.flow.reference).voxelise(grid).delta
        self._u = torch.from_numpy(delta / self.frames.material.delta).float()
        self._early: MovingGaussians | None = None

    @property
    def early_times(self) -> np.ndarray:
        """The first two thirds of the times [s]."""
        return self.times[: early_count(len(self.times))]

    def early(self) -> MovingGaussians:
        """The matter with a flow from rest, fitted to the frames of the first two thirds of the times alone."""
        if self._early is None:
            flow, times = self.matter.flow, self.early_times
            degree = min(flow.basis.degree, max(len(times) - 2, 0))
            basis = TimeBasis(float(times[0]), float(times[-1]), degree)
            rest = Flow.still(flow.lattice, basis, flow.reference, flow.steps, flow.sources is not None)
            self._early = self._fitted(rest, range(len(times)), FROM_REST)
        return self._early

    def half(self, which: int) -> MovingGaussians:
        """The matter with its flow fitted on to every other time, from the first or the second on."""
        return self._fitted(self.matter.flow, range(which, len(self.times), 2), self.options.iterations)

    def _fitted(self, flow: Flow, which: range, iterations: int) -> MovingGaussians:
        frames = [self.frames.whitened(k, self._factor) for k in which]
        times = self.times[list(which)].tolist()
        problem = FlowProblem(frames, times, ContinuousPrior(), plateau(self._u), flow, self._factor)
        how = self.options
        found, _ = likelier_flow(problem, self._u, flow, iterations, how.strain, how.divergence)
        return MovingGaussians(self.matter.cloud, found)

    def ways(self) -> tuple[Way, ...]:
        """Those that matter may go on in, the simplest first."""
        flow = self.matter.flow
        inertia: tuple[Way, ...] = () if flow.sources is not None else (INERTIA,)
        return (REST, STEADY, *inertia, *((PATHS,) if flow.basis.degree else ()))

    def decided(self) -> Decision:
        """Which way tells the frames of the last third of the times best, from flows that never saw them."""
        named: dict[str, Way] = {way: way for way in self.ways()}
        late = self.times[len(self.early_times) :]
        scans = self.frames.scans[len(self.early_times) :]

        def score(name: str, fold: int) -> Score:
            later = gone_on(self.early(), float(self.early_times[-1]), late, named[name])
            frames = (self._render(later.at(float(time)), scan) for time, scan in zip(late, scans))
            return Score.joined([Score.of(scan.left(each.double())) for scan, each in zip(scans, frames)])

        return select(NAME, list(named), score, by=BY)

    def band(self, way: Way, ahead: np.ndarray) -> np.ndarray:
        """[N, 1] m, standard error of the places of matter along an axis at the times `ahead` [N] s: half of what flows
        of two halves of the times make of them, and what the flow of the first two thirds misses of the last time,
        growing with the time ahead as an error of the velocity does."""
        last, tested = float(self.times[-1]), float(self.times[-1] - self.early_times[-1])
        mass = _mass(self.matter.cloud)

        def places(matter: MovingGaussians, begun: float, times: np.ndarray) -> list[Tensor]:
            later = gone_on(matter, begun, times, way)
            return [later.at(float(time)).centres for time in times]

        def apart(one: Tensor, other: Tensor) -> float:
            return float((one - other).square().sum(1) @ mass)

        halves = zip(*(places(self.half(k), last, ahead) for k in (0, 1)))
        spread = 0.25 * np.array([apart(*pair) for pair in halves])
        (said,) = places(self.early(), float(self.early_times[-1]), self.times[-1:])
        missed = apart(said, self.matter.at(last).centres)
        squares = spread + ((ahead - last) / tested) ** 2 * missed
        return self.matter.unit_length * np.sqrt(squares / 3)[:, None]
