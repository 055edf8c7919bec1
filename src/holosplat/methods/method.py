"""What a method of reconstruction is: options that know the stages which lead from frames to an Object."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from ..backends import Backend
from ..baselines import HolographicTV
from ..baselines.material import LIKELY_RATIOS
from ..checks import require
from ..fit.pose_refinement import PoseRefinement, with_alignment
from ..fit.run import Run, Running
from ..inference import Decision
from ..learning.start import GuessedMatter
from ..matter import DeltaBeta, MaterialPrior, MatterKind
from ..model import Model
from ..optics.background import Light, LightOptions
from ..optics.noise import NoiseModel
from ..optics.retrieval import absorption_alone
from ..progress import Advance, Progress
from ..representations import KINDS, Stored, VoxelGrid
from ..scan import Scan
from ..tables import with_entries
from .cross_validation import FirstVolumes, Folds
from .keeper import Keeper, Unseen, placed_at, where
from .window import windows_of


def quiet(stage: str, fraction: float) -> None:
    """Progress that nobody looks at."""


def unheard(decision: Decision, guess: GuessedMatter | None) -> None:
    """What a fit starts from, which nobody asks."""


STAND_IN_RATIO = 1.0
"""δ/β that stands for one that frames of absorption alone cannot tell."""


def shows_no_refraction(scan: Scan) -> bool:
    """Whether no frame could show refraction, even of the softest matter that is looked for."""
    return bool(absorption_alone(scan.exposures, 1 / LIKELY_RATIOS[1]).all())


@dataclass(frozen=True)
class Task:
    """What a method is given.

    scan: the training frames, of one time
    prior: what is known of the matter; where nothing is, and the frames show no refraction, δ = β stands for it: any
        ratio explains them equally
    seed: seed of everything random
    on_progress: called with (stage, fraction done of it)
    light: what is assumed of the light
    lit: what the frames say of it, once `illumination.prepared` has decided
    decisions: what was decided so far, and by what evidence
    first: first volumes of coarse frames, which decisions share
    likeliest: the likeliest continuous volume of the frames, where it was made before; its level bounds matter
    matter: whether matter has levels, each with sharp edges, or is continuous (see `settled`)
    delta_told: whether prior or frames say what δ is
    freedom: of where the frames are, which fits then find, too; None: they are where the scan says
    near: whether what the next fit starts from is near to where it ends (see `Near`)
    on_start: called with each decision about where fits start, and the guess, where a network was asked
    """

    scan: Scan
    prior: MaterialPrior
    seed: int = 0
    on_progress: Progress = quiet
    light: LightOptions = field(default_factory=LightOptions)
    lit: Light | None = None
    matter: MatterKind = "levels"
    delta_told: bool = True
    freedom: PoseRefinement | None = None
    near: bool = False
    on_start: Callable[[Decision, GuessedMatter | None], None] = unheard
    decisions: tuple[Decision, ...] = ()
    first: FirstVolumes | None = None
    likeliest: VoxelGrid | None = None

    def __post_init__(self) -> None:
        if not self.prior.fixes_ratio and shows_no_refraction(self.scan):
            object.__setattr__(self, "delta_told", False)
            object.__setattr__(self, "prior", self.prior.with_ratio(STAND_IN_RATIO))

    def in_windows(self) -> Task:
        """The same task on windows about its matter where these save much (`windows_of`), or the task itself.

        Uneven light and free poses are told by whole frames; so is light of which nothing was decided.
        """
        if self.lit is None or self.lit.background is not None or self.freedom is not None:
            return self
        found = windows_of(self.scan, self.noise)
        if found is None:
            return self
        self.on_progress("windows of {} × {} pixels".format(*found.shape), 0.0)
        air, noise = torch.from_numpy(found.cut(self.lit.air.numpy())), self.lit.noise.white
        lit = Light(air, NoiseModel.white_only(noise, found.shape), None)
        return replace(self, scan=found.of(self.scan), lit=lit)

    def of_views(self, chosen: np.ndarray) -> Task:
        """The same task with the frames number `chosen` alone."""
        lit = self.lit and self.lit.part(torch.from_numpy(chosen))
        return replace(self, scan=self.scan[chosen], lit=lit, first=None)

    def lines(self, scan: Scan, material: DeltaBeta, how: HolographicTV) -> Tensor | None:
        """What phase retrieval has found in the frames of `scan` before (`FirstVolumes.lines`), if it has."""
        return None if self.first is None else self.first.lines(scan, material, how)

    def moved(self, fitted: Model) -> Task:
        """The same task with the frames where a fit has found them."""
        if fitted.alignment is None or self.freedom is None:
            return self
        scan = replace(self.scan, exposures=with_alignment(self.scan.exposures, fitted.alignment))
        return replace(self, scan=scan, freedom=self.freedom.after(fitted.alignment))

    @property
    def noise(self) -> NoiseModel:
        """The noise of the frames; what is not known of uneven light counts as such."""
        found = self.lit or Light.of(self.scan.measured, self.light)
        return found.doubt

    @property
    def uneven(self) -> Light | None:
        """The light, where it is uneven."""
        return self.lit if self.lit is not None and self.lit.background is not None else None

    @property
    def unlike_null(self) -> Light | None:
        """Light and noise, where one of them is not that of the null: uneven, or correlated."""
        grainy = self.lit is not None and self.lit.noise.has_grain
        return self.lit if grainy else self.uneven

    @property
    def light_in_words(self) -> str:
        """What the frames say of the light."""
        return "even" if self.lit is None else self.lit.in_words

    @property
    def bounded(self) -> bool:
        """Whether an occupancy cannot exceed one: matter has levels, and one ratio δ/β."""
        return self.matter == "levels" and self.prior.fixes_ratio

    def bound(self, upper: float) -> float:
        """The bound `upper` of the occupancy where matter has levels and its δ is known, else 0 (none)."""
        return self.prior.bound(upper) if self.matter == "levels" else 0.0

    def report(self, stage: str) -> Advance:
        """Progress of one stage: a function of the fraction done."""
        return lambda fraction: self.on_progress(stage, fraction)


def first_of_task(task: Task, backend: Backend = "auto") -> FirstVolumes:
    """The first volumes that the decisions of a task share, computed by `backend` where they are new."""
    if task.first is not None:
        return task.first
    found = FirstVolumes(Folds.of(task.scan), task.prior, task.on_progress)
    return replace(found, options=replace(found.options, backend=backend))


def one_material(task: Task) -> MaterialPrior:
    """What is known of the matter of a task; where its δ/β is not, that of its first volumes."""
    return task.prior if task.prior.fixes_ratio else task.prior.with_ratio(first_of_task(task).material.ratio)


@dataclass(frozen=True)
class Near:
    """A start that is near to where its fit ends, which then takes few steps."""

    object: Stored


class Stage(Protocol):
    """A piece of a reconstruction: an Object is made, and then perhaps fitted."""

    @property
    def name(self) -> str:
        """For progress and summaries."""
        ...

    def start(self, task: Task, before: Stored | None) -> Stored | Near:
        """The Object that this stage begins with; before: what the stage before ended with. It cannot be resumed."""
        ...

    def fit(self, task: Task, start: Stored) -> Running | None:
        """The fit of `start`, made ready, or None where nothing is fitted."""
        ...


@runtime_checkable
class Method(Protocol):
    """Options of a method, as a frozen dataclass; `kind` is its name in tables, files and on the command line.

    kinds_of_matter: those that it can reconstruct, of one material on one side of its medium
    of_series: whether it takes all times of a scan at once; all others take frames of one time
    mixes_kinds: whether states of different kinds of Objects compete for its result
    any_backend: whether GPUs can compute it, too
    likelier: whether fits are likelier than their starts by noise and prior; frames alone prefer what fits their noise
    two_sided: whether its matter may lie on both sides of its medium
    several: whether it has the levels of several known materials
    cones: whether rays may be those of cones
    """

    kind: ClassVar[str]
    kinds_of_matter: ClassVar[tuple[MatterKind, ...]] = ("levels", "continuous")
    of_series: ClassVar[bool] = False
    mixes_kinds: ClassVar[bool] = False
    any_backend: ClassVar[bool] = False
    likelier: ClassVar[bool] = False
    two_sided: ClassVar[bool] = False
    several: ClassVar[bool] = False
    cones: ClassVar[bool] = False

    @property
    def wants_levels(self) -> bool:
        """Whether it matters to the method whether matter has levels."""
        return not self.of_series

    def stages(self) -> Sequence[Stage]:
        """The stages, in their order; each resumes by itself."""
        ...

    def with_effort(self, effort: float) -> Self:
        """The same method with `effort` times the steps, at least one; one without steps is the same."""
        return self

    def on_backend(self, backend: Backend) -> Self:
        """The same method computed by `backend`, its start, too. Errors: `InputError` for one that takes no other."""
        require(self.any_backend, f"the method {self.kind} runs on the CPU only; leave --backend.")
        return with_entries(self, {"backend": backend})

    def require_files(self) -> None:
        """Read the files that the method names, so that one that is missing or damaged is refused before any work.
        Errors: those of reading."""


def begun(stage: Stage, task: Task, before: Stored | None) -> tuple[Stored, Task]:
    """What `stage` starts from, and the task with how near that is; what was near stays so if it is handed on."""
    start = stage.start(task.in_windows(), before)
    if isinstance(start, Near):
        return start.object, replace(task, near=True)
    return start, replace(task, near=task.near and start is before)


def finished(fit: Running) -> Stored:
    """The object that a fit ended with, where it was fitted."""
    found = fit.result().object
    assert isinstance(found, Stored)
    return found.on(fit.backend)


Kind = TypeVar("Kind")


def run_quietly(fit: Running, report: Advance, kind: type[Kind]) -> Kind:
    """Run a fit to its end without keeping records; the object of this kind that it ended with. Ctrl-C is passed on."""
    fit.run(lambda record: report(fit.share))
    found = finished(fit)
    assert isinstance(found, kind)
    return found


class Look(Protocol):
    """Takes in a state of a run; see `Keeper.look`."""

    def __call__(self, name: str, found: Stored, oversample: int, fitted: bool, train: Scan) -> None:
        """Take in the latest one; train: the training frames where they are then."""


def solve_stages(method: Method, task: Task, unseen: Unseen | None = None) -> Stored:
    """Run all stages of `method` in memory, without a folder; the best of their states (`Keeper`), as in a run folder.

    unseen: as of `Keeper`. Ctrl-C is passed on.
    """
    keeper = Keeper(task.scan, method.mixes_kinds, unseen)
    run_stages(method, task, keeper.look)
    assert keeper.best is not None
    return keeper.best.object


class Ended(NamedTuple):
    """What stages came to. object: of the last one that was begun; task: with the frames where they were found; fit:
    the last one; complete: whether all stages came to their end."""

    object: Stored | None
    task: Task
    fit: Running | None = None
    complete: bool = True


def run_stages(method: Method, task: Task, look: Look, run: Run | None = None) -> Ended:
    """Run the stages of `method` on the engine `run`, from where an earlier run was cut off in one of them.

    Ctrl-C is passed on, unless the engine ends a fit there.
    """
    run, task = run or Run(), replace(task, first=first_of_task(task))
    stages, saved, more, ended = method.stages(), run.saved, run.state, Ended(None, task)
    with run.as_written():
        first = int(saved["stage"]) if saved else 0
        require(first < len(stages), f"stage must be below {len(stages)}, but it is {first}.")
    for number in range(first, len(stages)):
        stage, before, again = stages[number], ended.object, bool(saved) and number == first
        if again:
            with run.as_written():
                start, task = begun_before(task, saved)
        else:
            with run.timed("start"):
                start, task = begun(stage, task, before)
        fit = stage.fit(task.in_windows(), start)
        if not again and start is not before and (number == 0 or fit is None):
            look(stage.name if number else "start", start, fit.oversample if fit else 0, False, task.scan)
        ended = Ended(start, task, ended.fit)
        if fit is None:
            continue
        own, report = {"stage": number} | state_of(start, task), task.report(stage.name)
        run.state = lambda own=own: own | more()
        complete = run.fit(stage.name, fit, lambda record, fit=fit, report=report: report(fit.share))
        task = replace(task.moved(fit.result()), near=False)
        found = finished(fit)
        ended = Ended(found, task, fit, complete)
        if not complete:
            break
        look(stage.name, found, fit.oversample, not method.likelier, task.scan)
    return ended


def state_of(start: Stored, task: Task) -> dict[str, Any]:
    """What a stage begins with, in a checkpoint."""
    own = {"start": {"kind": start.kind, "state": start.state()}, "near": task.near}
    if task.freedom is None:
        return own
    return own | {"placed": where(task.scan.exposures), "so_far": torch.from_numpy(task.freedom.so_far)}


def begun_before(task: Task, saved: Mapping[str, Any]) -> tuple[Stored, Task]:
    """What the stage of a checkpoint began with (`state_of`), and the task with its frames where they were then."""
    if task.freedom is not None:
        scan = replace(task.scan, exposures=placed_at(task.scan.exposures, saved["placed"]))
        task = replace(task, scan=scan, freedom=replace(task.freedom, so_far=saved["so_far"].numpy()))
    start = KINDS[saved["start"]["kind"]].from_state(saved["start"]["state"])
    return start, replace(task, near=bool(saved.get("near", False)))
