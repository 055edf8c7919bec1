"""The fit of a smooth volume: descents on large voxels, then on those of a pixel, that can be stopped and resumed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from ..backends import device, resolve
from ..baselines.beyond import Margins, margins_of
from ..baselines.tomography import plateau
from ..fit.loop import DivergedError
from ..fit.run import Record, interrupts_held
from ..fit.smooth_volume import ContinuousPrior, Descent, KnownLevels, VolumeProblem
from ..fit.whitened import WhitenedFrames
from ..geometry import Grid
from ..matter import DeltaBeta
from ..memory import memory_kept
from ..model import Instrument, Model
from ..optics.background import Light
from ..optics.noise import NoiseModel
from ..optics.sampling import fringe_sampling
from ..representations import VoxelGrid
from ..scan import Scan
from .modulation import modulated, unshrunk

EXPLAINED, WEAKER = 0.95, 0.98
"""χ² a pixel above which a volume does not explain its frames to within their noise yet, and above which a prior may be
too strong for that; where prior and frames agree it is below one, for the volume follows some of the noise: little of
that of many views, of which a weaker prior made noise three times as wrong as its matter."""
EMPTY = 1.2
"""χ² a pixel up to which an empty volume is taken for the truth, as the noise is known to some per cent only."""
WEAKEST = 1 / 16
"""Share of the prior's exponents that is left at least."""
WORTH = 0.5
"""Share of what is unexplained beyond noise that half a prior must take away; if it does not, light or constants are at
fault, and the volume before stands."""
CLEARLY = 2.0
"""So many times likelier must the start be on voxels of a pixel to take the place of what began with even matter. A
start follows noise and light, which the objective does not punish enough: in scenes in which it ends worse it is up to
1.14 times likelier, in those in which it ends better 2.2 to 44 times (docs/data/beginnings.csv)."""
GROWING, MOST = 1.1, 8
"""The last round is done again while it finds more than so many times the matter before it, so often at most: a prior
too strong for faint matter lets go of it from round to round."""
NOTHING = 1e-3
"""Share of the start's level below which a volume is taken for an empty one."""
FALLING, WINDOW, LONGEST = 0.005, 10, 4
"""A round on voxels of a pixel that does not explain its frames goes on while so many iterations have lowered the
objective by more than this part, up to so many times its iterations: many views of dense beads converge slowly."""
LEAST_EDGE = 12
"""Pixels along a frame's shorter side that larger ones must leave, or the fit is not begun on them."""


@dataclass(frozen=True)
class Leg:
    """A descent. factor: edge of its voxels [pixels]; iterations: at most; kind: a first round from even, faint matter;
    a round from where the one before ended; or one from the coarse volume, or from the start, of which the likelier
    goes on; loose: how many times the level that the volume has is the prior's."""

    factor: int
    iterations: int
    kind: Literal["from even", "round", "from coarse", "from start"] = "round"
    loose: float = 1.0

    @property
    def work(self) -> float:
        """What it takes, in iterations on voxels of a pixel."""
        return (self.iterations + 1) / self.factor**3


