"""Bodies of known rest shape: on first paths, found in the frames of several times together; and the two-view
ambiguity, a body or its twin (`bodies.poses`), compared by fits to the frames of two beams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch

from ..bodies.neighbourhood_search import Heard
from ..bodies.poses import Pose, distance, map_near, twin_map, two_beams
from ..bodies.rest_shape import KnownBody, moments, second_moments, stretched_like
from ..bodies.search import BodySearch, sized
from ..bodies.shadows import Shadows
from ..checks import require
from ..fit.run import Run
from ..frames import evenly
from ..geometry import Views
from ..inference import ERRORS, Compared, Decision, Score
from ..matter import DeltaBeta, Matter
from ..mesh import TriangleMesh
from ..optics.background import Light
from ..representations import MovingSurfaces, TimeBasis
from ..scan import Scan
from .detections import beside, only, predicted
from .elastic import Elastic, Rest
from .fit import MotionFit, fitted_bodies, motion_fit

SPREAD = (0.85, 1.0, 1.15)
"""Velocities of the search over that of all matter together: a channel's flow is slower at its walls."""


class KnownBodies:
    """The search for bodies of `body`'s rest shape in the training frames of a scan, of views of one pixel size."""

    def __init__(self, train: Scan, material: DeltaBeta, body: KnownBody, size: float = 1.0) -> None:
        """size: of all bodies, relative to the given one."""
        times, self.pixel = train.instants, train.views.pixel_size
        self.material, self.body, self.size = material, body, size
        self.first, self.last = float(times[0]), float(times[-1])
        chosen = times[evenly(len(times), body.instants)]
        frames = train[np.flatnonzero(np.isin(train.exposures.time, chosen))]
        self.fine = body.mesh(self.pixel)
        self.search = BodySearch.of(frames, material, body, (self.first, self.last))
        self.seen, self.bin = self.search.seen, self.search.bin
        self.velocities = drift(self.seen) * np.array(SPREAD)[:, None]
        self.of_begun = False

    def bodies(
        self,
        basis: TimeBasis,
        known: MovingSurfaces | None = None,
        begun: MovingSurfaces | None = None,
        seed: int = 0,
        on_progress: Heard = lambda share: None,
        run: Run | None = None,
    ) -> MovingSurfaces | None:
        """Bodies on paths of `basis` that explain what `known` ones leave of the frames; None where there are none.

        begun: bodies of any shape with which the search may begin; `of_begun` says whether it did. The first search
        finds the size of all bodies. run: keeps the steps.
        """
        search, mesh = self.search, sized(self.search.mesh, self.size)
        if known is not None:
            search = replace(search, seen=self.seen.without(self._shadows(known)))
        like = [] if begun is None else poses_like(begun, mesh, (self.first, self.last), self.pixel * self.bin)
        found, self.of_begun = search.poses(self.velocities, like, self.size, seed, on_progress, run)
        if not found:
            return None
        if known is None and self.body.uncertain > 0:
            self.size, found = search.of_best_size(found, self.size, run)
        return self._paths([pose.scaled(self.bin) for pose in found], basis)

    def _shadows(self, bodies: MovingSurfaces) -> np.ndarray:
        """[N, H, W] thickness of bodies in the frames of the search."""
        middle, half = 0.5 * (self.last + self.first), 0.5 * (self.last - self.first)
        nodes = [bodies.at(middle + half * float(t)).vertices.detach() / self.bin for t in self.seen.times]
        return self.seen.project(nodes, bodies.faces).numpy()

    def _paths(self, poses: Sequence[Pose], basis: TimeBasis) -> MovingSurfaces:
        rest = sized(self.fine, self.size)
        middle, half = 0.5 * (self.last + self.first), 0.5 * (self.last - self.first)
        when = np.linspace(-1, 1, 4 * basis.count)
        nodes = [np.array([pose.nodes(rest.vertices, t) for t in when]) for pose in poses]
        paths = [self.pixel * basis.fitted(middle + half * when, one) for one in nodes]
        matter = Matter.one(*self.material)
        return MovingSurfaces.of_bodies(paths, [rest.faces] * len(paths), basis, self.pixel, matter)


