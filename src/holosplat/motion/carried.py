"""Matter that is no body, in motion: one volume for all times that a flow carries, begun around the middle time.

Whether anything moves is asked first: where a flow beside the mean of all times explains frames, and hardly does so
with the times in another order, it does. The flow begins steady, between the times next to the middle one, on voxels of
two pixels. Then the window grows to all times, and the flow gets a higher degree in time and more cells, as long as
frames that are held out for a moment are predicted better. At last the volume is fitted on voxels of a pixel, and
Gaussians stand for it.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ..baselines.material import plateau
from ..checks import at_least, positive, require
from ..fit.carried_volume import CarriedProblem, likelier_flow
from ..fit.smooth_volume import descend
from ..fit.whitened import WhitenedFrames
from ..geometry import Grid
from ..matter import DeltaBeta, MaterialPrior, Matter
from ..methods import Task
from ..methods.smooth_fit import SmoothFit
from ..methods.volume import SmoothStage, SmoothVolume
from ..optics.noise_model import NoiseModel
from ..ranges import Pixels, Weight, ranged
from ..representations import Flow, Lattice, MovingGaussians, TimeBasis, VoxelGrid, approximate, cloud_from_volume
from ..representations.initialise import FILLED
from ..scan import Scan

SURE, AGAIN = 4.0, 2.0
"""Standard deviations, and times what it explains of times in another order, by which a flow must explain frames before
anything is said to move."""
BETTER = 2.0
"""Standard errors by which a freer flow must predict held-out frames better."""
ORDERS = 200
"""Orders of the times that are tried for one without a trend."""
FEWEST_PIXELS = 24
"""Pixels along a frame's shorter side from which on flows are found on voxels of two pixels."""


@dataclass(frozen=True)
@ranged
class CarriedOptions:
    """How matter in motion is reconstructed."""

    volume: SmoothVolume = field(default_factory=SmoothVolume)
    """The volume of a time by itself, and of all times as if nothing moved."""
    cells: int = 4
    """Cells of the flow along the longest edge of the field, at first."""
    most_cells: int = 6
    """At most, where held-out frames ask for more."""
    most_degree: int = 2
    """Highest degree of the flow in time."""
    steps: int = 6
    """Steps of Runge and Kutta from the first time to the last."""
    sources: bool = False
    """Whether the flow may have a divergence where no matter is, as in a foam whose bubbles shrink."""
    strain: Weight = 1.0
    """Standard deviation expected of what is not rigid of the motion, over all times (as-rigid-as-possible)."""
    divergence: Weight = 0.3
    """Standard deviation expected of the divergence of sources, over all times."""
    iterations: int = 12
    """Iterations for the flow and for the volume, each time that the two take turns."""
    final: int = 20
    """Iterations of the volume on voxels of a pixel, twice."""
    held_out: int = 5
    """One frame in so many is held out to ask how free the flow is."""
    spacing_px: Pixels = 2.0
    """Distance between the Gaussians that stand for the volume [pixels]."""
    approximate_steps: int = 60
    """Steps in which they learn it."""

    def __post_init__(self) -> None:
        at_least(self, 1, "cells", "most_cells", "steps", "iterations", "final", "approximate_steps")
        at_least(self, 2, "held_out")
        for name in ("strain", "divergence"):
            require(getattr(self, name) > 0, f"{name} must be above zero, but it is {getattr(self, name):g}.")
        positive("spacing_px", self.spacing_px, "pixels")


@dataclass(frozen=True)
class Frames:
    """The frames of each time, ready: scans [T] (training frames), times [T] [s], the noise of each, one material."""

    scans: Sequence[Scan]
    times: np.ndarray
    noise: Sequence[NoiseModel]
    material: DeltaBeta

    @classmethod
    def of(cls, task: Task, material: DeltaBeta) -> Frames:
        """Those of a task of several times, whose light has been evened."""
        times = task.scan.instants
        scans = [task.scan.at_instant(k) for k in range(len(times))]
        parts = [Task(scan, task.prior, light=task.light) for scan in scans]
        return cls(scans, times, [part.noise for part in parts], material)

    def whitened(self, k: int, factor: int, keep: np.ndarray | None = None) -> WhitenedFrames:
        """The frames of the time numbered k on pixels `factor` times larger; keep: [V] bool, which of them."""
        scan, noise = self.scans[k], self.noise[k]
        if keep is not None:
            scan, noise = scan[np.flatnonzero(keep)], part_of(noise, np.flatnonzero(keep))
        return WhitenedFrames(scan.binned(factor), self.material, noise.binned(factor))


