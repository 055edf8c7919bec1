"""The axis of a turning object, from projections alone: its column, and how it leans sideways."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Annotated

import numpy as np

from ..baselines.material import LIKELY_RATIOS
from ..checks import InputError, require
from ..frames import evenly
from ..geometry import rotation_y
from ..inference import Compared, Decision, Score, select
from ..matter import Known, KnownRatio, MaterialPrior
from ..methods.cross_validation import PICTURE_VIEWS, FirstVolumes, Folds, coarse_binning
from ..methods.trials import NULL, WITHOUT, Trials
from ..optics.background import LightOptions
from ..progress import Advance
from ..ranges import MOST, Natural, Within, checked_dataclass
from ..rotations import angles_about_y
from ..scan import Exposures, Scan
from .consistency import (
    AxisSearch,
    Estimate,
    HalfTurn,
    MirroredPairs,
    Sinograms,
    combined,
    ends_of,
    half_turn,
    may_be_half,
    minimum,
)
from .views import EVEN_OR_NOT, in_even_light, shadows

PLACE, BY_ALL, BY_MIRROR = "place of the axis", "consistency of all frames", "frames half a turn apart"
STEP = 0.25
"""Distance of the places that are tried [columns]; a parabola finds the place between them."""
LEAN, UPRIGHT, LEANING = "lean of the axis", "as the scan says", "leaning"
AXIS, GIVEN, FOUND = "axis of rotation", "as the scan says", "found"
FINE_REACH = 4
"""How far beside the place that a coarse search finds a fine one looks [columns]."""
GROUPS = 8
"""Groups of pairs of frames half a turn apart, whose axes tell the error of their mean."""
FEWEST_VIEWS = 6
"""Fewer views than this leave nothing to judge an axis by."""


@checked_dataclass
class AxisOptions:
    """How the axis of a turning object is looked for."""

    within: Annotated[float, Within(0.01, 0.5)] = 0.3
    """How far from where the scan says it is, as a share of the frames' width."""
    bands: Natural = 16
    """Rows are averaged to so many slices at most: enough for a lean, and neighbouring rows differ little."""
    columns: Annotated[int, Within(32, MOST)] = 512
    """Columns are averaged to so many at most; the place is found to some hundredths of one."""
    views: Annotated[int, Within(FEWEST_VIEWS, MOST)] = 256
    """Views that are looked at, at most, evenly spread: more add little and take time."""


@dataclass(frozen=True)
class Axis:
    """The axis of a rotating object.

    offset: from where the scan said it is, at the middle of the object frame, along the columns [pixels]
    lean: of the axis in the image, columns a row; positive: further right further down; None: too few rows
    column: of the axis in the frames' middle row, 0 the middle of the first one; of the first view
    turn: where a half turn ends, if not where the scan says
    place: how its place was chosen, where frames half a turn apart tell one, too
    judged: whether views set aside are predicted better about it, where first volumes resolve how far it lies
    """

    offset: Estimate
    lean: Estimate | None
    column: float
    rows: int
    turn: HalfTurn | None = None
    place: Decision | None = None
    judged: Decision | None = None

    @property
    def stays(self) -> bool:
        """Whether it is left as the scan says: it is not surely elsewhere, or predicts unseen views no better."""
        if self.judged is not None:
            return self.judged.choice == GIVEN
        return self.turn is None and not (self.leans or self.offset.compared(FOUND).wins)

    @property
    def leans(self) -> bool:
        """Whether the axis leans for sure."""
        return self._tilts and (self.judged is None or self.judged.choice == self.judged.compared[-1].name)

    @property
    def _tilts(self) -> bool:
        """Whether the moments say so."""
        return self.lean is not None and self.lean.compared(LEANING).wins

    @cached_property
    def decisions(self) -> tuple[Decision, ...]:
        """On the place, where there are two, on the lean, where the frames have enough rows, and by unseen views."""
        lean = None
        if self.lean is not None:
            choice = LEANING if self._tilts else UPRIGHT
            lean = Decision(LEAN, choice, "likelihood ratio", (self.lean.compared(LEANING),))
        return tuple(each for each in (self.place, lean, self.judged) if each is not None)

    def applied(self, exposures: Exposures) -> Exposures:
        """The exposures with the axis where it is: detector shifts, a roll `ω_z = -atan(lean)` where it leans, and the
        angles of a half turn that ends elsewhere; the same where it `stays`."""
        return exposures if self.stays else self._moved(exposures, self.leans)

    def _moved(self, exposures: Exposures, leaning: bool) -> Exposures:
        views, p = exposures.views, exposures.views.pixel_size
        rotations = views.rotations
        if self.turn is not None:
            angles = np.unwrap(angles_about_y(views.rotations))
            rotations = rotations @ rotation_y(np.rad2deg(self.turn.spread(angles) - angles))
        if leaning and self.lean is not None:
            angle = -np.arctan(self.lean.value)
            c, s = np.cos(angle), np.sin(angle)
            rotations = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotations
        shifts = views.shifts - np.array([self.offset.value * p, 0.0])
        return replace(exposures, views=replace(views, rotations=rotations, shifts=shifts))

    def lines(self) -> list[str]:
        """The result in words."""
        moved = f"{self.offset.value:+.3f} from the scan's"
        said = [] if self.turn is None or self.stays else [self.turn.line()]
        why = (
            "the difference is not sure"
            if self.judged is None
            else "views set aside are predicted no better about this one"
        )
        kept = f"; the scan's is kept, for {why}" if self.stays else ""
        said.append(f"axis at column {self.column:.3f} ± {self.offset.error:.3f} ({moved}){kept}")
        if self.lean is None:
            few = self.place is None or self.place.choice == BY_ALL
            why = "have too few rows to tell" if few else "do not show all of the matter, so that they do not tell"
            said.append(f"lean of the axis: the frames {why}")
        else:
            degrees = np.rad2deg(np.arctan([self.lean.value, self.lean.error]))
            used = "" if self.leans else f"; {'' if self._tilts else 'not sure, '}left as the scan says"
            said.append(f"lean of the axis {degrees[0]:+.3f}° ± {degrees[1]:.3f}°{used}")
        said += [] if self.judged is None else [self.judged.line]
        said.append(
            "sense of rotation: parallel beams cannot tell it, for the mirrored object that turns the other way gives "
            "the same frames; it stays as the scan says"
        )
        return said