def poses_like(bodies: MovingSurfaces, rest: TriangleMesh, ends: tuple[float, float], unit: float) -> list[Pose]:
    """Poses of `rest` like `bodies` between the times `ends` [s], lengths in `unit` [m]: as long along the same axes as
    these are in the middle of the time, on the straight paths of their centres."""
    first, middle, last = (bodies.bodies(time) for time in (ends[0], 0.5 * sum(ends), ends[1]))
    centres = [np.array([moments(one)[1] / unit for one in meshes]) for meshes in (first, middle, last)]
    return [
        Pose(stretched_like(mesh, rest), centre, 0.5 * (end - start), np.zeros(3))
        for mesh, start, centre, end in zip(middle, *centres)
    ]


def at_rest(body: KnownBody, pixel: float, size: float) -> Rest:
    """The known shape of bodies that are `size` times as large as `body`, on paths in `pixel` [m]."""
    return Rest(Elastic(sized(body.mesh(pixel), size)), body.stiffness)


def beam_directions(views: Views) -> np.ndarray:
    """[U, 3] different directions of the beams, in the object frame."""
    return np.unique(views.rotations[:, 2].round(6), axis=0)


def drift(seen: Shadows) -> np.ndarray:
    """Velocity [3] of all matter together [pixels per unit of time].

    By it shadows of one time correlate best with those of the next one, in each direction that was seen at both.
    """
    rows, moves, instants = [], [], np.unique(seen.times)
    require(len(instants) > 1, "bodies are followed through frames of two times or more.")
    directions = seen.rotations.numpy().reshape(len(seen), -1).round(9)
    for direction in np.unique(directions, axis=0):
        own = np.flatnonzero((directions == direction).all(1))
        own = own[np.argsort(seen.times[own])]
        if len(own) < 2:
            continue
        pause = float(np.median(np.diff(seen.times[own])))
        pairs = [(i, j) for i, j in pairwise(own) if abs(seen.times[j] - seen.times[i] - pause) < 0.2 * pause]
        rows.append(seen.rotations[own[0], :2].numpy())
        moves.append(_displacements(seen, pairs) / pause)
    if not rows:
        return np.zeros(3)
    return np.linalg.lstsq(np.concatenate(rows), np.concatenate(moves), rcond=1e-6)[0]


def _displacements(seen: Shadows, pairs: Sequence[tuple[int, int]]) -> np.ndarray:
    """Displacement (x, y) [pixels] from the first to the second frame of each pair."""
    size = tuple(2 * n for n in seen.shape)
    total = np.zeros(size)
    for i, j in pairs:
        first, second = (np.fft.rfft2(seen.thickness[k], s=size) for k in (i, j))
        total += np.fft.irfft2(second * first.conj(), s=size)
    row, column = np.unravel_index(int(total.argmax()), size)
    return np.array(
        [(column + seen.shape[1]) % size[1] - seen.shape[1], (row + seen.shape[0]) % size[0] - seen.shape[0]]
    )


APART = 0.05
"""Least distance of a body and its twin, over its extent, at which they can be distinguished."""
STRAINED = 10.0
"""Elastic energy by which a twin may exceed its body, in units of its area times the shear modulus: in trials cells in
flow had up to four, their twins in beams across each other half a unit more, in beams at 24° 28 and more."""
STIFF_STEPS, SOFT_STEPS = 10, 40
"""Steps of the two fits of a trial at most."""
FIRST_LOOK = 0.7
"""About the share of the work before the closer ones are looked at again."""
TRIAL_WORTH = 1.0
"""What a step must gain there [nats]: bodies and their twins differ by ten at times."""
SAMPLES = 4
"""Times at which a body that turns is put in its twin's place, for each coefficient of its path."""
NAME, NONE = "twins in two beams", "none"