def part_of(noise: NoiseModel, index: np.ndarray) -> NoiseModel:
    """The noise of some of the frames."""
    return noise[torch.from_numpy(index)]


def merged(scan: Scan) -> Scan:
    """The mean of the frames of each exposure over the times, as a scan of one time, where all times have the same
    exposures; else all frames, as if taken at one time."""
    count, times = len(scan), scan.instants
    each = [np.flatnonzero(scan.exposures.time == time) for time in times]
    first = scan.exposures[each[0]]
    same = all(
        len(one) == len(each[0]) and scan.views[one].fingerprint() == first.views.fingerprint() for one in each[1:]
    )
    if not same or len(each[0]) * len(times) != count:
        return scan.as_static()
    frames = np.mean([scan.frames[one] for one in each], axis=0)
    return replace(scan[each[0]], frames=frames).as_static()


@dataclass(frozen=True)
class Carried:
    """What was found. object: the matter in motion; volume: of the reference time, on voxels; misfit: [T] χ² a pixel at
    each time; history: what was tried, in words; timing: seconds by stage."""

    object: MovingGaussians
    volume: VoxelGrid
    flow: Flow
    misfit: list[float]
    history: tuple[str, ...]
    timing: dict[str, float]


@dataclass(frozen=True)
class _State:
    """A flow and the volume [Z, Y, X] that it carries."""

    flow: Flow
    u: Tensor


