"""A network's guess beside phase retrieval: both are fitted for a while, and what explains the frames better is begun
with.

The network knows the bodies that it was trained on. Of others its guess is wrong in a way that it does not see itself,
and what the fit makes of it may be worse than what it makes of the ordinary start. So the guess has to leave clearly
less of the matter in the frames unexplained than that; where it does not, the run is the same as without a network.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from ..checks import InputError
from ..learning.start import GuessedMatter, LearnedStart, contradicted, guessed
from ..matter import DeltaBeta
from ..representations import GaussianCloud, SurfaceMesh
from .beginning import Beginning
from .cross_validation import MissingMatter
from .gaussian_options import GaussianOptions
from .method import Task, run_quietly
from .sharp_level import material_of_levels
from .start import cloud_of, starting_cloud
from .surface_fit import SurfaceFit, SurfaceOptions, extract_surfaces, oversampling, surface_fit

STAGE = "both starts"

Fitted = Callable[[Task, GaussianCloud, int], GaussianCloud]
"""A cloud after so many steps."""


def learned_cloud(task: Task, options: GaussianOptions, fitted: Fitted) -> GaussianCloud:
    """The cloud to start from: of the network's guess, or the ordinary one. `task.on_beginning` is told which, and why.

    fitted: the fit of Gaussians. Errors: those of `guessed`, of the weights' file and of both starts.
    """
    how, ordinary = options.learned, replace(options, start="phase")
    if len(task.prior.materials) == 2:
        why = "The network guesses one material, and two are known: the run began with phase retrieval."
        return _begun(task, Beginning("phase", why), starting_cloud(task, ordinary))
    material = material_of_levels(task, options.volume.backend, options.estimate)
    trained = how.network
    found = guessed(task.scan, material, trained.network, task.on_progress)
    guess = GuessedMatter.of(found, material, trained.network)
    refused = contradicted(found, how, trained.card)
    if refused:
        why = f"The frames contradict the network's guess ({refused}): the run began with phase retrieval."
        return _begun(task, Beginning("phase", why, guess), starting_cloud(task, ordinary))
    clouds = starting_cloud(task, ordinary), cloud_of(found.values, found.grid, material, task, options)
    plain, learned = (_Trial.of(task, cloud, material, how, fitted) for cloud in clouds)
    told = f"leaves {100 * learned.left:.2g} % of the frames unexplained, and phase retrieval {100 * plain.left:.2g} %"
    if learned.clearly_better(plain, how):
        why = f"The run began with the network's guess: fitted for a while, it {told}."
        return _begun(task, Beginning("learned", why, guess), clouds[1])
    why = f"The run began with phase retrieval: fitted for a while, the network's guess {told}."
    return _begun(task, Beginning("phase", why, guess), clouds[0])


def _begun(task: Task, beginning: Beginning, cloud: GaussianCloud) -> GaussianCloud:
    task.on_beginning(beginning)
    return cloud


@dataclass(frozen=True)
class _Trial:
    """share: of all matter that a start leaves unexplained in the frames after a short fit; contrast: the same of their
    contrast; closed: whether that was a fit of surfaces."""

    share: float
    contrast: float
    closed: bool

    @property
    def left(self) -> float:
        """Their geometric mean: the one does not see fringes that are out of place, the other hardly sees how much
        matter there is."""
        return math.sqrt(self.share * self.contrast)

    @classmethod
    def of(cls, task: Task, cloud: GaussianCloud, material: DeltaBeta, how: LearnedStart, fitted: Fitted) -> _Trial:
        """That of `cloud`, as Gaussians, and then as surfaces where it has some: they hold edges, and cannot explain by
        half a density what is in the wrong place."""
        judge = MissingMatter(task.scan, material)
        quiet = replace(task, on_progress=lambda stage, fraction: task.on_progress(STAGE, fraction))
        found = fitted(quiet, cloud, how.trial_steps)
        surfaces = _surfaces(quiet, found, how.trial_surfaces) if task.bounded else None
        if surfaces is None:
            return cls(*judge.shares(found), closed=False)
        return cls(*judge.shares(surfaces, oversampling(task.scan)), closed=True)

    def clearly_better(self, other: _Trial, how: LearnedStart) -> bool:
        """Whether it explains the frames clearly better than another one, of the same kind."""
        return self.closed == other.closed and self.left < how.clearly * other.left


def _surfaces(task: Task, cloud: GaussianCloud, steps: int) -> SurfaceMesh | None:
    """The surfaces of a cloud after so many steps; None where there are none."""
    options = SurfaceOptions()
    try:
        start = extract_surfaces(cloud, task.scan, options.extraction)
    except InputError:  # no surface anywhere
        return None
    fit: SurfaceFit = replace(options.fit, schedule=replace(options.fit.schedule, steps=steps))
    found = run_quietly(surface_fit(task.scan, start, fit, task.seed, task.uneven), task.report(STAGE))
    assert isinstance(found, SurfaceMesh)
    return found