def find_axis(
    scan: Scan,
    options: AxisOptions = AxisOptions(),
    *,
    prior: MaterialPrior = MaterialPrior.unknown(),
    light: LightOptions = EVEN_OR_NOT,
    on_progress: Advance = lambda fraction: None,
) -> Axis:
    """The axis of the object that turns in `scan`, from the consistency of its projections.

    Their moments tell an optimum and its error, but not whether another one, far off, is right: few views, fringes and
    matter that leaves the field have several. So an axis that moves matter by more than a voxel of first volumes
    between opposite views must predict views set aside surely better than the one that the scan says does, and better
    than no matter. Where it moves matter by less, such volumes hardly tell the two apart, and the moments decide.

    Where matter leaves the frames, as in a half acquisition, projections are not consistent. Frames half a turn apart
    still mirror each other about the axis in the columns that both have. The axis at which they do best is taken where
    this is surely better than near the other one.

    prior: of the material. Errors: `InputError` for views that turn about no common axis, for fewer than
    `FEWEST_VIEWS`, and where no place within the field is better than those beside it.
    """
    return _judged(_by_moments(scan, options, _ratio(prior), light, on_progress), scan, prior, light)


def _ratio(prior: MaterialPrior) -> float | None:
    """δ/β, where it is known and positive."""
    if isinstance(prior, KnownRatio):
        return prior.ratio
    return prior.materials[0].ratio if isinstance(prior, Known) and prior.materials[0].beta > 0 else None


def _judged(axis: Axis, scan: Scan, prior: MaterialPrior, light: LightOptions) -> Axis:
    """The axis as views set aside judge it, by volumes of the others about it and about the one of `scan`. Where δ/β is
    not known, matter that hardly absorbs stands for it about both, for a wrong axis tells a wrong one."""
    voxel, some = coarse_binning(scan), evenly(len(scan), PICTURE_VIEWS)
    tilted = axis.leans and axis.lean is not None and abs(axis.lean.value) * scan.views.shape[0] > voxel
    if 2 * abs(axis.offset.value) <= voxel and not tilted:
        return axis
    given, frames = scan.exposures, in_even_light(scan[some], light)
    prior = prior if prior.fixes_ratio else prior.with_ratio(LIKELY_RATIOS[1])
    placed = {GIVEN: given, FOUND: axis._moved(given, axis.leans and not tilted)}
    if tilted:
        placed[LEANING] = axis._moved(given, True)
    folds = {name: Folds.of(frames.taken(exposures[some])) for name, exposures in placed.items()}
    firsts = {name: FirstVolumes(each, prior, lambda stage, fraction: None) for name, each in folds.items()}
    trials = {name: Trials(each, LightOptions()) for name, each in firsts.items()}
    nothing = GIVEN + WITHOUT

    def score(name: str, fold: int) -> Score:
        return trials[GIVEN].score(NULL + WITHOUT, fold) if name == nothing else trials[name].score(NULL, fold)

    beside = dict.fromkeys(placed, (nothing,))
    # an offset is no simpler than another, and moments have told its size
    decision = select(AXIS, tuple(placed), score, folds[GIVEN].count, by=folds[GIVEN].by, beside=beside, least=0.0)
    return replace(axis, judged=decision)