@dataclass(frozen=True)
class SmoothPlan:
    """What a smooth volume is fitted to and how. scan: its frames; begun: the start, on voxels of a pixel; noise: of
    the frames; ratio_known: whether δ/β is known, and not estimated; light: what they were divided by, where that is
    uneven; the others are the options of `SmoothVolume`."""

    scan: Scan
    begun: VoxelGrid
    noise: NoiseModel
    ratio_known: bool
    light: Light | None
    prior: ContinuousPrior
    coarser: tuple[int, ...]
    rounds: int
    iterations: int
    faint: float
    loose: float
    backend: str
    known: tuple[DeltaBeta, ...] = ()
    """Materials that are known."""

    @property
    def levels(self) -> KnownLevels:
        """The same in the unit of the start."""
        return KnownLevels(self.known, self.begun.matter.channels[0])

    @property
    def beyond(self) -> Margins:
        """Rows above and below the frames, and columns at either side, in which the start has matter."""
        return margins_of(self.begun.grid, self.scan.views)

    def legs(self) -> tuple[Leg, ...]:
        """All descents: rounds on larger voxels, the choice of the likelier volume, and rounds on those of a pixel."""
        factors = [factor for factor in self.coarser if min(self.scan.views.shape) >= LEAST_EDGE * factor]
        coarse = [Leg(factor, self.iterations) for factor in factors for _ in range(self.rounds)]
        if coarse:
            first = Leg(factors[0], self.iterations, "from even" if self.faint else "round", self.loose)
            coarse = [first, *coarse]
        half = max(1, self.iterations // 2)
        trials = [Leg(1, half, "from coarse"), Leg(1, half, "from start")] if factors else []
        return (*coarse, *trials, *(Leg(1, self.iterations) for _ in range(self.rounds)))

    def frames(self, factor: int) -> WhitenedFrames:
        """The frames on pixels `factor` times larger, in units of their noise; their waves on samples as fine."""
        scan = self.scan.binned(factor)  # the phase behind strong matter is as steep
        samples = min(fringe_sampling(scan.exposures), factor * fringe_sampling(self.scan.exposures, voxels=1))
        noise, material = self.noise.binned(factor), self.begun.matter.channels[0]
        light = self.light and self.light.part(torch.arange(len(self.scan)), factor)
        rows, columns = (n // factor for n in self.beyond)
        how = {"backend": self.backend, "oversample": samples, "beyond": (rows, columns)}
        return WhitenedFrames(scan, material, noise, **how, doubt=light)


class SmoothFit:
    """A smooth volume in progress, as a run asks of every fit (`fit.run`)."""

    aside = 0
    stopped_early = False
    best_step = 0

    def __init__(self, plan: SmoothPlan) -> None:
        self.plan, self.backend = plan, resolve(plan.backend)
        self.step, self.seconds = 0, 0.0
        self._legs, self._leg = plan.legs(), 0
        self._volume = plan.begun
        self._rival: tuple[Tensor, float] | None = None
        self._level, self._more = 0.0, 0
        self._strength, self._settled, self._kept, self._refused = 1.0, False, False, False
        self._stronger: tuple[VoxelGrid, float] | None = None
        self._descent: Descent | None = None
        self._begun = plan.begun.values[0]
        self._values: list[float] = []
        self._frames: tuple[int, WhitenedFrames] | None = None

    @property
    def oversample(self) -> int:
        """Wave samples a pixel."""
        return fringe_sampling(self.plan.scan.exposures, voxels=1)

    @property
    def finished(self) -> bool:
        """Whether all legs are done."""
        return self._leg == len(self._legs)

    @property
    def share(self) -> float:
        """How much of the work is done."""
        work = [leg.work for leg in self._legs]
        done = sum(work[: self._leg])
        if self._descent is not None and not self.finished:
            done += work[self._leg] * self._descent.done / (self._legs[self._leg].iterations + 1)
        return done / max(sum(work), 1e-30)

    @property
    def voxels(self) -> VoxelGrid:
        """The volume as it is now, on voxels of a pixel."""
        found = self._volume
        if self._descent is not None:
            found = found.with_parameters({"values": self._descent.u[None].cpu()})
        grid = self.plan.begun.grid
        return found if found.grid == grid else found.resampled(grid)

    def result(self) -> Model:
        """The model of the volume as it is now."""
        return Model(self.voxels, Instrument(self.plan.scan.exposures, self.oversample, backend=self.backend))

    def resolved(self) -> dict[str, Any]:
        """What the options have become."""
        return {"voxels_px": sorted({leg.factor for leg in self._legs}, reverse=True), "prior_share": self._strength}

    def columns(self) -> list[str]:
        """Names of what a record holds."""
        return ["step", "seconds", "loss", "voxel_px"]

    def run(self, on_record: Callable[[Record], None], until: int | None = None) -> None:
        """Advance to the end (or to step `until`), with one record an iteration; Ctrl-C is passed on between two."""
        with memory_kept(), interrupts_held() as release:
            while not self.finished and (until is None or self.step < until):
                started = time.perf_counter()
                value = self._advance()
                self.seconds += time.perf_counter() - started
                if value is not None:
                    on_record(value | {"seconds": self.seconds})
                release()

    def _advance(self) -> Record | None:
        """One iteration of the leg that is under way, begun and ended where it is time; its record."""
        leg = self._legs[self._leg]
        if self._descent is None and not self._begin(leg):
            self._leg += 1
            return None
        assert self._descent is not None
        descent, record = self._descent, None
        if not self._done(leg, descent):
            before = descent.done
            descent.step()
            if descent.done > before:
                self.step += 1
                self._values = [*self._values[-WINDOW:], descent.value]
                record = {"step": self.step, "loss": descent.value, "voxel_px": leg.factor}
                if not torch.isfinite(torch.tensor(descent.value)):
                    raise DivergedError(self.step)
        if descent.ended or self._done(leg, descent):
            self._end(leg, descent)
        return record

    def _done(self, leg: Leg, descent: Descent) -> bool:
        """Whether a descent has had its iterations, and those that it needs beyond them."""
        more = descent.done - leg.iterations
        if more < 0:
            return False
        longer = leg.factor == 1 and leg.kind == "round" and len(self._values) > WINDOW
        if not longer or descent.done >= LONGEST * leg.iterations:
            return True
        if more % WINDOW:  # asked now and then, for it takes a projection
            return False
        falling = self._values[0] - descent.value > FALLING * abs(descent.value)
        assert isinstance(descent.problem, VolumeProblem)
        return not falling or descent.problem.unexplained(descent.u) <= EXPLAINED

    def _begin(self, leg: Leg) -> bool:
        """Make the descent of a leg; False where there is nothing to be done."""
        begun = self.plan.begun
        if leg.kind == "from start":
            if self._rival is None:
                return False
            self._descent = self._descent_from(begun.values[0], leg)
            return True
        grid = begun.grid if leg.factor == 1 else Grid.of_views(self._frames_of(leg.factor).field)
        if self._volume.grid != grid:
            self._volume = self._volume.resampled(grid)
        u = self._volume.values[0]
        if not bool(u.any()):  # the frames show nothing but noise
            if leg.kind == "from coarse":
                self._volume = begun
            return False
        if leg.kind == "from even":
            u = torch.full_like(u, self.plan.faint * plateau(u.abs()))
        self._level = leg.loose * plateau(u.abs())
        self._descent = self._descent_from(u, leg)
        return True

    def _descent_from(self, u: Tensor, leg: Leg) -> Descent:
        """A descent that begins at u [Z, Y, X], where the backend computes."""
        self._begun = u
        problem = self.problem(leg.factor, u, self._level)
        return Descent(problem, u.to(problem.device), self._kept)

    def _end(self, leg: Leg, descent: Descent) -> None:
        """Take in what a descent has found.

        Low frequencies, of which noisy frames say little, converge on large voxels first, and from next to no matter:
        what a start has taken of noise and light into its matter the fit would keep. The coarse volume goes on if it
        explains its frames to within their noise after half a round, or if the start is not `CLEARLY` likelier by then.
        Without noise, the details that large voxels lack disturb them, and the start is nearer.

        Where a descent fell into the trap of an empty volume, which does not explain the frames, it is begun again with
        shorter steps. How strong a prior noise allows depends on how many views and how much matter there are; so it is
        halved where an empty volume is likelier still, and where voxels of a pixel do not explain the frames to within
        their noise (Morozov's discrepancy principle, 1966), as long as that helps.
        """
        problem, u = descent.problem, self._or_nothing(descent.u)
        assert isinstance(problem, VolumeProblem)
        self._descent, self._values = None, []
        if self._kept and self._leg == len(self._legs) - 1:
            empty = torch.zeros_like(u)
            u = empty if problem(empty)[0] <= descent.value else u
        unexplained = problem.unexplained(u)
        if self._grown(problem, u):
            return
        if leg.kind == "from coarse" and unexplained > 1:
            self._rival = (u, descent.value)
        elif leg.kind == "from start" and self._rival is not None:
            other, value = self._rival
            clearly = CLEARLY if self.plan.faint else 1.0
            u, self._rival = (u if clearly * descent.value < value else other), None
        found = self._volume.with_parameters({"values": u[None].cpu()})
        if not self._weakened(found, unexplained, problem):
            if leg.kind in ("round", "from even") and bool(self._volume.values.any()):
                u = self._mended(problem, self._volume.values[0].to(problem.device))
                self._volume = self._volume.with_parameters({"values": u[None].cpu()})
            self._leg += 1

    def _or_nothing(self, u: Tensor) -> Tensor:
        """u, or an empty volume for one that is next to nothing beside the start."""
        faint = bool(u.any()) and plateau(u.abs()) < NOTHING * plateau(self.plan.begun.values[0].abs())
        return torch.zeros_like(u) if faint else u

    def _grown(self, problem: VolumeProblem, u: Tensor) -> bool:
        """Whether the last round has found so much more matter that it is done once more, from there."""
        if self._leg < len(self._legs) - 1 or self._more == MOST or not bool(u.any()):
            return False
        more = modulated(problem, u)
        if float(more.abs().sum()) <= GROWING * float(self._volume.values.abs().sum()):
            return False
        self._volume, self._more = self._volume.with_parameters({"values": more[None].cpu()}), self._more + 1
        return True

    def _mended(self, problem: VolumeProblem, u: Tensor) -> Tensor:
        """u with what the prior has taken: the edges' way between rounds, the total's at the end. Low frequencies see
        the total by its absorption, so where δ/β was estimated they are no better than the others; nor where matter
        lies on both sides of its medium, whose total may be nothing."""
        last = self._leg == len(self._legs) - 1
        told = last and self.plan.ratio_known and not self.plan.prior.two_sided
        return unshrunk(problem, u, self.plan.light is not None) if told else modulated(problem, u)

    def _weakened(self, found: VoxelGrid, unexplained: float, problem: VolumeProblem) -> bool:
        """Whether the fit goes back to its start with half the prior. Else it goes on from `found`, or from what a
        stronger prior found; not from one that explained next to nothing, as a nearly empty volume does. Half a prior
        that was refused is not tried again: where nothing is left then, what the stronger one found stands."""
        self._volume = found
        if not bool(found.values.any()):
            if self._refused and self._stronger:
                self._volume = self._stronger[0]
                return False
            if again := unexplained > EMPTY and self._strength > WEAKEST:
                self._again(self._strength / 2 if self._kept else self._strength)
                self._kept, self._settled = True, False
            return again
        late = self._leg >= len(self._legs) - max(1, self.plan.rounds - 1)  # a first round is often not at its end yet
        if not late or self._settled:
            return False
        if self._stronger is not None and unexplained - 1 > WORTH * (self._stronger[1] - 1):
            (self._volume, _), self._strength = self._stronger, 2 * self._strength
            self._settled = self._refused = True
            return False
        self._settled = unexplained <= WEAKER or self._strength <= WEAKEST
        if not self._settled:
            empty = problem.unexplained(torch.zeros_like(found.values[0], device=problem.device))
            self._stronger = (found, unexplained) if unexplained - 1 < WORTH * (empty - 1) else None
            self._again(self._strength / 2)
        return not self._settled

    def _again(self, strength: float) -> None:
        """Begin anew with a prior of that `strength`."""
        self._leg, self._volume, self._rival, self._strength = 0, self.plan.begun, None, strength

    def problem(self, factor: int, u: Tensor, level: float) -> VolumeProblem:
        """What a descent from u [Z, Y, X] minimises, on voxels of `factor` pixels, of matter of that level."""
        prior = self.plan.prior.weakened(self._strength).on_larger_voxels(factor)
        prior = replace(prior, levels=self.plan.levels.occupancies)
        problem = VolumeProblem(self._frames_of(factor), prior, level, self.plan.backend)
        beside = self.plan.levels.absorbed(u.to(problem.device))
        problem.frames.absorbed = None if beside is None else problem.lines(beside)
        return problem

    def _frames_of(self, factor: int) -> WhitenedFrames:
        if self._frames is None or self._frames[0] != factor:
            self._frames = factor, self.plan.frames(factor)
        return self._frames[1]

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load` needs to go on as if nothing had happened."""
        return {
            "step": self.step,
            "seconds": self.seconds,
            "leg": self._leg,
            "strength": self._strength,
            "settled": self._settled,
            "kept": self._kept,
            "refused": self._refused,
            "stronger": self._stronger and [self._stronger[0].state(), self._stronger[1]],
            "volume": self._volume.state(),
            "level": self._level,
            "more": self._more,
            "values": self._values,
            "rival": None if self._rival is None else [self._rival[0].cpu(), self._rival[1]],
            "descent": None if self._descent is None else self._descent.state_dict() | {"begun": self._begun.cpu()},
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state."""
        self.step, self.seconds = int(state["step"]), float(state["seconds"])
        self._leg, self._level, self._strength = int(state["leg"]), float(state["level"]), float(state["strength"])
        self._more, self._values = int(state["more"]), [float(value) for value in state["values"]]
        self._settled, self._kept, self._refused = (bool(state.get(name)) for name in ("settled", "kept", "refused"))
        before, rival = state["stronger"], state["rival"]
        self._stronger = before and (VoxelGrid.from_state(before[0]), float(before[1]))
        self._volume = VoxelGrid.from_state(state["volume"])
        self._rival = rival and (rival[0].to(device(self.backend)), float(rival[1]))
        self._descent = None
        if state["descent"] is not None:
            factor = self._legs[self._leg].factor
            self._begun = state["descent"]["begun"]
            problem = self.problem(factor, self._begun, self._level)
            self._descent = Descent.again(problem, state["descent"], problem.device)