def trial_of(how: MotionFit, steps: int) -> MotionFit:
    """`how` in so many steps at most, for one body: what it has with others is left out."""
    schedule = replace(how.schedule, steps=min(steps, how.schedule.steps))
    return replace(how, volume_kept=0.0, area_kept=0.0, apart=0.0, worth=TRIAL_WORTH, schedule=schedule)


@dataclass(frozen=True)
class Trials:
    """Settings of the fits that decide. oversample: wave samples a pixel where others are divided out; run: whose
    step each fit is."""

    train: Scan
    rest: Rest
    stiff: MotionFit
    soft: MotionFit
    oversample: int
    seed: int = 0
    light: Light | None = None
    run: Run = field(default_factory=Run)

    def begun(self, frames: Scan, start: MovingSurfaces) -> Tried:
        """A stiff fit of `start` to `frames`."""
        return self._fitted(frames, start, trial_of(self.stiff, STIFF_STEPS))

    def gone_on(self, frames: Scan, tried: Tried) -> Tried:
        """A soft fit to `frames` from there."""
        return self._fitted(frames, tried.bodies, trial_of(self.soft, SOFT_STEPS))

    def _fitted(self, frames: Scan, start: MovingSurfaces, how: MotionFit) -> Tried:
        def tried() -> tuple[torch.Tensor, torch.Tensor]:
            fit = motion_fit(frames, start, how, self.seed, self.light, self.rest)
            found = fitted_bodies(fit)
            left = Score.of(torch.from_numpy(frames.frames - predicted(frames, found, self.oversample)))
            return torch.from_numpy(left.powers), found.coefficients.detach()

        powers, coefficients = self.run.step("twins", tried)
        left = Score(powers.numpy(), len(frames))
        return Tried(left, start.with_parameters({"coefficients": coefficients}))

    def beside(self, bodies: MovingSurfaces, number: int) -> Scan:
        """The frames, divided by those of all `bodies` but one."""
        others = [k for k in range(bodies.count) if k != number]
        return beside(self.train, only(bodies, others), self.oversample) if others else self.train


class Tried(NamedTuple):
    """The residual of a fit, and its bodies."""

    left: Score
    bodies: MovingSurfaces

    def beside(self, body: Tried, number: int) -> Compared:
        """The comparison of a twin with its body."""
        return Compared(f"twin of body {number}", *self.left.gain_over(body.left))


def chosen_twins(
    bodies: MovingSurfaces, trials: Trials, on_progress: Heard = lambda share: None
) -> tuple[MovingSurfaces, Decision | None]:
    """`bodies` of known rest shape, each or its twin, and the decision; as they are for other than two beams.

    Frames are divided by those that all others predict, and the body and its twin are fitted to them, from shapes
    without details: those that were fitted before would speak for the body that was there. The two are alike in
    everything but their pose, so that the likelier one is taken, by however little, if that is sure; a stiff fit alone
    does not tell, for its residual is that of shapes. Where neither is surely likelier, both fits go on when all others
    have been looked at; the body stays in the end.
    """
    beams = two_beams(trials.train.views)
    if beams is None:
        return bodies, None
    plain, now = without_details(bodies, trials.rest), bodies
    asked, fits = in_question(plain, beams, trials.rest), dict[int, tuple[Tried, ...]]()
    compared = dict[int, Compared]()

    def compare(number: int, frames: Scan, tried: Sequence[Tried]) -> None:
        nonlocal now
        body, twin = fits[number] = tuple(trials.gone_on(frames, one) for one in tried)
        compared[number] = twin.beside(body, number)
        now = _placed(now, number, twin.bodies) if compared[number].likelier else now

    for turn, number in enumerate(asked):
        on_progress(FIRST_LOOK * turn / len(asked))
        frames, own = trials.beside(now, number), only(plain, [number])
        compare(number, frames, [trials.begun(frames, start) for start in (own, twinned(own, 0, beams))])
    close = [number for number, each in compared.items() if abs(each.gain) <= ERRORS * each.error]
    for turn, number in enumerate(close):
        on_progress(FIRST_LOOK + (1 - FIRST_LOOK) * turn / len(close))
        compare(number, trials.beside(now, number), fits[number])
    taken = ", ".join(str(number) for number, each in compared.items() if each.likelier)
    return now, Decision(NAME, taken or NONE, "training frames", tuple(compared.values()))