def _by_moments(
    scan: Scan, options: AxisOptions, ratio: float | None, light: LightOptions, on_progress: Advance
) -> Axis:
    """The axis that moments, or frames half a turn apart, tell."""
    views = scan.views
    scan.views.parallel("finding the rotation axis")
    require(
        views.shares_axis,
        "the axis is that of views which turn about the object's y axis alone, but these do not; align without "
        "--axis-only.",
    )
    chosen = evenly(len(scan), options.views)
    require(
        len(chosen) >= FEWEST_VIEWS,
        f"an axis needs {FEWEST_VIEWS} views at least, but there are {len(chosen)}; align without --axis-only.",
    )
    sinograms = _sinograms(scan[chosen], options, ratio, light)
    pairs, found = MirroredPairs.of(sinograms), None
    try:
        found = _search_axis(scan, sinograms, options, on_progress)
    except InputError:
        if pairs is None:
            raise
    if pairs is not None:
        found = _against(pairs, found, scan)
    assert found is not None
    angles = np.unwrap(angles_about_y(scan.views.rotations))
    if not may_be_half(angles):
        return found
    ends = _sinograms(scan[ends_of(len(scan))], options, ratio, light)
    turn = half_turn(angles, ends, found.offset.value)
    if turn is None:
        return found
    turned = replace(sinograms, angles=turn.spread(np.unwrap(sinograms.angles)))
    return replace(_search_axis(scan, turned, options, on_progress), turn=turn)


def _against(pairs: MirroredPairs, found: Axis | None, scan: Scan) -> Axis:
    """The axis of frames half a turn apart, where it is surely better than the best one near `found`, or else `found`.

    Errors: `InputError` where there is neither.
    """
    near = np.arange(-FINE_REACH, FINE_REACH + STEP, STEP) * (pairs.positions[1] - pairs.positions[0])
    coarse, _ = pairs.likeliest(pairs.positions)
    best, table = pairs.likeliest(coarse + near)
    count = min(GROUPS, len(pairs.one))
    tried = [minimum(coarse + near, -table[:, n::count].sum(1)) for n in range(count)]
    places = np.array([place for place in tried if place is not None])
    before = None if found is None else pairs.likeliest(found.offset.value + near)[0]
    gains = pairs.told(best) - (0.0 if before is None else pairs.told(before))
    compared = Compared(BY_MIRROR, float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains))))
    wins = compared.wins and len(places) > 1
    decision = Decision(PLACE, BY_MIRROR if wins else BY_ALL, "likelihood ratio", (compared,))
    if found is not None and not wins:
        return replace(found, place=decision)
    require(wins, "the projections tell no axis; check the angles, or say where it is by --axis-column.")
    offset = combined(*places.T)
    return Axis(offset, None, _middle(scan) + offset.value, scan.views.shape[0], place=decision)


def _middle(scan: Scan) -> float:
    """The column of the nominal axis in the first view, 0 the middle of the first one."""
    return 0.5 * (scan.views.shape[1] - 1) - float(scan.views.shifts[0, 0]) / scan.views.pixel_size


def _search_axis(scan: Scan, sinograms: Sinograms, options: AxisOptions, on_progress: Advance) -> Axis:
    """The axis of sinograms of `scan`."""
    width, columns = scan.views.shape[1], sinograms.values.shape[-1]
    factor, pitch = max(1, columns // 64), scan.views.shape[1] / columns
    first = AxisSearch.of(
        sinograms.binned(factor), 0.0, options.within * width, 0.5 * factor * pitch, lambda f: on_progress(0.5 * f)
    )
    near, lean = first.likeliest()
    reach = (2 * factor + FINE_REACH) * pitch + abs(lean) * 0.5 * float(np.ptp(sinograms.heights))
    fine = AxisSearch.of(sinograms, near, reach, STEP * pitch, lambda f: on_progress(0.5 + 0.5 * f))
    offset, leaning = fine.found(lean)
    return Axis(offset, leaning, _middle(scan) + offset.value, scan.views.shape[0])


def _sinograms(scan: Scan, options: AxisOptions, ratio: float | None, light: LightOptions) -> Sinograms:
    """Sinograms of all frames of `scan`."""
    views = scan.views
    (h, w), p = views.shape, views.pixel_size
    images = shadows(scan, ratio, light).numpy()
    edges = np.linspace(0, h, min(options.bands, h) + 1).round().astype(int)
    values = np.stack([_mean_row(images[:, a:b]) for a, b in pairwise(edges)], axis=1)
    heights = 0.5 * (edges[:-1] + edges[1:]) - h / 2 + views.shifts[0, 1] / p
    seen = ~np.isnan(values).any(axis=(0, 2))  # slices that all views see
    require(
        bool(seen.any()), "an axis needs slices that all views see; leave out views without pixels that have a value."
    )
    values, heights = values[:, seen], heights[seen]
    sideways = views.shifts[:, :1] / p
    positions = np.arange(w) + 0.5 - w / 2 + (sideways[:1] if np.ptp(sideways) < 1e-9 else sideways)
    return Sinograms(values, angles_about_y(views.rotations), positions, heights).binned(
        max(1, -(-w // options.columns))
    )


def _mean_row(images: np.ndarray) -> np.ndarray:
    """The mean row [V, W] of images [V, K, W] of which pixels that are NaN have no part; columns without any are those
    between their neighbours. NaN in views that have none."""
    known = ~np.isnan(images)
    count, rows = known.sum(1), np.where(known, images, 0).sum(1)
    rows = np.where(count > 0, rows / np.maximum(count, 1), np.nan)
    for row, there in zip(rows, count > 0):
        if there.any():
            row[~there] = np.interp(np.flatnonzero(~there), np.flatnonzero(there), row[there])
    return rows
