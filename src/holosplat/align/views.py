"""`align_still`: exposures of a scan estimated from its frames, with errors and undetermined directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..baselines.primal_dual import PrimalDual
from ..checks import require
from ..geometry import Grid
from ..inference import Decision, Score, select
from ..matter import DeltaBeta, Known, MaterialPrior
from ..methods.cross_validation import assumed_material
from ..methods.surface_fit import oversampling
from ..optics.background import Light, LightOptions
from ..optics.retrieval import paganin
from ..optics.sampling import fringe_sampling
from ..progress import Progress
from ..projectors.voxels import LatticeProjector
from ..representations import SurfaceMesh
from ..scan import Exposures, Scan
from .derivatives import (
    changes,
    hardly_told,
    header,
    in_pixels,
    in_words,
    line,
    moved_onto,
    numbers_of,
    predicted,
    rms_of,
    unexplained,
)
from .fixed_matter import EDGES, SURFACES, VOXELS, Beside, sharpened, surfaces_of
from .initial_geometry import mirrored
from .marginal_likelihood import KINDS, beside_unknown
from .poses import DISTANCE, FLUX, SHIFT, PoseOptions, PoseSearch

DARKEST = 1e-3
"""Intensity [relative] below which a logarithm is that of noise; it is taken for this much."""
EVEN_OR_NOT = LightOptions()
"""Even, unless the air of the frames shows otherwise."""
TRIAL_DELTA = 1e-6
"""Any δ will do: shadows are counted in units of their own."""


def shadows(scan: Scan, ratio: float | None = None, light: LightOptions = EVEN_OR_NOT) -> torch.Tensor:
    """Images [V, H, W], float64, of what each frame has lost: `-ln I` in even light, or Paganin's thickness; NaN in
    missing pixels.

    ratio: δ/β, if it is known; then fringes become thickness (in units of their own). Without it fringes stay: where
    they are weak, `-ln I` is a round filter of the projected matter (Teague 1983), and as consistent as projections.
    """
    evened = torch.from_numpy(in_even_light(scan, light).frames)
    if ratio is None or not bool(scan.exposures.distance.all()):
        return -scan.known(evened).double().clamp_min(DARKEST).log()
    lost = paganin(evened, scan.exposures, TRIAL_DELTA, TRIAL_DELTA / ratio, missing=scan.gaps)
    return scan.known(lost).double() / scan.views.pixel_size


def in_even_light(scan: Scan, light: LightOptions = EVEN_OR_NOT) -> Scan:
    """The scan as it would be in even light."""
    frames = Light.of(scan.measured, light).evened(torch.from_numpy(scan.frames))
    return replace(scan, frames=frames.numpy())


SEED = 0
"""Of the noise of the frames: the same frames always give the same errors."""


@dataclass(frozen=True)
class Searched:
    """A search that is done.

    pixels: edge of the last images [detector pixels]; surfaces: what explains frames better than voxels, or None;
    decisions: on these
    """

    search: PoseSearch
    pixels: int
    surfaces: SurfaceMesh | None
    decisions: tuple[Decision, ...] = ()


ScanSearch = Callable[[Scan, PoseOptions], Searched]
"""The whole search of a scan, from its planned exposures on."""


def rehearsed(done: Searched, again: ScanSearch) -> np.ndarray:
    """[V, 7] errors of numbers [pixels, rad, logarithms] of another search, from the same plan on, of frames whose
    matter and poses are those that were found.

    The frames have noise with the spectrum of what was left unexplained of the measured ones, and random phases
    (Theiler et al. 1992, Physica D 58, 77): so light that is not even, grain, and what the matter of the search cannot
    be, count as they are. Poses in which the search gets stuck beside matter that has followed them count, too: it
    starts as far from what is to be found as it did (parametric bootstrap; Efron & Tibshirani 1993, chapter 6).
    """
    scan, search = done.search.scan.binned(done.pixels), done.search
    images = _frames(done, scan)
    left = scan.left(images)
    frames = images + with_random_phases(left, SEED)
    options = replace(
        search.options, uncertain=replace(search.options.uncertain, shift=search.options.uncertain.shift / done.pixels)
    )
    found = again(replace(scan, frames=frames.numpy()), options).search
    true = search.exposures(scan.exposures)
    there = found.exposures(scan.exposures)
    away = numbers_of(replace(there, views=moved_onto(there.views, true.views)), true).numpy()
    away[:, SHIFT] *= done.pixels
    return away


def _frames(done: Searched, scan: Scan) -> Tensor:
    """Frames [V, H, W] of what was found, on the pixels of `scan`."""
    if done.surfaces is None:
        return done.search.frames(scan)
    scales = torch.ones(done.search.numbers.shape[1], dtype=torch.float64)
    scales[SHIFT] = done.pixels
    return Beside(done.surfaces, scan.exposures, oversampling(scan)).frames(done.search.numbers / scales)


def with_random_phases(images: Tensor, seed: int) -> Tensor:
    """Images [V, H, W] of the same power at all frequencies, and random otherwise."""
    white = torch.randn(images.shape, generator=torch.Generator().manual_seed(seed))
    phases = torch.fft.rfft2(white)
    size = torch.fft.rfft2(images).abs()
    return torch.fft.irfft2(size * phases / phases.abs().clamp_min(1e-12), s=images.shape[-2:])


DEFAULT = PoseOptions()
SHARP = "alignment, sharp edges"
REHEARSAL = ", rehearsed"
FEWEST = 2
"""Training views below which there is nothing to agree on."""
STRAY = 1.35
"""A view that leaves so many times as much unexplained as the middle one does not fit with the others."""
FEW = 4
"""Training views below which turns across the beam pass for the depth of matter, and stay as planned."""
POSES, PLANNED, ESTIMATED = "poses", "as planned", "estimated"
UNTOLD = (
    "distances are as planned: the matter shows no sharp edges of a known density, and a longer distance sharpens "
    "fringes as such edges would"
)


@dataclass(frozen=True)
class AlignedViews:
    """The estimated poses of V views.

    exposures: those of the scan, corrected
    changes: [V, 7] of the plan, all views moved together as near to it as can be: shifts x, y [pixels], turns about x,
        y, z of the lab [degrees], shares of the distance and of the magnification
    errors: [V, 7] their standard errors
    flux: [V] of each frame, beside one
    before, after: [V] rms of what a volume leaves unexplained of each frame, as a share of its contrast, with the
        planned and with the found exposures
    words: what was kept as planned, and why; decisions: between hypotheses
    """

    exposures: Exposures
    changes: np.ndarray
    errors: np.ndarray
    flux: np.ndarray
    before: np.ndarray
    after: np.ndarray
    words: tuple[str, ...]
    decisions: tuple[Decision, ...] = ()

    def lines(self) -> list[str]:
        """The result in words, and a table of the views."""
        larger = _rms(self.changes[:, 6])
        return [
            in_words(self.changes)
            + (f", magnification {larger:.2%}, each ± {_rms(self.errors[:, 6]):.2%}" if larger > 0 else ""),
            f"unexplained share of the contrast: {_rms(self.before):.3f} as planned, {_rms(self.after):.3f} now",
            *self.words,
            *(each.line for each in self.decisions),
            header("view", 2, "unexplained"),
            *(
                line(v, change, error, 2, f"{self.before[v]:.3f} → {self.after[v]:.3f}")
                for v, (change, error) in enumerate(zip(self.changes, self.errors))
            ),
        ]


def align_still(
    scan: Scan,
    prior: MaterialPrior,
    options: PoseOptions = DEFAULT,
    *,
    light: LightOptions = EVEN_OR_NOT,
    on_progress: Progress = lambda stage, fraction: None,
) -> AlignedViews:
    """Estimate the poses of the views of `scan`, frames of one time.

    The volume is that of the training frames; held-out frames determine their own poses alone. A motion of
    the whole object, which no frame determines, is chosen so that the mean turn and the mean shift are those planned.
    The plan is kept unless the estimated poses explain frames better (`decided_poses`): held-out ones, if any are.

    prior: of the material; where its δ is unknown, the occupancy has no bound. Errors: `InputError` for fewer
    than two training frames.
    """
    count = int((~scan.is_test).sum())
    require(count >= FEWEST, f"align needs {FEWEST} training frames at least, but there are {count}.")
    scan = in_even_light(scan, light)
    material = assumed_material(scan.train(), prior, on_progress)
    upper = 1.0 if isinstance(prior, Known) else None
    words, held = list[str](), 0.0
    if count < FEW and options.uncertain.angle > 0:
        held = options.uncertain.angle
        options = replace(options, uncertain=replace(options.uncertain, angle=0.0))
        words.append(f"turns across the beam are as planned: {count} views cannot tell them from the matter's depth")
    done = searched(scan, material, options, upper, on_progress)
    search, pixels, surfaces = done.search, done.pixels, done.surfaces
    sharp = surfaces is not None
    if options.uncertain.distance > 0 and not sharp:
        words.append(UNTOLD)
    wrong = None
    posed = any(getattr(options.uncertain, kind) > 0 for kind in KINDS if kind != "distance")
    if posed and count < options.few_views:
        again = lambda frames, how: searched(frames, material, how, upper, on_progress, REHEARSAL)  # noqa: E731
        wrong = beside_unknown(search, pixels, surfaces, rehearsed(done, again))
    errors = errors_of(search.covariances)
    errors[:, 2:4] = np.maximum(errors[:, 2:4], held)
    expected = options.uncertain.deviations(sharp=True)
    expected[DISTANCE] *= sharp
    words += hardly_told(search.covariances, expected)
    found = search.exposures(scan.exposures)
    found = replace(found, views=moved_onto(found.views, scan.views))
    of = max(pixels, 2 if min(scan.views.shape) >= 2 * options.least_side else 1)
    on_progress("alignment, before and after", 0.0)
    before, after = (Judged.of(scan, exposures, search, of) for exposures in (scan.exposures, found))
    on_progress("alignment, before and after", 1.0)
    judges = scan.is_test if scan.is_test.any() else ~scan.is_test
    decisions = [*done.decisions, *([] if wrong is None else [wrong])]
    if scan.is_test.any() or count >= options.few_views:  # few frames for training agree with any poses
        by = "held-out frames" if scan.is_test.any() else "training frames"
        decisions.append(decided_poses(before.score(judges), after.score(judges), by))
        if decisions[-1].choice == PLANNED:
            found, after = scan.exposures, before
    words += _doubts(after)
    return AlignedViews(
        found,
        changes(found, scan.exposures),
        errors,
        np.exp(search.numbers[:, FLUX].numpy()) - 1,
        before.left,
        after.left,
        tuple(words),
        tuple(decisions),
    )


def decided_poses(planned: Score, found: Score, by: str) -> Decision:
    """Whether poses are those planned, the null, or those that were found."""
    scores = {PLANNED: planned, ESTIMATED: found}
    return select(POSES, tuple(scores), lambda name, fold: scores[name], by=by)


def searched(
    scan: Scan, material: DeltaBeta, options: PoseOptions, upper: float | None, on_progress: Progress, what: str = ""
) -> Searched:
    """The search of poses: by voxels on ever smaller pixels, then by surfaces, where they explain the frames better."""
    search = PoseSearch(scan, material, options, upper)
    levels = search.levels()
    for level in levels:
        name = f"alignment{what}, pixels of {level.pixels}"
        search.run(level, lambda fraction, name=name: on_progress(name, fraction))
    forget_distance(search)
    surfaces, decisions = by_edges(search, levels[-1].pixels, lambda stage, part: on_progress(stage + what, part))
    return Searched(search, levels[-1].pixels, surfaces, decisions)


def errors_of(covariances: Tensor) -> np.ndarray:
    """[V, 7] standard errors [pixels, degrees, shares] by covariances [V, 8, 8] of `NUMBERS`."""
    roots = covariances.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt().numpy()[:, :FLUX]
    return roots * np.array([1, 1, *[np.rad2deg(1)] * 3, 1, 1])


def forget_distance(search: PoseSearch) -> None:
    """Distances as planned: what voxels find of them is what their edges are too soft for."""
    search.numbers[:, DISTANCE] = 0
    search.covariances[:, DISTANCE] = search.covariances[:, :, DISTANCE] = 0


def by_edges(search: PoseSearch, pixels: int, on_progress: Progress) -> tuple[SurfaceMesh | None, tuple[Decision, ...]]:
    """Surfaces that explain the frames better than voxels of `pixels`, whose numbers those of the search become; or
    None. And the decision, if surfaces were tried."""
    scan = search.scan.binned(pixels)
    options = search.options
    wanted = search.edges_follow and any(getattr(options.uncertain, kind) > 0 for kind in KINDS)
    start = surfaces_of(search.volume, scan, search.material) if wanted else None
    if start is None:
        return None, ()
    scales = torch.ones(search.numbers.shape[1], dtype=torch.float64)
    scales[SHIFT] = pixels
    here = replace(options, uncertain=replace(options.uncertain, shift=options.uncertain.shift / pixels))
    found = sharpened(scan, search.numbers / scales, start, here, lambda part: on_progress(SHARP, part))
    train = torch.from_numpy(~scan.is_test)
    scores = {VOXELS: Score.of(search.residuals(scan)[train]), SURFACES: Score.of(found.left[train])}
    decision = select(EDGES, tuple(scores), lambda name, fold: scores[name], by="training frames")
    if decision.choice == VOXELS:
        return None, (decision,)
    search.numbers, search.covariances = found.step.numbers * scales, found.step.covariances * scales[:, None] * scales
    return found.surfaces, (decision,)


@dataclass(frozen=True)
class Judged:
    """The residual of a new volume in some exposures.

    left: [V] rms, as a share of each frame's contrast
    mirrors: [V] which mirror image of a frame fits better than itself, or ""
    images: [V, H, W] the residual over each frame's contrast
    """

    left: np.ndarray
    mirrors: list[str]
    images: Tensor

    def score(self, which: np.ndarray) -> Score:
        """Score the residual of the frames that `which` [V] marks."""
        return Score.of(self.images[torch.from_numpy(which)])

    @classmethod
    def of(cls, scan: Scan, exposures: Exposures, search: PoseSearch, pixels: int) -> Judged:
        """On pixels `pixels` times larger; the same for all exposures that are compared."""
        scan = scan.taken(exposures).binned(pixels)
        frames, train, options = scan.measured, np.flatnonzero(~scan.is_test), search.options
        lines = search.thickness(scan) / scan.views.pitch
        views = in_pixels(scan.views)
        grid = Grid.of_views(views)
        solver = PrimalDual(LatticeProjector(grid, views[train]), torch.zeros(grid.shape), options.weight, search.upper)
        solver.run(lines, 2 * options.first, scan[train].gaps)
        images = predicted(solver.volume, grid, scan.exposures, search.material, fringe_sampling(scan.exposures)).frames
        left = unexplained(frames, images)
        return cls(rms_of(left), mirrored(frames, images), left)


def _doubts(judged: Judged) -> list[str]:
    """Views that do not fit with the others, in words."""
    words = [
        f"view {v} looks mirrored: reverse its {'columns' if side == 'x' else 'rows' if side == 'y' else 'both axes'}"
        for v, side in enumerate(judged.mirrors)
        if side
    ]
    limit = STRAY * float(np.median(judged.left))
    lost = [str(v) for v in np.flatnonzero(judged.left > limit) if not judged.mirrors[v]]
    if lost:
        words.append(f"explained much worse than the others, do not trust them: views {', '.join(lost)}")
    return words


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
