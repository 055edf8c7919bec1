"""A network's guess beside phase retrieval, as hypotheses about where a fit starts.

The network knows the bodies that it was trained on. Of others its guess is wrong in a way that it does not see itself,
and what the fit makes of it may be worse than what it makes of the ordinary start. So every start is fitted to one half
of the noise and scored on the other (data fission): phase retrieval is the null, the guess and, in two beams, red cells
by their shape at rest (`red_cells`) must predict better.

Two views leave most of a volume open, but not the poses of bodies whose shape is known. So where a network that knows
red cells guesses bodies that the frames do not contradict, cells are looked for by their shadows as `track --body` does
(`bodies`), of a size that is the guess's, and begin with its bodies. Their surfaces are then fitted like any others,
free of the shape at rest, and each cell is tried as its twin (`bodies.poses`), which two beams hardly tell from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from ..bodies.poses import distance, twin_map, two_beams
from ..bodies.rest_shape import KnownBody, cut_bodies, extent_like, guessed_cells, is_cut, moments, second_moments
from ..bodies.search import BodySearch, sized
from ..checks import InputError
from ..inference import Decision, Score, select
from ..learning.start import Guessed, GuessedMatter, guess_matter
from ..matter import DeltaBeta, Matter
from ..mesh import TriangleMesh
from ..representations import GaussianCloud, SurfaceMesh
from .coarse import Way, first_of, in_steps
from .cross_validation import BY_FISSION, Folds, predicted_frames
from .gaussian_options import GaussianOptions
from .method import Task, run_quietly
from .start import cloud_of, starting_cloud
from .surface_fit import SurfaceFit, SurfaceOptions, extract_surfaces, oversampling, surface_fit
from .volume import material_of_levels

POSES = "red cells by their shape"
FIRST_STEPS, TRIAL_STEPS, LAST_STEPS = 400, 200, 120
"""Steps of the surfaces before twins are tried, of each trial, and after all of them. By trials of 80 steps fewer cells
were told from their twins: Dice .895 and .951 in place of .918 and .972 (flowing cells, two times, looked at once)."""
ROUNDS, MOST_TRIALS = 3, 60
"""How often every cell is tried as its twin, at most, and trials of cells in all: each fits all of them, twice."""
MOST_CELLS = 20
"""Bodies of a guess, at most: search and trials take minutes for so many, and go with the square of the number."""
ALIKE = 0.8
"""Dice coefficient of the cells and the guess, over that of guesses and truths of scenes like those that were learnt,
which cells must have. Of right ones it was 0.88 to 1.3; of single continuous cells, whose shadows red cells turned
the wrong way explain, 0.62 and 0.70 (six scenes, looked at once)."""
APART = 0.05
"""Distance of a cell and its twin, over its extent, from which on it is tried: nearer ones become one in a fit."""
BETTER = 1e-3
"""Part of the loss that a trial must take away to be gone on from."""
SEARCHED = 0.6
"""About the share of the work that the search is."""


def red_cells(task: Task, guess: Guessed, material: DeltaBeta, typical: float = 0.0) -> SurfaceMesh | None:
    """Surfaces of the red cells of `material` in the frames of `task`, of which a network has made a `guess`; None for
    other than two beams and one pixel size, where no cells of its size are found, and where these are unlike it.

    typical: Dice coefficient of the network's guesses from so many views, of scenes like those that it learnt from
    """
    views = task.scan.views
    beams = two_beams(views)
    if beams is None or np.ptp(views.pixel_sizes) > 0 or task.scan.is_series:
        return None
    seen = cut_bodies(guess.values.numpy(), guess.grid, views.finest)
    if not 0 < len(seen) <= MOST_CELLS:
        return None
    whole = [mesh for mesh in seen if not is_cut(mesh, views)] or seen
    try:
        posed = _posed(task, material, guessed_cells(extent_like(whole)), seen)
    except InputError:  # of less than three pixels, or hundreds
        return None
    if posed is None:
        return None
    found = _told_from_twins(task, posed, beams)
    return found if _alike(found, guess) >= ALIKE * typical else None


def _alike(cells: SurfaceMesh, guess: Guessed) -> float:
    """Dice coefficient of what both fill."""
    ours = cells.voxelise(guess.grid).delta / cells.matter.delta
    both, theirs = np.minimum(ours, guess.values.numpy()), guess.values.numpy()
    return float(2 * both.sum() / max(ours.sum() + theirs.sum(), 1e-12))


@dataclass(frozen=True)
class _Posed:
    """Cells of the same triangles. rest: their shape at rest; nodes: [B, P, 3] where they are; both in pixels."""

    rest: TriangleMesh
    nodes: np.ndarray
    matter: Matter
    pixel: float

    def surfaces(self) -> SurfaceMesh:
        """All of them."""
        count, points = self.nodes.shape[:2]
        faces = np.concatenate([self.rest.faces + points * k for k in range(count)])
        vertices = torch.from_numpy(self.nodes.reshape(-1, 3).copy())
        return SurfaceMesh(vertices, torch.from_numpy(faces), self.pixel, self.matter)

    def moved_to(self, surfaces: SurfaceMesh) -> _Posed:
        """The same triangles at the vertices of `surfaces`."""
        return replace(self, nodes=surfaces.vertices.detach().cpu().double().numpy().reshape(self.nodes.shape))

    def plain(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Middle [3] of a cell, and its vertices [P, 3] about that as the nearest linear map of the shape at rest, of
        the same volume; no numbers where one of the two is inside out."""
        mesh = replace(self.rest, vertices=self.nodes[number])
        volume, middle, _ = moments(mesh)
        shape = self.rest.vertices
        linear = shape @ np.linalg.lstsq(shape, mesh.vertices - middle, rcond=None)[0]
        share = volume / replace(self.rest, vertices=linear).volume
        return middle, linear * (share ** (1 / 3) if share > 0 else np.nan)

    def second(self, vertices: np.ndarray) -> np.ndarray:
        """Second moments [3, 3] over the volume of a cell of `vertices` [P, 3]."""
        return second_moments(replace(self.rest, vertices=vertices))

    def with_cell(self, number: int, vertices: np.ndarray) -> _Posed:
        """The same with other `vertices` [P, 3] of one cell."""
        nodes = self.nodes.copy()
        nodes[number] = vertices
        return replace(self, nodes=nodes)


