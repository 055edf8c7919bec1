"""Flow reconstruction: one volume for all times, carried by a flow, which starts around the middle time.

First it tests for motion: there is motion if a steady flow predicts frames that were set aside better than matter at
rest does. The flow begins steady, between the times next to the middle one, on voxels of
two pixels. Then the window grows to all times, and the flow gets a higher degree in time and more cells, as long as
frames that are held out for a moment are predicted better. At last the volume is fitted on voxels of a pixel, and
Gaussians stand for it.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..baselines.tomography import plateau
from ..fit.flow_volume import FlowProblem, likelier_fading, likelier_flow
from ..fit.run import Run
from ..fit.smooth_volume import descend
from ..geometry import Grid
from ..inference import Compared, Decision
from ..matter import DeltaBeta, MaterialPrior, Matter
from ..methods import Task
from ..methods.illumination import prepared
from ..methods.smooth_fit import SmoothFit
from ..methods.volume import SmoothStage, SmoothVolume
from ..ranges import Natural, Positive, Several, Weight, ranged
from ..representations import (
    Fading,
    Flow,
    Lattice,
    MovingGaussians,
    TimeBasis,
    VoxelGrid,
    approximate,
    cloud_from_volume,
)
from ..representations.initialise import FILLED
from ..scan import Scan
from .timed_frames import (
    Change,
    Frames,
    Masks,
    freer_flows,
    iterations_that_predict,
    kept_frames,
    likelihood_ratio,
    merged,
    others,
)

MOTION, STILL, FLOW = "motion", "matter at rest", "steady flow"
FREEDOM, BY = "freedom of the flow", "frames set aside"
FEWEST_PIXELS = 24
"""Pixels along a frame's shorter side from which on flows are found on voxels of two pixels."""


@dataclass(frozen=True)
@ranged
class FlowOptions:
    """How matter in motion is reconstructed."""

    kind: ClassVar[str] = "carried"

    volume: SmoothVolume = field(default_factory=SmoothVolume)
    """The volume of a time by itself, and of all times as if nothing moved."""
    cells: Natural = 4
    """Cells of the flow along the longest edge of the field, at first."""
    most_cells: Natural = 6
    """Upper limit, where held-out frames support more."""
    most_degree: int = 2
    """Highest degree of the flow in time."""
    steps: Natural = 6
    """Steps of Runge and Kutta from the first time to the last."""
    sources: bool = False
    """Whether the flow may have a divergence where no matter is, as in a foam whose bubbles shrink."""
    strain: Positive = 1.0
    """Standard deviation expected of what is not rigid of the motion, over all times (as-rigid-as-possible)."""
    divergence: Positive = 0.3
    """Standard deviation expected of the divergence of sources, over all times."""
    fading: Weight = 0.0
    """Standard deviation expected of what the logarithm of δ changes by, over all times (0: matter stays as much)."""
    iterations: Natural = 12
    """Iterations for the flow and for the volume, each time that the two take turns."""
    final: Natural = 40
    """Iterations of the volume on voxels of a pixel, at least."""
    most_final: Natural = 160
    """At most, where held-out frames are predicted better after more."""
    held_out: Several = 5
    """One frame in so many is held out to ask how free the flow is."""
    spacing_px: Positive = 2.0
    """Distance between the Gaussians that stand for the volume [pixels]."""
    approximate_steps: Natural = 60
    """Steps in which they learn it."""


@dataclass(frozen=True)
class FlowResult:
    """The result. object: the matter in motion; volume: of the reference time, on voxels; misfit: [T] χ² a pixel at
    each time; history: what was tried, in words; timing: seconds by stage; decisions: on motion, and on the flow's
    freedom."""

    object: MovingGaussians
    volume: VoxelGrid
    flow: Flow
    misfit: list[float]
    history: tuple[str, ...]
    timing: dict[str, float]
    decisions: tuple[Decision, ...] = ()


@dataclass(frozen=True)
class _State:
    """A flow, the volume [Z, Y, X] that it carries, and how that fades, if it may."""

    flow: Flow
    u: Tensor
    fading: Fading | None = None

    def saved(self) -> dict[str, Any]:
        """Tensors and plain values, which `of` reads."""
        fading = {} if self.fading is None else {"fading": self.fading.coefficients}
        return {"flow": self.flow.state(), "u": self.u, **fading}

    @classmethod
    def of(cls, saved: Mapping[str, Any], lattice: Lattice) -> _State:
        """The state that was `saved`; lattice: that of a fading."""
        fading = Fading(saved["fading"], lattice) if "fading" in saved else None
        return cls(Flow.from_state(saved["flow"]), saved["u"], fading)


