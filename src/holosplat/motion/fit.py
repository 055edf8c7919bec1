"""The fit of moving surfaces to the frames of all times, and the pieces of their paths: as many as
predict frames that a short fit has not seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.sparse import csc_array, diags_array, eye_array
from scipy.sparse.linalg import splu
from torch import Tensor

from ..fit.loop import Fit, Plan
from ..fit.problem import Problem, Schedule, Term
from ..fit.projected_gradient import QuasiNewton
from ..fit.run import Run
from ..fit.terms import Objective
from ..fit.terms.frames import ProfileLikelihood
from ..inference import Compared, Decision, Score
from ..methods.ground import ground
from ..methods.surface_fit import MEMORY, oversampling
from ..optics.background import Light
from ..ranges import Degree, Natural, Positive, Several, Weight, ranged
from ..representations import MovingSurfaces
from ..representations.isosurface import adjacency
from ..scan import Scan
from .detections import predicted
from .elastic import COEFFICIENTS, Acceleration, Apart, MovingCurvature, Rest, RestShapeKept, area_kept, volume_kept
from .expected import Expected, NearExpected

OPEN = 1e-3
"""Share of the times' mean square below which a coefficient is taken to be seen so well: what frames hardly see of a
path takes no steps that are longer than by its inverse."""


@dataclass(frozen=True)
@ranged
class MotionFit:
    """Options of a fit of moving surfaces."""

    rate: Positive = 0.2
    """Length of the first step [pixels], of the coefficient that moves most; others are ten times as long at most."""
    worth: Weight = 5.0
    """Least log-likelihood gain of a step [nats], averaged over ten, for the fit to continue."""
    stiffness: Weight = 10.0
    """How far a vertex draws its neighbours along, λ of Nicolet et al. (2021)."""
    acceleration: Weight = 0.4
    """Standard deviation of a body's acceleration, rms over its vertices [pixels per piece²] (0: paths are free)."""
    volume_kept: Weight = 0.006
    """Standard deviation of a body's volume over time, as a share (0: volumes are free). Of red cells it is that."""
    area_kept: Weight = 0.03
    """The same of its area: red cells in flow change theirs by 1 to 5 % (0: areas are free)."""
    apart: Weight = 0.2
    """How deep bodies may lie in each other, a standard deviation [pixels] (0: unconstrained)."""
    curvature: Weight = 3.0
    """Prior of smooth shapes: κ of ½ κ R² ∫ |∇H|² dA of each body, the mean over time [nats], as of `SurfaceFit`."""
    objective: Objective = field(default_factory=lambda: Objective(l1=0.0, rounded=1.0, rounding=3.0))
    """How frames are compared; their noise is what the surfaces leave of each view."""
    schedule: Schedule = field(default_factory=lambda: Schedule(steps=120, views_per_step=16))
    """The loop; `views_per_step` are in memory at a time, for steps look at all."""


SHORT = MotionFit(rate=0.1, schedule=Schedule(steps=10, views_per_step=16))
"""A fit that hardly leaves its start."""


def motion_fit(
    scan: Scan,
    start: MovingSurfaces,
    options: MotionFit = MotionFit(),
    seed: int = 0,
    light: Light | None = None,
    rest: Rest | None = None,
    *,
    expected: Expected | None = None,
) -> Fit:
    """Prepare the fit of the paths of `start` to the training frames of `scan`, of any number of times.

    rest: the known shape of bodies at rest; expected: where a forecast has the first of the bodies.

    Steps are those of L-BFGS, in coordinates in which neighbours move together (Nicolet et al. 2021) and in which times
    count alike: the paths' Gram matrix over the times is one.
    """
    train, at_once = scan.train(), options.schedule.views_per_step
    schedule = replace(options.schedule, views_per_step=0, views_at_once=at_once)
    finer = oversampling(train) if not schedule.oversample else 0
    base = ground(scan, start, start.matter, options.objective, schedule, "cpu", finer=finer, light=light)
    frames = ProfileLikelihood(base.frames, int(base.train.measured.isfinite().sum()))
    smooth = _smooth_directions(start, options.stiffness, base.train.exposures.time)
    plan = Plan(
        problem=Problem(base.model, (frames, *_prior(base.train, start, options, rest, expected, frames.nat))),
        schedule=schedule,
        optimiser=lambda leaves: QuasiNewton(leaves, smooth, MEMORY, options.worth * frames.nat),
        rates=lambda factor, step: {COEFFICIENTS: options.rate},
        judge=base.judge,
    )
    return Fit(plan, seed)


def fitted_bodies(fit: Fit) -> MovingSurfaces:
    """The bodies of a `motion_fit` that goes on to its end."""
    fit.run(lambda record: None)
    found = fit.result().object
    assert isinstance(found, MovingSurfaces)
    return found


def _prior(
    train: Scan, start: MovingSurfaces, options: MotionFit, rest: Rest | None, expected: Expected | None, nat: float
) -> list[Term]:
    """Minus the logarithms of the prior's parts: a shape counts once, what changes of it in time as one draw of each
    coefficient. nat: a unit of them, in units of the loss."""
    one, found, moves = nat * start.basis.count, list[Term](), start.basis.count > 1
    if options.curvature > 0:
        found.append(MovingCurvature(nat * options.curvature, start))
    if options.acceleration > 0 and len(start.basis.curvature()):
        found.append(Acceleration(nat / 2 / options.acceleration**2, start))
    for kept, deviation in ((volume_kept, options.volume_kept), (area_kept, options.area_kept)):
        if deviation > 0 and moves:
            found.append(kept(one / 2 / deviation**2, start, train.instants))
    if options.apart > 0 and start.count > 1:
        found.append(Apart(one / 2 / options.apart**2, start, train.exposures.time))
    if rest is not None and rest.stiffness > 0:  # of the bodies of a forecast alone, where that tells it
        found.append(RestShapeKept(one * rest.stiffness, rest.elastic, start, expected and expected.count))
    if expected is not None:  # its errors count as one number a body and coefficient of time
        found.append(NearExpected(one / 2, expected, start.basis))
    return found