def _posed(task: Task, material: DeltaBeta, body: KnownBody, seen: Sequence[TriangleMesh]) -> _Posed | None:
    """The cells that shadows show, where the search may begin with the meshes `seen` [m]."""
    pixel, time = task.scan.views.pixel_size, float(task.scan.exposures.time[0])
    search = BodySearch.of(task.scan, material, body, (time - 1, time + 1))
    like = [search.like(mesh, pixel) for mesh in seen]
    report = task.report(POSES)
    poses, _ = search.poses(np.zeros((1, 3)), like, seed=task.seed, on_progress=lambda part: report(SEARCHED * part))
    if not poses:
        return None
    size, poses = search.of_best_size(poses)
    rest = sized(body.mesh(pixel), size)
    nodes = np.array([pose.scaled(search.bin).nodes(rest.vertices, 0.0) for pose in poses])
    return _Posed(rest, nodes, Matter.one(*material), pixel)


def _told_from_twins(task: Task, posed: _Posed, beams: np.ndarray) -> SurfaceMesh:
    """The surfaces of the cells fitted to the frames, each as it is or as its twin, whichever leaves less.

    Trials begin at shapes without details, for those that were fitted would speak for the cell that was there.
    """
    report = task.report(POSES)
    (loss, now), left = _fitted(task, posed, FIRST_STEPS), MOST_TRIALS
    for _ in range(ROUNDS):
        changed, away = False, np.array([_away(now, k, beams) for k in range(len(now.nodes))])
        order = [int(k) for k in np.argsort(-away) if away[k] > APART][:left]
        for number in order:
            report(1 - (1 - SEARCHED) * left / MOST_TRIALS)
            left -= 1
            middle, plain = now.plain(number)
            twin = plain @ twin_map(now.second(plain), beams).T
            tried = [_fitted(task, now.with_cell(number, middle + one), TRIAL_STEPS) for one in (plain, twin)]
            best = min(tried, key=lambda one: one[0])
            if best[0] < (1 - BETTER) * loss:
                loss, now = best
                changed |= best is tried[1]
        loss, now = _fitted(task, now, LAST_STEPS)
        if not changed:
            break
    return now.surfaces()


def _away(posed: _Posed, number: int, beams: np.ndarray) -> float:
    """How far a cell is from its twin, over its extent; 0 for one that a fit has turned inside out."""
    vertices = posed.plain(number)[1]
    return distance(posed.second(vertices), beams) if np.isfinite(vertices).all() else 0.0


def _fitted(task: Task, posed: _Posed, steps: int) -> tuple[float, _Posed]:
    """What is left of the frames after so many steps, and the cells."""
    fit = surface_fit(task.scan, posed.surfaces(), in_steps(SurfaceFit(), steps), task.seed, task.uneven)
    fit.run(lambda record: None)
    found = fit.result().object
    assert isinstance(found, SurfaceMesh)
    return math.exp(fit.left()), posed.moved_to(found)


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
    fit = replace(in_steps(SurfaceFit(), steps), backend=start.backend)
    return run_quietly(surface_fit(task.scan, start, fit, task.seed, task.uneven), task.report(STAGE), SurfaceMesh)


def _cut(task: Task, cloud: GaussianCloud, surfaces: SurfaceOptions) -> SurfaceMesh | None:
    """The surfaces of a cloud; None where there are none."""
    try:
        return extract_surfaces(cloud, task.scan, surfaces.extraction)
    except InputError:  # no surface anywhere
        return None