class Search:
    """The way from frames to matter in motion, step by step."""

    def __init__(self, task: Task, material: DeltaBeta, options: CarriedOptions = CarriedOptions()) -> None:
        self.task, self.options = task, options
        self.frames = Frames.of(task, material)
        self.times, views = self.frames.times, task.scan.views
        self.middle = len(self.times) // 2
        self.factor = 2 if min(views.shape) >= FEWEST_PIXELS else 1
        self.prior, self.history, self.timing = options.volume.prior, list[str](), dict[str, float]()
        self._extents = (views.width / views.finest, views.height / views.finest, views.width / views.finest)

    def by_itself(self, scan: Scan, name: str) -> VoxelGrid:
        """The volume of frames of one time; its prior is taken on."""
        began = clock.perf_counter()
        task = replace(self.task, scan=scan, lit=None, matter="continuous").evened()
        task = replace(task, prior=_known(self.frames.material))
        stage = SmoothStage(self.options.volume)
        start = stage.start(task, None)
        fit: SmoothFit = stage.fit(task, start)
        fit.run(lambda record: self.task.on_progress(name, fit.share))
        self.prior = self.options.volume.prior.weakened(float(fit.state_dict()["strength"]))
        self.timing[name] = clock.perf_counter() - began
        found = fit.result().object
        assert isinstance(found, VoxelGrid)
        return found

    def steady(self, cells: int) -> Flow:
        """A flow that stands still, steady in time."""
        basis = TimeBasis(float(self.times[0]), float(self.times[-1]), 0)
        lattice, middle = Lattice.around(self._extents, cells), float(self.times[self.middle])
        return Flow.still(lattice, basis, middle, self.options.steps, self.options.sources)

    def moves(self, still: VoxelGrid) -> bool:
        """Whether a steady flow explains frames that matter which stands `still` does not."""
        began = clock.perf_counter()
        flow, u = self.steady(self.options.cells), self.on(still, self.factor)
        count = len(self.times)
        gain, chance = (self._gain(order, flow, u) for order in (list(range(count)), trendless(count)))
        self.history.append(f"a steady flow takes {gain:.0f} from ½χ², of times in another order {chance:.0f}")
        self.timing["does it move"] = clock.perf_counter() - began
        return gain > SURE**2 + AGAIN * chance

    def _gain(self, order: list[int], flow: Flow, u: Tensor) -> float:
        """What a steady flow takes from ½χ² of u where the times come in `order`."""
        problem = self.problem(order, self.factor, flow, u, times=self.times)
        _, values = likelier_flow(problem, u, flow, self.options.iterations, self.options.strain)
        return values[0] - min(values)

    def problem(
        self,
        which: Sequence[int] | range,
        factor: int,
        flow: Flow,
        u: Tensor,
        keep: np.ndarray | None = None,
        times: np.ndarray | None = None,
    ) -> CarriedProblem:
        """The frames of the times numbered `which`; keep: [T, V] bool, of these frames; times: other ones for them."""
        frames = [self.frames.whitened(k, factor, None if keep is None else keep[k]) for k in which]
        prior = self.prior if factor == 1 else self.prior.on_larger_voxels(factor)
        taken = self.times[list(which)] if times is None else times
        return CarriedProblem(frames, taken.tolist(), prior, plateau(u), flow, factor)

    def on(self, volume: VoxelGrid, factor: int) -> Tensor:
        """The values [Z, Y, X] of a volume on voxels of `factor` pixels."""
        return volume.resampled(self._grid(factor)).values[0]

    def _grid(self, factor: int) -> Grid:
        return Grid.of_views(self.frames.scans[0].binned(factor).views)

    def turns(self, problem: CarriedProblem, state: _State, rounds: int = 1) -> _State:
        """Flow and volume in turns, each by `iterations`."""
        flow, u = state.flow, state.u
        for _ in range(rounds):
            flow, _ = likelier_flow(
                problem, u, flow, self.options.iterations, self.options.strain, self.options.divergence
            )
            problem.carry(flow)
            u, _ = descend(problem, u, self.options.iterations)
        return _State(flow, u)

    def windows(self) -> list[list[int]]:
        """Times about the middle: those next to it, then twice as many, to all."""
        reach, found = 1, list[list[int]]()
        while True:
            near = [k for k in range(len(self.times)) if abs(k - self.middle) <= reach]
            found.append(near)
            if len(near) == len(self.times):
                return found
            reach *= 2

    def run(self) -> Carried:
        """The whole way, from the middle time on."""
        volume = self.first()
        began = clock.perf_counter()
        state = _State(self.steady(self.options.cells), self.on(volume, self.factor))
        windows = self.windows()
        for n, window in enumerate(windows):
            self.task.on_progress("flow", n / (len(windows) + 3))
            state = self.turns(self.problem(window, self.factor, state.flow, state.u), state)
        state = self.freer(state)
        self.timing["flow"] = clock.perf_counter() - began
        return self.finished(state)

    def first(self) -> VoxelGrid:
        """The volume of the middle time; of all times, as if nothing moved, where noise hides a single one."""
        volume = self.by_itself(self.frames.scans[self.middle], "middle time")
        if bool((volume.values > 0).any()):
            return volume
        self.history.append("the middle time by itself shows no matter: begun with the mean of all times")
        return self.by_itself(merged(self.task.scan), "mean of all times")

    def freer(self, state: _State) -> _State:
        """The state with the flow as free in time and space as held-out frames ask for."""
        count, views = len(self.times), len(self.frames.scans[0])
        aside = np.zeros(count * views, dtype=bool)
        number = count * views // self.options.held_out
        aside[np.random.default_rng(self.task.seed).permutation(count * views)[:number]] = True
        keep = ~aside.reshape(count, views)
        keep[~keep.any(1), 0] = True
        for change in self._changes(state.flow):
            wanted = change(state.flow)
            if wanted is None:
                continue
            kept = self.problem(range(count), self.factor, state.flow, state.u, keep)
            same = self.turns(kept, state)
            kept.carry(wanted)
            other = self.turns(kept, _State(wanted, state.u))
            errors = [self.left_out(one, ~keep) for one in (same, other)]
            gain = errors[0] - errors[1]
            better = bool(gain.mean() > BETTER * gain.std(ddof=1) / np.sqrt(len(gain)))
            size = f"degree {wanted.basis.degree}, {' × '.join(map(str, wanted.lattice.counts))} nodes"
            self.history.append(f"{size}: {gain.mean():+.1f} of ½χ² a held-out frame{', taken' if better else ''}")
            if better:
                state = other
        every = self.problem(range(count), self.factor, state.flow, state.u)
        return self.turns(every, state)

    def _changes(self, flow: Flow) -> list[Callable[[Flow], Flow | None]]:
        options = self.options
        most = min(options.most_degree, len(self.times) - 2)
        degrees = [lambda f, d=d: of_degree(f, d) if f.basis.degree == d - 1 else None for d in range(1, most + 1)]
        finer = (3 * options.cells // 2, 2 * options.cells)
        cells = [
            lambda f, c=c: on_lattice(f, Lattice.around(self._extents, c)) for c in finer if c <= options.most_cells
        ]
        return [*degrees, *cells]

    def left_out(self, state: _State, left: np.ndarray) -> np.ndarray:
        """½χ² of each of the frames `left` [T, V] bool."""
        found: list[float] = []
        for k in np.flatnonzero(left.any(1)):
            for v in np.flatnonzero(left[k]):
                one = np.zeros(left.shape, dtype=bool)
                one[k, v] = True
                problem = self.problem([int(k)], self.factor, state.flow, state.u, one)
                found.append(problem.misfit(state.u)[0])
        return np.array(found)

    def finished(self, state: _State) -> Carried:
        """The state on voxels of a pixel, and the Gaussians that stand for it."""
        began, options = clock.perf_counter(), self.options
        coarse = VoxelGrid(state.u[None], self._grid(self.factor), Matter.one(*self.frames.material))
        flow, u = state.flow, self.on(coarse, 1)
        problem = self.problem(range(len(self.times)), 1, flow, u)
        for k in range(2):
            self.task.on_progress("volume", k / 2)
            if k:
                flow, _ = likelier_flow(problem, u, flow, options.iterations // 2, options.strain, options.divergence)
                problem.carry(flow)
            u, _ = descend(problem, u, options.final)
        pixels = problem.count / len(self.times)
        misfit = [2 * one / pixels for one in problem.misfit(u)]
        volume = VoxelGrid(u[None], self._grid(1), coarse.matter)
        self.timing["volume"] = clock.perf_counter() - began
        return Carried(self.gaussians(volume, flow), volume, flow, misfit, tuple(self.history), self.timing)

    def gaussians(self, volume: VoxelGrid, flow: Flow) -> MovingGaussians:
        """Gaussians that stand for a volume of the reference time, with its flow."""
        began, unit = clock.perf_counter(), self.task.scan.views.finest
        spacing, u = self.options.spacing_px * unit, volume.values[0]
        filled = FILLED * plateau(u)
        first = cloud_from_volume(u, volume.grid, self.frames.material, spacing, unit, filled=filled)
        found = approximate(first, u, volume.grid, self.options.approximate_steps, self.task.on_progress)
        self.timing["gaussians"] = clock.perf_counter() - began
        return MovingGaussians(found.detached(), flow)


def trendless(count: int) -> list[int]:
    """Numbers below `count` in the order, of some hundred random ones, that goes least with them."""
    rng, numbers = np.random.default_rng(0), np.arange(count) - 0.5 * (count - 1)
    orders = [rng.permutation(count) for _ in range(ORDERS)]
    return min(orders, key=lambda order: abs(float(numbers @ order))).tolist()


def _known(material: DeltaBeta) -> MaterialPrior:
    return MaterialPrior.known(material)


def of_degree(flow: Flow, degree: int) -> Flow:
    """The same flow in a basis of time of a higher degree, which holds it."""
    old = flow.basis
    basis = TimeBasis(old.first, old.last, degree, old.pieces)
    times = np.linspace(old.first, old.last, 4 * (basis.count + old.count))
    weights = old.weights(times)

    def raised(tensor: Tensor) -> Tensor:
        values = np.einsum("tk,k...->t...", weights, tensor.numpy())
        return torch.from_numpy(basis.fitted(times, values)).to(tensor)

    found = {name: raised(tensor) for name, tensor in flow.parameters().items()}
    return Flow(found["potential"], flow.lattice, basis, flow.reference, flow.steps, found.get("sources"))


def on_lattice(flow: Flow, lattice: Lattice) -> Flow:
    """About the same flow on another lattice: potentials agree in the mean square along each axis."""
    matrices = []
    for axis in range(3):
        count, first, cell = lattice.counts[2 - axis], lattice.first[axis], lattice.cell
        places = torch.linspace(first, first + cell * (count - 1), 8 * count, dtype=torch.float64)
        points = torch.zeros(len(places), 3, dtype=torch.float64)
        points[:, axis] = places
        old, new = (one.weights(points, axis, 0)[0] for one in (flow.lattice, lattice))
        matrices.append(torch.linalg.lstsq(new, old).solution)
    x, y, z = matrices

    def moved(tensor: Tensor) -> Tensor:
        return torch.einsum("...zyx,cz,by,ax->...cba", tensor.double(), z, y, x).to(tensor)

    found = {name: moved(tensor) for name, tensor in flow.parameters().items()}
    return Flow(found["potential"], lattice, flow.basis, flow.reference, flow.steps, found.get("sources"))