class FlowSearch:
    """The way from frames to matter in motion, in steps of a `run`."""

    def __init__(
        self,
        task: Task,
        material: DeltaBeta,
        options: FlowOptions = FlowOptions(),
        run: Run | None = None,
    ) -> None:
        self.task, self.options, self.run = task, options, run or Run()
        self.frames = Frames.of(task, material)
        self.times, views = self.frames.times, task.scan.views
        self.middle = len(self.times) // 2
        self.factor = 2 if min(views.shape) >= FEWEST_PIXELS else 1
        self.prior, self.history = options.volume.prior, list[str]()
        self.decisions = list[Decision]()
        self._strength = 1.0
        self._extents = ((wide := views.width / views.finest), views.height / views.finest, wide)
        self.run.state = self._state
        if saved := self.run.saved:
            with self.run.as_written():
                self.history, self._strength = list(saved["history"]), float(saved["strength"])
                self.decisions = [Decision.from_dict(one) for one in saved.get("decisions", ())]
                self.prior = self.options.volume.prior.weakened(self._strength)
                if "stage_steps" not in saved and (count := int(saved.get("steps", 0))):
                    self.run.done = [*([None] * (count - 1)), saved]

    def by_itself(self, scan: Scan, name: str) -> VoxelGrid:
        """The volume of frames of one time; its prior is taken on."""
        with self.run.timed(name):
            task = prepared(replace(self.task, scan=scan, lit=None, first=None, matter="continuous"))
            task = replace(task, prior=MaterialPrior.known(self.frames.material))
            stage = SmoothStage(self.options.volume)
            fit = stage.fit(task, stage.start(task, None))
            assert isinstance(fit, SmoothFit)  # of one known material
            fit.run(lambda record: self.task.on_progress(name, fit.share))
        self._strength = float(fit.state_dict()["strength"])
        self.prior = self.options.volume.prior.weakened(self._strength)
        found = fit.result().object
        assert isinstance(found, VoxelGrid)
        return found

    def steady(self, cells: int) -> Flow:
        """A flow that stands still, steady in time."""
        basis = TimeBasis(float(self.times[0]), float(self.times[-1]), 0)
        lattice, middle = Lattice.around(self._extents, cells), float(self.times[self.middle])
        return Flow.still(lattice, basis, middle, self.options.steps, self.options.sources)

    def moves(self, still: VoxelGrid) -> bool:
        """Whether a steady flow of matter that is `still` otherwise predicts frames better that it was not fitted to;
        with a change of amplitudes, where that may be. All frames are set aside in turn, a part of them at a time."""
        state = self._still(self.on(still, self.factor))
        began, left = clock.perf_counter(), list[tuple[Tensor, Tensor]]()
        with self.run.timed("does it move"):
            for fold in range(self.options.held_out):
                self.task.on_progress("does it move", fold / self.options.held_out)
                keep = self._training_mask(fold)
                moving = self._update_flow(self._problem_of_all(state, keep), state)
                left.append((self.left_out(state, others(keep)), self.left_out(moving, others(keep))))
            found = likelihood_ratio(FLOW, *(torch.cat(frames) for frames in zip(*left)))
        self._decide(MOTION, STILL, found, began)
        return found.wins

    def _decide(self, name: str, null: str, found: Compared, began: float) -> None:
        """Keep the decision on a candidate beside the null."""
        seconds = round(clock.perf_counter() - began, 2)
        self.decisions.append(Decision(name, found.name if found.wins else null, BY, (found,), seconds))

    def _still(self, u: Tensor) -> _State:
        """The state without motion and fading."""
        flow = self.steady(self.options.cells)
        return _State(flow, u, Fading.none(flow.lattice) if self.options.fading > 0 else None)

    def problem(
        self, which: Sequence[int] | range, factor: int, state: _State, keep: Masks | None = None
    ) -> FlowProblem:
        """The frames of the times numbered `which`; keep: of these frames."""
        frames = [self.frames.whitened(k, factor, None if keep is None else keep[k]) for k in which]
        prior = self.prior if factor == 1 else self.prior.on_larger_voxels(factor)
        times = self.times[list(which)].tolist()
        problem = FlowProblem(frames, times, prior, plateau(state.u), state.flow, factor)
        problem.fade(state.fading, state.flow)
        return problem

    def _problem_of_all(self, state: _State, keep: Masks | None = None) -> FlowProblem:
        """The frames of all times, or those that `keep` says."""
        return self.problem(range(len(self.times)), self.factor, state, keep)

    def on(self, volume: VoxelGrid, factor: int) -> Tensor:
        """The values [Z, Y, X] of a volume on voxels of `factor` pixels."""
        return volume.resampled(self._grid(factor)).values[0]

    def _grid(self, factor: int) -> Grid:
        return Grid.of_views(self.frames.scans[0].binned(factor).views)

    def turns(self, problem: FlowProblem, state: _State, rounds: int = 1) -> _State:
        """Flow, fading and volume in turns, each by `iterations`."""
        for _ in range(rounds):
            state = self._update_flow(problem, state)
            u, _ = descend(problem, state.u, self.options.iterations)
            state = replace(state, u=u)
        return state

    def _update_flow(self, problem: FlowProblem, state: _State, steps: int | None = None) -> _State:
        """`state` with a likelier flow, and then, where the problem is of all times, a likelier fading, which it takes,
        too: in a few times what moves may pass for what fades."""
        how, u, fading = self.options, state.u, state.fading
        steps = how.iterations if steps is None else steps
        flow, _ = likelier_flow(problem, u, state.flow, steps, how.strain, how.divergence)
        problem.carry(flow)
        if fading is not None and len(problem.times) == len(self.times):
            fading, _ = likelier_fading(problem, u, fading, flow, steps, how.fading)
            problem.fade(fading, flow)
        return _State(flow, u, fading)

    def windows(self) -> list[list[int]]:
        """Times about the middle: those next to it, then twice as many, to all."""
        reach, found = 1, list[list[int]]()
        while True:
            near = [k for k in range(len(self.times)) if abs(k - self.middle) <= reach]
            found.append(near)
            if len(near) == len(self.times):
                return found
            reach *= 2

    def _state(self) -> dict[str, Any]:
        """What `_take_up` reads."""
        decisions = [one.as_dict() for one in self.decisions]
        own = {"history": list(self.history), "strength": self._strength, "decisions": decisions}
        return own | {"steps": len(self.run.done)}

    def solve(self) -> FlowResult:
        """The whole way, from the middle time on."""
        state = self._step("flow", self._initial_state)
        windows = self.windows()
        for n, window in enumerate(windows):
            self.task.on_progress("flow", n / (len(windows) + 3))
            state = self._step("flow", lambda s=state, w=window: self.turns(self.problem(w, self.factor, s), s))
        return self.finished(self.freer(state))

    def _step(self, name: str, make: Callable[[], _State]) -> _State:
        """The state that the next step of the stage `name` makes, or the one that an earlier run has kept."""
        saved = self.run.step(name, lambda: make().saved(), chain=True)
        with self.run.as_written():
            return _State.of(saved, self.steady(self.options.cells).lattice)

    def _initial_state(self) -> _State:
        return self._still(self.on(self.first(), self.factor))

    def first(self) -> VoxelGrid:
        """The volume of the middle time; of all times, as if nothing moved, where noise hides a single one."""
        volume = self.by_itself(self.frames.scans[self.middle], "middle time")
        if bool((volume.values > 0).any()):
            return volume
        self.history.append("the middle time by itself shows no matter: begun with the mean of all times")
        return self.by_itself(merged(self.task.scan), "mean of all times")

    def freer(self, state: _State) -> _State:
        """The state with as much freedom of the flow in time and space as held-out frames support."""
        count, keep, how = len(self.times), self._training_mask(), self.options
        for change in freer_flows(self._extents, (how.cells, how.most_cells), min(how.most_degree, count - 2)):
            state = self._step("flow", lambda s=state, c=change: self._try_freer_flow(s, c, keep))
        return self._step("flow", lambda: self.turns(self._problem_of_all(state), state))

    def _training_mask(self, fold: int = 0) -> Masks:
        """The frames that are not held out."""
        return kept_frames([len(one) for one in self.frames.scans], self.options.held_out, self.task.seed, fold)

    def _try_freer_flow(self, state: _State, change: Change, keep: Masks) -> _State:
        """The state with a freer flow, if that predicts the frames better that `keep` leaves out."""
        wanted = change(state.flow)
        if wanted is None:
            return state
        began, kept, aside = clock.perf_counter(), self._problem_of_all(state, keep), others(keep)
        same = self.turns(kept, state)
        kept.carry(wanted)
        kept.fade(state.fading, wanted)
        other = self.turns(kept, replace(state, flow=wanted))
        found = likelihood_ratio(_size(wanted), self.left_out(same, aside), self.left_out(other, aside))
        self._decide(FREEDOM, _size(state.flow), found, began)
        return other if found.wins else state

    def left_out(self, state: _State, left: Masks) -> Tensor:
        """[F, H, W] what `state` leaves of the frames `left`, over their noise."""
        times = [k for k, each in enumerate(left) if each.any()]
        return self.problem(times, self.factor, state, left).residuals(state.u)

    def finished(self, state: _State) -> FlowResult:
        """The state on voxels of a pixel, and the Gaussians that stand for it."""
        state = self._step("volume", lambda: self._fit_fine_voxels(state))
        problem = self.problem(range(len(self.times)), 1, state)
        pixels = problem.count / len(self.times)
        misfit = [2 * one / pixels for one in problem.misfit(state.u)]
        volume = self._volume(state.u, 1)
        found = self.gaussians(volume, state)
        said = tuple(self.history), self.run.timing, tuple(self.decisions)
        return FlowResult(found, volume, state.flow, misfit, *said)

    def _volume(self, u: Tensor, factor: int) -> VoxelGrid:
        return VoxelGrid(u[None], self._grid(factor), Matter.one(*self.frames.material))

    def _fit_fine_voxels(self, state: _State) -> _State:
        """On voxels of a pixel: the volume, the flow by it, and once more the volume."""
        self.task.on_progress("volume", 0.0)
        wanted = self._long_enough(state)
        state = self._finer(state)
        problem = self.problem(range(len(self.times)), 1, state)
        for k, iterations in enumerate((wanted - wanted // 2, wanted // 2)):
            self.task.on_progress("volume", (k + 1) / 3)
            if k:
                state = self._update_flow(problem, state, self.options.iterations // 2)
            state = replace(state, u=descend(problem, state.u, iterations)[0])
        return state

    def _finer(self, state: _State) -> _State:
        return replace(state, u=self.on(self._volume(state.u, self.factor), 1))

    def _long_enough(self, state: _State) -> int:
        """Iterations of the volume on voxels of a pixel: as many as predict frames best that are held out, which the
        volume that they begin with is made to forget."""
        keep, how = self._training_mask(), self.options
        out = others(keep)
        left = [k for k, each in enumerate(out) if each.any()]
        if not left or how.most_final <= how.final:
            return how.final
        large = self._problem_of_all(state, keep)
        state = self._finer(replace(state, u=descend(large, state.u, how.iterations)[0]))
        kept, aside = self.problem(range(len(keep)), 1, state, keep), self.problem(left, 1, state, out)
        best, gain = iterations_that_predict(kept, aside, state.u, how.most_final)
        wanted = max(best, how.final)
        self.history.append(
            f"{wanted} iterations on voxels of a pixel; {best} take {gain:.0f} from ½χ² of held-out frames"
        )
        return wanted

    def gaussians(self, volume: VoxelGrid, state: _State) -> MovingGaussians:
        """Gaussians that stand for a volume of the reference time, with its flow and its fading."""
        unit = self.task.scan.views.finest
        spacing, u = self.options.spacing_px * unit, volume.values[0]
        filled = FILLED * plateau(u)
        with self.run.timed("gaussians"):
            first = cloud_from_volume(u, volume.grid, self.frames.material, spacing, unit, filled=filled)
            found = approximate(first, u, volume.grid, self.options.approximate_steps, self.task.on_progress)
        cloud, flow, change = found.detached(), state.flow, None
        if state.fading is not None:
            one, two = (self.times[[0, -1]] - flow.reference) / (flow.basis.last - flow.basis.first)
            change = state.fading.of_raw(cloud.centres, cloud.raw_amplitudes[:, 0], (float(one), float(two)))
        return MovingGaussians(cloud, flow, change)


def _size(flow: Flow) -> str:
    return f"degree {flow.basis.degree}, {' × '.join(map(str, flow.lattice.counts))} nodes"
