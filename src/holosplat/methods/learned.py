"""A network's guess beside phase retrieval: both are fitted for a while, and what explains the frames better is begun
with.

The network knows the bodies that it was trained on. Of others its guess is wrong in a way that it does not see itself,
and what the fit makes of it may be worse than what it makes of the ordinary start. So the guess has to leave clearly
less of the frames unexplained than that, beyond their noise, and more surely than noise could; where it does not, the
run is the same as without a network. In two beams red cells by their shape at rest are a third start, of which the same
is asked (`posed`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from torch import Tensor

from ..checks import InputError
from ..learning.start import GuessedMatter, LearnedStart, contradicted, guessed
from ..matter import DeltaBeta
from ..representations import GaussianCloud, SurfaceMesh
from ..units import in_percent
from .beginning import Beginning
from .coarse import Way, first_of
from .cross_validation import MissingMatter, predicted_frames
from .evidence import Evidence
from .gaussian_options import GaussianOptions
from .method import Task, run_quietly
from .posed import red_cells
from .sharp_level import material_of_levels
from .start import cloud_of, starting_cloud
from .surface_fit import SurfaceFit, SurfaceOptions, extract_surfaces, oversampling, surface_fit

STAGE = "both starts"

Fitted = Callable[[Task, GaussianCloud, int], GaussianCloud]
"""A cloud after so many steps."""

Start = GaussianCloud | SurfaceMesh
"""What a run may begin with."""

Plain = Callable[[], Start]
"""What the run begins with where no network is asked."""


def ways_of_guess(
    task: Task, ways: Sequence[Way], options: GaussianOptions, surfaces: SurfaceOptions, fitted: Fitted
) -> Sequence[Way]:
    """Ways to first surfaces: of Gaussians fitted from the network's guess, or red cells by their shape, where one of
    these is begun with, else `ways`.

    ways: those without a network, each of which is gone once only; fitted: the fit of Gaussians. Errors: as for
    `guessed_start`.
    """
    ways, how = [_once(way) for way in ways], options.coarse.of_views(len(task.scan.train()))

    def plain() -> Start:
        found = first_of(task, ways, surfaces, how)
        return starting_cloud(task, replace(options, start="phase")) if found is None else found

    start = guessed_start(task, options, fitted, plain)
    if start is None:
        return ways

    def of_guess(before: SurfaceMesh | None) -> SurfaceMesh | None:
        if isinstance(start, SurfaceMesh):
            return start
        return _cut(task, fitted(task, start, options.fit.schedule.steps), surfaces)

    return (of_guess,)


def _once(way: Way) -> Way:
    """The same way, which is gone once: what came before it is the same every time."""
    found = list[SurfaceMesh | None]()

    def gone(before: SurfaceMesh | None) -> SurfaceMesh | None:
        if not found:
            found.append(way(before))
        return found[0]

    return gone


def guessed_start(task: Task, options: GaussianOptions, fitted: Fitted, plain: Plain) -> Start | None:
    """The cloud of the network's guess, or red cells of its size by their shape at rest (`posed.red_cells`), or None
    where the run is the same as without it. `task.on_beginning` is told which, and why.

    fitted: the fit of Gaussians; plain: what the guess has to do clearly better than, as surfaces where it is some.
    Errors: those of `guessed`, of the weights' file and of all starts.
    """
    if len(task.prior.materials) == 2:
        why = "The network guesses one material, and two are known: the run began with phase retrieval."
        return _begun(task, Beginning("phase", why))
    material = material_of_levels(task, options.volume.backend, options.estimate)
    how, trained = options.learned, options.learned.network
    found = guessed(task.scan, material, trained.network, task.on_progress)
    guess = GuessedMatter.of(found, material, trained.network)
    refused = contradicted(found, how, trained.card)
    if refused:
        why = f"The frames contradict the network's guess ({refused}): the run began with phase retrieval."
        return _begun(task, Beginning("phase", why, guess))
    starts = _Starts(task, options, material, fitted)
    cloud, ordinary = cloud_of(found.values, found.grid, material, task, options), plain()
    won, why = starts.compared(ordinary, cloud)
    if how.cells and task.bounded and trained.card.of_red_cells:
        cells = red_cells(task, found, material, trained.card.dice(len(task.scan)))
        better, said = (False, "") if cells is None else starts.cells_beside(cells, cloud if won else ordinary, won)
        if better:
            return _begun(task, Beginning("cells", said, guess), cells)
        why += f" {said}" if said else ""
    return _begun(task, Beginning("learned" if won else "phase", why, guess), cloud if won else None)


@dataclass(frozen=True)
class _Starts:
    """Compares starts by what they leave of the frames after fits."""

    task: Task
    options: GaussianOptions
    material: DeltaBeta
    fitted: Fitted
    _trials: dict[tuple[int, tuple[int, int]], _Trial] = field(default_factory=dict)

    @cached_property
    def evidence(self) -> Evidence:
        """By which they are judged."""
        return Evidence(MissingMatter(self.task.scan, self.material), self.task.noise)

    def compared(self, plain: Start, cloud: GaussianCloud) -> tuple[bool, str]:
        """Whether the cloud, of the guess, is begun with, and why.

        A short fit of both says whether the guess may be better. It is taken if it still is after the steps of a whole
        one: in noise the ordinary start takes longest to find edges.
        """
        how, told = self.options.learned, list[str]()
        rounds = {"for a while": (how.trial_steps, how.trial_surfaces), "to the end": self._whole}
        for said, steps in rounds.items():
            ordinary, learned = (self._tried(start, steps) for start in (plain, cloud))
            told.append(
                f"fitted {said}, {{}} leaves {in_percent(learned.left)} of the frames unexplained, "
                f"and phase retrieval {in_percent(ordinary.left)}"
            )
            if not learned.clearly_better(ordinary, self.evidence, how):
                first, *others = told
                why = "; ".join((first.format("the network's guess"), *(each.format("it") for each in others)))
                return False, f"The run began with phase retrieval: {why}."
        return True, f"The run began with the network's guess: {'; '.join(each.format('it') for each in told)}."

    def cells_beside(self, cells: SurfaceMesh, best: Start, of_guess: bool) -> tuple[bool, str]:
        """Whether `cells` are begun with in place of the better one of the other starts, and why."""
        ours, other = (self._tried(start, self._whole) for start in (cells, best))
        taken = ours.clearly_better(other, self.evidence, self.options.learned)
        name = "the network's guess" if of_guess else "phase retrieval"
        said = (
            f"fitted to the end, they leave {in_percent(ours.left)} of the frames unexplained, and {name} "
            f"{in_percent(other.left)}"
        )
        return taken, (
            f"The run began with red cells of the guess's size, found by their shape at rest: {said}."
            if taken
            else f"Red cells of the guess's size, by their shape at rest, were not begun with: {said}."
        )

    @property
    def _whole(self) -> tuple[int, int]:
        return self.options.learned.last_steps, self.options.learned.last_surfaces

    def _tried(self, start: Start, steps: tuple[int, int]) -> _Trial:
        """What comes of a start, each once."""
        key = id(start), steps
        if key not in self._trials:
            self._trials[key] = _Trial.of(self.task, start, self.evidence, steps, self.fitted)
        return self._trials[key]


def _begun(task: Task, beginning: Beginning, start: Start | None = None) -> Start | None:
    task.on_beginning(beginning)
    return start


@dataclass(frozen=True)
class _Trial:
    """left: what a start leaves unexplained of the frames after a fit, beyond their noise; predicted: frames [V, H, W]
    of what it became; closed: whether these are surfaces."""

    left: float
    predicted: Tensor
    closed: bool

    @classmethod
    def of(
        cls,
        task: Task,
        start: Start,
        evidence: Evidence,
        steps: tuple[int, int],
        fitted: Fitted,
    ) -> _Trial:
        """That of `start`, as Gaussians, and then as surfaces where it has some: they hold edges, and cannot explain by
        half a density what is in the wrong place. steps: of both."""
        quiet = replace(task, on_progress=lambda stage, fraction: task.on_progress(STAGE, fraction))
        if isinstance(start, SurfaceMesh):
            surfaces = _settled(quiet, start, steps[1])
            found = surfaces
        else:
            found = fitted(quiet, start, steps[0])
            surfaces = _surfaces(quiet, found, steps[1]) if task.bounded else None
        samples = 0 if surfaces is None else oversampling(task.scan)
        predicted = predicted_frames(task.scan.exposures, found if surfaces is None else surfaces, samples)
        return cls(evidence.left(predicted), predicted, surfaces is not None)

    def clearly_better(self, other: _Trial, evidence: Evidence, how: LearnedStart) -> bool:
        """Whether it explains the frames clearly, and surely, better than another one, of the same kind."""
        clearly = self.closed == other.closed and self.left < how.clearly * other.left
        return clearly and evidence.sureness(self.predicted, other.predicted) > how.sure


def _surfaces(task: Task, cloud: GaussianCloud, steps: int) -> SurfaceMesh | None:
    """The surfaces of a cloud after so many steps; None where there are none."""
    start = _cut(task, cloud, SurfaceOptions())
    return None if start is None else _settled(task, start, steps)


def _settled(task: Task, start: SurfaceMesh, steps: int) -> SurfaceMesh:
    """Surfaces after so many steps."""
    fit = SurfaceFit()
    fit = replace(fit, schedule=replace(fit.schedule, steps=steps), backend=start.backend)
    found = run_quietly(surface_fit(task.scan, start, fit, task.seed, task.uneven), task.report(STAGE))
    assert isinstance(found, SurfaceMesh)
    return found


def _cut(task: Task, cloud: GaussianCloud, surfaces: SurfaceOptions) -> SurfaceMesh | None:
    """The surfaces of a cloud; None where there are none."""
    try:
        return extract_surfaces(cloud, task.scan, surfaces.extraction)
    except InputError:  # no surface anywhere
        return None
