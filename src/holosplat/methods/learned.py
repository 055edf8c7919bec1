"""A network's guess beside phase retrieval, as hypotheses about where a fit starts.

The network knows the bodies that it was trained on. Of others its guess is wrong in a way that it does not see itself,
and what the fit makes of it may be worse than what it makes of the ordinary start. So every start is fitted to one half
of the noise and scored on the other (data fission): phase retrieval is the null, the guess and, in two beams, red cells
by their shape at rest (`posed`) must predict better.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from ..checks import InputError
from ..inference import Decision, Score, select
from ..learning.start import GuessedMatter, guess_matter
from ..representations import GaussianCloud, SurfaceMesh
from .coarse import Way, first_of
from .cross_validation import predicted_frames
from .first_volumes import BY_FISSION, Folds
from .gaussian_options import GaussianOptions
from .method import Task, run_quietly
from .posed import red_cells
from .sharp_level import material_of_levels
from .start import cloud_of, starting_cloud
from .surface_fit import SurfaceFit, SurfaceOptions, extract_surfaces, oversampling, surface_fit

STAGE = "starts"
NAME = "start"
PLAIN, GUESS, CELLS = "phase retrieval", "network's guess", "red cells at rest"
NOT_ASKED = Decision(NAME, PLAIN, "matter is continuous, and the network guesses bodies")

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
    where the run is the same as without it. `task.on_start` is told the decision, and the guess.

    fitted: the fit of Gaussians; plain: the null, as surfaces where it is some. Errors: those of `guess_matter`, of the
    weights' file and of all starts.
    """
    if len(task.prior.materials) > 1:
        task.on_start(Decision(NAME, PLAIN, "several materials are known, and the network guesses one"), None)
        return None
    material = material_of_levels(task, options.volume.backend, options.estimate)
    how, trained = options.learned, options.learned.network
    found = guess_matter(task.scan, material, trained.network, task.on_progress)
    starts: dict[str, Start] = {PLAIN: plain()}
    if how.cells and task.bounded and trained.card.of_red_cells:
        cells = red_cells(task, found, material, trained.card.dice(len(task.scan)))
        starts |= {} if cells is None else {CELLS: cells}  # a shape at rest is simpler than any shape
    starts[GUESS] = cloud_of(found.values, found.grid, material, task, options)
    decision = select(NAME, tuple(starts), _Fits(task, options, fitted, starts).score, by=BY_FISSION)
    task.on_start(decision, GuessedMatter.of(found, material, trained.network))
    return None if decision.choice == PLAIN else starts[decision.choice]


@dataclass(frozen=True)
class _Fits:
    """Fits of all starts to one half of the noise, each made once. Starts are of all frames, which is fair to all."""

    task: Task
    options: GaussianOptions
    fitted: Fitted
    starts: Mapping[str, Start]
    _scores: dict[str, Score] = field(default_factory=dict)

    def score(self, name: str, fold: int) -> Score:
        """Of the frames that the fit from a start predicts, on the other half.

        Gaussians become surfaces where they have some: these hold edges, and cannot explain by half a density what is
        in the wrong place.
        """
        assert fold == 0
        if name not in self._scores:
            self._scores[name] = self._score(name)
        return self._scores[name]

    def _score(self, name: str) -> Score:
        seen, unseen = Folds(self.task.scan, 1, BY_FISSION).split(0)
        task = replace(
            self.task, scan=seen, on_progress=lambda _, done: self.task.on_progress(f"{STAGE}: {name}", done)
        )
        start, how, found = self.starts[name], self.options.learned, None
        if isinstance(start, SurfaceMesh):
            found = _settled(task, start, how.trial_surfaces)
        else:
            start = self.fitted(task, start, how.trial_steps)
            found = _surfaces(task, start, how.trial_surfaces) if task.bounded else None
        samples = 0 if found is None else oversampling(seen)
        return Score.of(unseen.left(predicted_frames(unseen.exposures, found or start, samples).double()))


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
