"""`align_views`: where the views of any scan really are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ..checks import require
from ..frames import evenly
from ..inference import Decision, Score
from ..matter import DeltaBeta, Known, MaterialPrior
from ..methods.cross_validation import assumed_material
from ..model import Alignment
from ..optics.background import LightOptions
from ..progress import Advance, Progress
from ..scan import Exposures, Scan
from .consistency import Estimate
from .derivatives import NUMBERS, changes, header, in_words, line, moved_onto
from .initial_geometry import SIDES, Images, RowGeometry, geometry_from_rows
from .poses import DISTANCE, FLUX, SHIFT, TURN, Drift, Level, PoseOptions, PoseSearch
from .row_sums import plane_angles
from .series_search import Beams, Moment, SeriesSearch, chosen_moments, whens
from .views import (
    DEFAULT,
    EVEN_OR_NOT,
    FEW,
    FEWEST,
    PLANNED,
    AlignedViews,
    Judged,
    align_still,
    decided_poses,
    in_even_light,
)

DRIFT, STAY, LINEAR = "drift of the beams", "none", "linear in time"
JUDGED = 3
"""Times whose volumes judge what volumes found."""
ACROSS = "shifts across two beams are as planned: they are a motion of the whole object, which loses nothing"
DISTANCES = "distances and magnifications are as planned: rows and voxels cannot tell them; align a single time"
SHIFTS = "alignment, shifts by volumes"
DEGREES = np.array([1, 1, *[np.pi / 180] * 3, 1, 1])
"""Units of `changes` in those of `NUMBERS`."""


@dataclass(frozen=True)
class Found:
    """The estimated geometry of B beams.

    numbers, rates: [B, 8] of `NUMBERS` at the middle of the series, and how much more at its end
    errors, rate_errors: [B, 5] of those of the pose
    before, after: [B] of what `measure` says
    pixels: of the images they were found on; words: about it; left: of the rows or frames, before and after; decisions:
    that led to it
    """

    numbers: np.ndarray
    rates: np.ndarray
    errors: np.ndarray
    rate_errors: np.ndarray
    before: np.ndarray
    after: np.ndarray
    measure: str
    pixels: int
    words: list[str]
    left: tuple[Score, Score] | None = None
    decisions: tuple[Decision, ...] = ()


@dataclass(frozen=True, kw_only=True)
class AlignedBeams(AlignedViews):
    """Poses of the frames of a series: arrays as in `AlignedViews`, of all N frames; before and after are those of the
    frame's beam.

    sides: [N] which mirror image each frame is, and was turned back from, or ""
    of_frame: [N] which of the B beams each frame is of; beams: [B, 7] their changes at the middle of the series
    drift: [B, 5] shifts [pixels] and turns [degrees] from the first time to the last; drift_errors: [B, 5]
    times: [T] that were used [s]; measure: what before and after are
    """

    sides: tuple[str, ...]
    of_frame: np.ndarray
    beams: np.ndarray
    drift: np.ndarray
    drift_errors: np.ndarray
    times: np.ndarray
    measure: str

    def upright(self, frames: np.ndarray) -> np.ndarray:
        """Frames [N, H, W], or their missing pixels, with those of reversed beams turned back, which is what the
        exposures are of."""
        return _flipped(frames, self.sides)

    def lasting(self) -> np.ndarray:
        """[B] the first frames of all beams, whose exposures are those of the others.

        Errors: `InputError` for a drift, for reversed beams, and for frames that are not in the beams' order.
        """
        require(not self.drift.any(), "--geometry-out is of beams that stay, but these drift; leave it, or the drift.")
        require(not any(self.sides), "--geometry-out is of frames as they are, but some are reversed; turn them first.")
        count = len(self.beams)
        in_order = np.array_equal(self.of_frame, np.arange(len(self.of_frame)) % count)
        require(in_order, "--geometry-out is of beams that come in one order at all times; leave it.")
        return np.arange(count)

    def lines(self) -> list[str]:
        """The result in words, and a table of the beams."""
        first = np.unique(self.of_frame, return_index=True)[1]
        before, after = (np.sqrt(np.mean(part[first] ** 2)) for part in (self.before, self.after))
        said = [
            f"{len(first)} beams, from frames of one time"
            if len(self.times) == 1
            else f"one geometry of {len(first)} beams, from {len(self.times)} times, {self.times[0]:g} to "
            f"{self.times[-1]:g} s",
            in_words(self.beams),
            f"{self.measure}: {before:.4f} as planned, {after:.4f} now",
            *self.words,
            *(each.line for each in self.decisions),
            header("beam", 2),
            *(line(b, self.beams[b], self.errors[frame], 2) for b, frame in enumerate(first)),
        ]
        for b in np.flatnonzero(self.drift.any(axis=1)):
            parts = [f"{self.drift[b, k]:+.3f} ± {self.drift_errors[b, k]:.3f}" for k in range(5)]
            said.append(
                f"beam {b} drifts, first time to last: shifts {', '.join(parts[:2])} pixels, "
                f"turns {', '.join(parts[2:])} degrees"
            )
        return said


def align_beams(
    scan: Scan,
    prior: MaterialPrior,
    options: PoseOptions = DEFAULT,
    *,
    light: LightOptions = EVEN_OR_NOT,
    on_progress: Progress = lambda stage, fraction: None,
) -> AlignedBeams:
    """One geometry of beams, for all times of a series, or of a few beams for one time.

    Frames of the same planned pose are of one beam. Some times are used (`PoseOptions.times`). Of beams in one plane
    the rows of retrieved thickness must agree (`row_sums`), which needs no volume; with two or three of them this is
    all they tell, and the result. More beams, or such as are not in one plane, or whose matter passes the edges of the
    field, go on with a volume of each time, whose frames all move the beams' numbers together. A drift is linear in
    time, and none unless it is beyond doubt. Errors: `InputError` for beams of a series that are never seen twice, and
    for fewer than two training frames of a time.
    """
    scan.views.parallel("finding poses")
    beams, held = Beams.of(scan), options.uncertain.distance > 0 or options.uncertain.magnification > 0
    options = replace(options, uncertain=replace(options.uncertain, distance=0.0, magnification=0.0))
    moments = [_divide_light(moment, light) for moment in chosen_moments(scan, beams, options.times, FEWEST)]
    times = np.array([moment.time for moment in moments])
    material = assumed_material(moments[len(moments) // 2].scan.train(), prior, on_progress)
    count = int((~moments[0].scan.is_test).sum())
    few = count < FEW
    pixels = PoseSearch(moments[0].scan, material, options, None, begin=False).levels()[-1].pixels
    on_progress("rows", 0.0)
    start = _rows(moments, len(beams), material, options, few, pixels)
    on_progress("rows", 1.0)
    if start is not None:
        moments = [_turned_back(moment, start.sides) for moment in moments]
    by_rows = start is not None and few and start.believed
    if start is not None and by_rows:
        found = _by_rows(start, pixels)
        if count == FEWEST:
            found.words.append(ACROSS)
        elif isinstance(prior, Known):
            search = SeriesSearch(moments, len(beams), material, replace(options, drift=Drift()), 1.0)
            found = _shifted_by_volumes(search, found, lambda fraction: on_progress(SHIFTS, fraction))
    else:
        search = SeriesSearch(moments, len(beams), material, options, 1.0 if isinstance(prior, Known) else None)
        found = _by_volumes(
            search, beams.planned, start if start and start.believed else None, few, pixels, on_progress
        )
    if start is not None:
        if not start.believed:
            found.words.append("matter passes the edges of the field: rows of different beams are not compared")
        reversed_ = [(b, side) for b, side in enumerate(start.sides) if side]
        found.words.extend(f"beam {b} is reversed along {side}: its frames were turned back" for b, side in reversed_)
    if held:
        found.words.append(DISTANCES)
    if start is not None:
        found = replace(found, decisions=(start.decision,))
    found = _without_doubtful_drift(found, options)
    if found.left is not None and (by_rows or count >= options.few_views):  # volumes of few frames agree with any poses
        decision = decided_poses(*found.left, "the same rows" if by_rows else "training frames")
        found = replace(found, decisions=(*found.decisions, decision))
        if decision.choice == PLANNED:
            found = replace(found, numbers=0 * found.numbers, rates=0 * found.rates, after=found.before)
    return _place_frames(scan, beams, found, times, start.sides if start else ("",) * len(beams))


def _divide_light(moment: Moment, light: LightOptions) -> Moment:
    """The same in even light."""
    return replace(moment, scan=in_even_light(moment.scan, light))


def _turned_back(moment: Moment, sides: tuple[str, ...]) -> Moment:
    """The same with the frames of reversed beams turned back."""
    scan, own = moment.scan, [sides[beam] for beam in moment.beams]
    missing = None if scan.missing is None else _flipped(scan.missing, own)
    return replace(moment, scan=replace(scan, frames=_flipped(scan.frames, own), missing=missing))


def _flipped(images: np.ndarray, sides: Sequence[str]) -> np.ndarray:
    """Images [N, H, W], each mirrored along its side, if it has one."""
    turned = images.copy()
    for n, side in enumerate(sides):
        if side:
            turned[n] = np.flip(images[n], SIDES[side])
    return turned


def _rows(
    moments: Sequence[Moment], count: int, material: DeltaBeta, options: PoseOptions, few: bool, pixels: int
) -> RowGeometry | None:
    """Estimate the beams from rows, at times that have all of them, on pixels so many times larger."""
    whole = [moment for moment in moments if len(moment.beams) == count]
    if not whole:
        return None
    scans = [moment.scan[np.argsort(moment.beams)].binned(pixels) for moment in whole]
    images = Images.of(scans, [moment.when for moment in whole], material, options.retrieval)
    return geometry_from_rows(images, options.uncertain.pose(pixels), options.drift.pose(pixels), few)


def _by_rows(start: RowGeometry, pixels: int) -> Found:
    """The numbers of rows, for detector pixels."""
    scales = np.array([pixels, pixels, 1, 1, 1])
    numbers, rates = (np.pad(scales * part, ((0, 0), (0, len(NUMBERS) - 5))) for part in (start.numbers, start.rates))
    errors, rate_errors = scales * start.errors, scales * start.rate_errors
    measure, words = "rows disagree by this share of their moments", list(start.words)
    both = start.before, start.after
    return Found(numbers, rates, errors, rate_errors, *both, measure, pixels, words, start.left)


def _shifted_by_volumes(search: SeriesSearch, found: Found, on_progress: Advance) -> Found:
    """The same with shifts by volumes of all times, which know that matter is not negative and has one density; turns,
    rolls and a drift stay, for such volumes follow them."""
    search.numbers, search.rates = torch.from_numpy(found.numbers.copy()), torch.from_numpy(found.rates.copy())
    search.hold(*range(TURN.start, TURN.stop))
    search.run(Level(found.pixels, search.options.rounds), on_progress)
    numbers = found.numbers.copy()
    numbers[:, SHIFT] = search.numbers[:, SHIFT].numpy()
    return replace(found, numbers=numbers)


def _by_volumes(
    search: SeriesSearch, planned: Exposures, start: RowGeometry | None, few: bool, pixels: int, on_progress: Progress
) -> Found:
    """The numbers of volumes of all times, which begin with those of rows where these agree; turns of `few` beams stay
    as they begin."""
    words = list[str]()
    if start is not None:
        begin = _by_rows(start, pixels)
        search.numbers, search.rates = torch.from_numpy(begin.numbers), torch.from_numpy(begin.rates)
    if few and search.options.uncertain.angle > 0:
        search.hold(2, 3)
        words.append(
            f"turns across the beam are as planned: {len(planned)} views cannot tell them from the matter's depth"
        )
    levels = search.levels()
    for level in levels:
        name = f"alignment, pixels of {level.pixels}"
        search.run(level, lambda fraction, name=name: on_progress(name, fraction))
    search.forget_distance()
    variances = search.covariances.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt().numpy().reshape(len(planned), 2, -1)
    numbers, rates = search.numbers.numpy(), search.rates.numpy()
    found = Found(
        numbers,
        rates,
        variances[:, 0, :5],
        variances[:, 1, :5],
        np.zeros(0),
        np.zeros(0),
        "unexplained share of the contrast",
        levels[-1].pixels,
        words,
    )
    on_progress("alignment, before and after", 0.0)
    still = replace(found, numbers=0 * numbers, rates=0 * rates)
    (before, first), (after, then) = (_residuals(search, planned, each) for each in (still, found))
    on_progress("alignment, before and after", 1.0)
    return replace(found, before=before, after=after, left=(first, then))


def _residuals(search: SeriesSearch, planned: Exposures, found: Found) -> tuple[np.ndarray, Score]:
    """[B] rms of what volumes of some times leave of the frames of each beam, as a share of their contrast; and what
    they leave of the training frames."""
    some = evenly(len(search.moments), JUDGED)
    sums, counts, scores = np.zeros(len(planned)), np.zeros(len(planned)), list[Score]()
    for k in some:
        moment = search.moments[k]
        exposures = _exposures(found.numbers + moment.when * found.rates, planned)[moment.beams]
        pixels = max(found.pixels, 2 if min(moment.scan.views.shape) >= 2 * search.options.least_side else 1)
        judged = Judged.of(moment.scan, exposures, search.searches[k], pixels)
        sums[moment.beams] += judged.left**2
        counts[moment.beams] += 1
        scores.append(judged.score(~moment.scan.is_test))
    return np.sqrt(sums / np.maximum(counts, 1)), Score.joined(scores)


def _exposures(numbers: np.ndarray, planned: Exposures) -> Exposures:
    """Planned exposures [N] with numbers [N, 8] of `NUMBERS`."""
    turns, shifts, distance = (torch.from_numpy(numbers[:, at].copy()) for at in (TURN, SHIFT, DISTANCE))
    return Alignment(turns, shifts, distance.exp() - 1).exposures(planned)


def _without_doubtful_drift(found: Found, options: PoseOptions) -> Found:
    """The same without a drift that may be none, and with a word about it."""
    if not options.drift.pose().any():
        return found
    told = found.rate_errors > 0
    sizes = (np.abs(found.rates[:, :5]) * told / np.where(told, found.rate_errors, 1.0)).max(initial=0.0)
    surest = Estimate(float(sizes), 1.0).compared(LINEAR)
    decision = Decision(DRIFT, LINEAR if surest.wins else STAY, "likelihood ratio of the surest number", (surest,))
    kept = found if surest.wins else replace(found, rates=0 * found.rates)
    return replace(kept, decisions=(*found.decisions, decision))


def _place_frames(scan: Scan, beams: Beams, found: Found, times: np.ndarray, sides: tuple[str, ...]) -> AlignedBeams:
    """All frames where their beams are at their times: mean turn and mean shift of the beams are those planned."""
    middle, start, end = (_changes(found.numbers + when * found.rates, beams.planned) for when in (0.0, -1.0, 1.0))
    drift, which = (end - start)[:, :5], beams.of_frame
    of_frames = middle[which]
    of_frames[:, :5] += 0.5 * whens(scan.exposures.time)[:, None] * drift[which]
    numbers = np.pad(of_frames * DEGREES, ((0, 0), (0, 1)))
    exposures = _exposures(numbers, scan.exposures)
    errors = np.pad(found.errors, ((0, 0), (0, 2))) / DEGREES
    return AlignedBeams(
        exposures,
        of_frames,
        errors[which],
        np.expm1(found.numbers[which, FLUX]),
        found.before[which],
        found.after[which],
        tuple(found.words),
        found.decisions,
        sides=tuple(sides[b] for b in which),
        of_frame=which,
        beams=middle,
        drift=drift,
        drift_errors=2 * found.rate_errors / DEGREES[:5],
        times=times,
        measure=found.measure,
    )


def _changes(numbers: np.ndarray, planned: Exposures) -> np.ndarray:
    """Changes [B, 7] of the plan, all beams moved together as near to it as can be."""
    found = _exposures(numbers, planned)
    return changes(replace(found, views=moved_onto(found.views, planned.views)), planned)


def align_views(
    scan: Scan,
    prior: MaterialPrior,
    options: PoseOptions = DEFAULT,
    *,
    light: LightOptions = EVEN_OR_NOT,
    on_progress: Progress = lambda stage, fraction: None,
) -> AlignedViews:
    """Find the true poses of the views of `scan` from its frames.

    prior: of the material
    options: the uncertainty of the planned poses, and the search

    The result has the corrected `exposures`, and for each view `changes` and standard `errors` [V, 7]: shifts x, y
    [pixels], rotations about x, y, z [degrees], shares of distance and magnification. Poses that explain the frames no
    better than the planned ones are not taken. Series have one geometry for all times, and two or three beams in one
    plane are aligned by their rows (`align_beams`); all other scans, and distances, by a volume (`align_still`).
    Errors: `InputError` for fewer than two training frames of a time, and for series in which no beam has two times.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> found = hs.align_views(scan, hs.MaterialPrior.known(water))
        >>> found.changes.shape
        (8, 7)
        >>> moved = scan.with_views(found.exposures.views)
    """
    scan.views.parallel("finding poses")
    train = ~scan.is_test
    posed = options.uncertain.distance == 0 and options.uncertain.magnification == 0
    few = posed and bool(train.any()) and int(train.sum()) < FEW and plane_angles(scan.views) is not None
    how = align_beams if scan.is_series or few else align_still
    return how(scan, prior, options, light=light, on_progress=on_progress)
