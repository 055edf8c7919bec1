"""The two-view ambiguity: a body or its twin (`bodies.poses`), compared by fits to the frames of two beams."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch

from ..bodies.poses import distance, map_near, twin_map, two_beams
from ..bodies.rest_shape import moments, second_moments
from ..fit.run import Run
from ..inference import Compared, Decision, Score
from ..mesh import TriangleMesh
from ..optics.background import Light
from ..representations import MovingSurfaces
from ..scan import Scan
from .detections import beside, only, predicted
from .elastic import Rest
from .fit import MotionFit, motion_fit

APART = 0.05
"""Least distance of a body and its twin, over its extent, at which they can be distinguished."""
STRAINED = 10.0
"""Elastic energy by which a twin may exceed its body, in units of its area times the shear modulus: in trials cells in
flow had up to four, their twins in beams across each other half a unit more, in beams at 24° 28 and more."""
STIFF_STEPS, SOFT_STEPS, TRIAL_VIEWS = 40, 40, 4
"""Steps of the two fits of a trial, and frames of a step of Adam's: with a third of these steps a body is not yet at
home where its twin is."""
FIRST_LOOK = 0.7
"""About the share of the work before the closer ones are looked at again."""
TRIAL_WORTH = 1.0
"""What a step of L-BFGS must gain there [nats]: bodies and their twins differ by ten at times."""
SAMPLES = 4
"""Times at which a body that turns is put in its twin's place, for each coefficient of its path."""
NAME, NONE = "twins in two beams", "none"
Heard = Callable[[float], None]
"""Takes the share that is done."""


def trial_of(how: MotionFit, steps: int) -> MotionFit:
    """`how` in so many steps at most, of few frames, for one body: what it has with others is left out."""
    views = how.schedule.views_per_step if how.pairs else TRIAL_VIEWS
    schedule = replace(how.schedule, steps=min(steps, how.schedule.steps), views_per_step=views)
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
            fit.run(lambda record: None)
            found = fit.result().object
            assert isinstance(found, MovingSurfaces)
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

    Frames are divided by those that all others predict, and the body, the null, and its twin are fitted to them, from
    shapes without details: those that were fitted before would speak for the body that was there. A twin that is surely
    worse after a stiff fit has no soft one. Where neither is surely better after that, both fits go on when all others
    have been looked at.
    """
    beams = two_beams(trials.train.views)
    if beams is None:
        return bodies, None
    plain, now = without_details(bodies, trials.rest), bodies
    asked, rivals = in_question(plain, beams, trials.rest), dict[int, tuple[Tried, Tried]]()
    compared = dict[int, Compared]()
    for turn, number in enumerate(asked):
        on_progress(FIRST_LOOK * turn / len(asked))
        frames, own = trials.beside(now, number), only(plain, [number])
        first, other = (trials.begun(frames, start) for start in (own, twinned(own, 0, beams)))
        compared[number] = other.beside(first, number)
        if compared[number].loses:
            continue
        first, other = rivals[number] = trials.gone_on(frames, first), trials.gone_on(frames, other)
        compared[number] = other.beside(first, number)
        now = _placed(now, number, other.bodies) if compared[number].wins else now
    close = [k for k in rivals if not (compared[k].wins or compared[k].loses)]
    for turn, number in enumerate(close):
        on_progress(FIRST_LOOK + (1 - FIRST_LOOK) * turn / len(close))
        frames = trials.beside(now, number)
        first, other = (trials.gone_on(frames, tried) for tried in rivals[number])
        compared[number] = other.beside(first, number)
        now = _placed(now, number, other.bodies) if compared[number].wins else now
    taken = ", ".join(str(number) for number, each in compared.items() if each.wins)
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
        mesh = _mesh(bodies, number, float(time))
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


def _mesh(bodies: MovingSurfaces, number: int, time: float) -> TriangleMesh:
    return bodies.bodies(time)[number]


def _middle_mesh(bodies: MovingSurfaces, number: int) -> TriangleMesh:
    return _mesh(bodies, number, 0.5 * (bodies.basis.first + bodies.basis.last))


def _energy(bodies: MovingSurfaces, number: int, rest: Rest) -> float:
    own, _ = bodies.body(number)
    weights = bodies.basis.weights(np.array([0.5 * (bodies.basis.first + bodies.basis.last)]))[0]
    nodes = torch.einsum("k,kpx->px", torch.from_numpy(weights), bodies.coefficients.detach()[:, own])
    return float(rest.elastic(nodes))