def _smooth_directions(start: MovingSurfaces, stiffness: float, times: np.ndarray) -> Callable[[Tensor], Tensor]:
    """The inverse of Gram matrix × (1 + λΔ): gradients [K, P, 3] in, smooth directions out."""
    faces, count = start.faces.numpy(), start.coefficients.shape[1]
    edges = adjacency(faces, count)
    solve = splu(csc_array(eye_array(count) + stiffness * (diags_array(edges.sum(1)) - edges))).solve
    gram = start.basis.gram(times)
    inverse = np.linalg.inv(gram + OPEN * np.trace(gram) / len(gram) * np.eye(len(gram)))

    def directions(gradient: Tensor) -> Tensor:
        even = np.einsum("kl,lpx->pkx", inverse, gradient.numpy())
        found = solve(np.ascontiguousarray(even.reshape(count, -1))).reshape(even.shape)
        return torch.from_numpy(np.ascontiguousarray(found.transpose(1, 0, 2)))

    return directions


NAME, BY = "pieces of paths", "frames set aside"


@dataclass(frozen=True)
@ranged
class PathOptions:
    """How vertices move."""

    degree: Degree = 2
    """Of the polynomials of time: 2 leaves 0.002 µm of the paths of flowing cells over 16 times."""
    pieces: int = 0
    """Pieces of their splines (0: chosen from the data)."""
    most_pieces: Natural = 8
    """At most, where frames are asked."""
    held_out: Several = 5
    """One frame in so many is held out to ask them."""


def chosen_paths(
    train: Scan,
    start: MovingSurfaces,
    options: PathOptions,
    how: MotionFit,
    seed: int = 0,
    light: Light | None = None,
    rest: Rest | None = None,
    *,
    expected: Expected | None = None,
    run: Run | None = None,
) -> tuple[MovingSurfaces, Decision | None]:
    """`start` on paths of the asked number of pieces, or of the number that predicts held-out frames best; and the
    decision, None where there was none.

    The number is doubled as long as a fit predicts the held-out frames better with it than with the number before
    (`inference.Compared`). A fit has half the steps of `how`. There are never more coefficients than times. run: whose
    step each fit is.
    """
    if options.pieces > 0:
        return refined(start, options.pieces), None
    most = min(options.most_pieces, len(train.instants) - options.degree)
    candidates = [n for n in (2**k for k in range(8)) if n <= most]
    if len(candidates) < 2 or len(train) < 2 * options.held_out:
        return start, None
    aside = np.zeros(len(train), dtype=bool)
    aside[np.random.default_rng(seed).permutation(len(train))[: len(train) // options.held_out]] = True
    short = replace(how, schedule=replace(how.schedule, steps=max(1, how.schedule.steps // 2)))
    kept, left = train.with_split(aside), train[np.flatnonzero(aside)]

    run = run or Run()

    def tried(bodies: MovingSurfaces) -> tuple[torch.Tensor, torch.Tensor]:
        part = light and light.part(torch.from_numpy(np.flatnonzero(~aside)))
        fit = motion_fit(kept, bodies, short, seed, part, rest, expected=expected)
        found = fitted_bodies(fit)
        missed = Score.of(torch.from_numpy(predicted(left, found, fit.oversample) - left.frames)).powers
        # one block a frame: frames differ by more than their parts do
        return found.coefficients.detach(), torch.from_numpy(missed).unflatten(0, (len(left), -1)).mean(dim=1)

    def fitted(bodies: MovingSurfaces) -> tuple[MovingSurfaces, Score]:
        coefficients, left = run.step("paths", lambda: tried(bodies))
        return bodies.with_parameters({"coefficients": coefficients}), Score(left.numpy(), len(left))

    best, begun, compared = start.basis.pieces, fitted(start)[0], list[Compared]()
    for pieces in candidates[1:]:
        same, finer = fitted(begun), fitted(refined(begun, pieces))
        compared.append(Compared(str(pieces), *finer[1].gain_over(same[1])))
        if not compared[-1].wins:
            break
        best, begun = pieces, finer[0]
    return refined(start, best), Decision(NAME, str(best), BY, tuple(compared))


def refined(start: MovingSurfaces, pieces: int) -> MovingSurfaces:
    """`start` on splines of so many pieces, which hold its paths exactly where they are multiples of its own."""
    basis = replace(start.basis, pieces=pieces)
    if basis == start.basis:
        return start
    times = np.linspace(basis.first, basis.last, 4 * (basis.count + start.basis.count))
    weights = start.basis.weights(times)
    places = np.einsum("tk,kpx->tpx", weights, start.coefficients.detach().numpy())
    paths = torch.from_numpy(basis.fitted(times, places))
    return MovingSurfaces(paths, start.faces, start.of_body, basis, start.unit_length, start.matter, start.lines)