def _placed(now: MovingSurfaces, number: int, twin: MovingSurfaces) -> MovingSurfaces:
    """`now` with `twin` as its body `number`."""
    changed = now.coefficients.detach().clone()
    changed[:, now.body(number)[0]] = twin.coefficients
    return now.with_parameters({"coefficients": changed})


def in_question(bodies: MovingSurfaces, beams: np.ndarray, rest: Rest) -> list[int]:
    """Numbers of the bodies that are apart from their twins, those first that are farthest; without those whose twin is
    too far from the shape at `rest`."""
    away = np.array([distance(second_moments(_middle_mesh(bodies, number)), beams) for number in range(bodies.count)])
    found = [int(number) for number in np.argsort(-away) if away[number] > APART]
    return [k for k in found if _energy(twinned(bodies, k, beams), k, rest) < _energy(bodies, k, rest) + STRAINED]


def twinned(bodies: MovingSurfaces, number: int, beams: np.ndarray) -> MovingSurfaces:
    """`bodies` with the body `number` in the place of its twin at all times, by linear maps about its middle.

    A body that turns has another map at each time: the one nearest to that of the time in the middle.
    """
    basis, (own, _) = bodies.basis, bodies.body(number)
    middle = twin_map(second_moments(_middle_mesh(bodies, number)), beams)
    places, times = [], np.linspace(basis.first, basis.last, SAMPLES * basis.count)
    for time in times:
        mesh = bodies.bodies(float(time))[number]
        centre = moments(mesh)[1]
        matrix = map_near(second_moments(mesh), beams, middle)
        places.append(((mesh.vertices - centre) @ matrix.T + centre) / bodies.unit_length)
    changed = bodies.coefficients.detach().clone()
    changed[:, own] = torch.from_numpy(basis.fitted(times, np.array(places)))
    return bodies.with_parameters({"coefficients": changed})


def without_details(bodies: MovingSurfaces, rest: Rest) -> MovingSurfaces:
    """Each of `bodies` as the nearest linear map of the shape at `rest`, of its own volume in mid-time."""
    shape, changed = torch.from_numpy(rest.elastic.membrane.mesh.vertices), bodies.coefficients.detach().clone()
    for number in range(bodies.count):
        own, middles, arms = _arms(bodies, number)
        changed[:, own] = middles + torch.stack([shape @ torch.linalg.lstsq(shape, one).solution for one in arms])
    plain = bodies.with_parameters({"coefficients": changed})
    for number in range(bodies.count):
        own, middles, arms = _arms(plain, number)
        share = _middle_mesh(bodies, number).volume / _middle_mesh(plain, number).volume
        changed[:, own] = middles + share ** (1 / 3) * arms
    return bodies.with_parameters({"coefficients": changed})


def _arms(bodies: MovingSurfaces, number: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Which vertices a body has, the coefficients [K, 1, 3] of its middle, and those [K, Q, 3] about it."""
    own, _ = bodies.body(number)
    paths = bodies.coefficients.detach()[:, own]
    middles = paths.mean(1, keepdim=True)
    return own, middles, paths - middles


def _middle_mesh(bodies: MovingSurfaces, number: int) -> TriangleMesh:
    return bodies.bodies(0.5 * (bodies.basis.first + bodies.basis.last))[number]


def _energy(bodies: MovingSurfaces, number: int, rest: Rest) -> float:
    own, _ = bodies.body(number)
    weights = bodies.basis.weights(np.array([0.5 * (bodies.basis.first + bodies.basis.last)]))[0]
    nodes = torch.einsum("k,kpx->px", torch.from_numpy(weights), bodies.coefficients.detach()[:, own])
    return float(rest.elastic(nodes))
