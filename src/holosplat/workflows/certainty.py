"""Errors of a reconstruction's numbers, factors of their intervals, frames like the measured ones, and reconstructions
like one that was made, by which mistakes in the metadata of a scan are compared on held-out frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..align import find_axis
from ..beamline.simulate import Simulation, simulated_frames
from ..checks import InputError, require
from ..geometry import Grid, rotation_y
from ..inference import Decision, Score, select
from ..matter import DeltaBeta, MaterialPrior
from ..methods import Method, Uncertain
from ..methods.cross_validation import predicted_frames
from ..methods.illumination import CORRELATED, STAGE
from ..metrics import volume_scores
from ..model.alignment import Alignment
from ..optics.background import LightOptions
from ..optics.noise import NoiseModel
from ..progress import Progress
from ..rotations import angles_about_y
from ..scan import Exposures, Scan
from ..tables import overridden, paths, read_table
from ..volume import Volume
from .evaluate import of_absorption
from .next_step import STIFF
from .reconstruct import reconstruct
from .reconstruction import Reconstruction
from .run_illumination import light_of
from .totals import ratio_doubt

FACTORS = Path(__file__).with_name("conformal.toml")
"""Factors of stated errors, with the scenes that they are of: benchmarks/calibrate_intervals.py."""
LEVEL = 0.9
"""Part of the calibration's scenes whose truth lies in an interval."""


@dataclass(frozen=True)
class Factor:
    """How a quantity of rehearsals becomes an interval that holds the truth in `LEVEL` of the calibration's scenes.

    floor: added to the scale of a run, for one near 0 promises too much (Papadopoulos et al. 2008, normalised
    nonconformity); factor: of the sum of both; power: 1 if the scale counts times the excess, else 0: what rehearsals
    do not show leaves more in the frames than they do
    """

    floor: float
    factor: float
    scenes: int
    power: int = 0

    def reach(self, scale: float, excess: float) -> float:
        """How far an interval goes, by the scale of a run and its excess."""
        return self.factor * (scale * max(1.0, excess) ** self.power + self.floor)


@cache
def factors() -> Mapping[str, Factor]:
    """The table of the calibration, by quantity."""
    return {name: Factor(**entry) for name, entry in read_table(FACTORS).items()}


SIGNED, SIZES = ("total", "delta", "volume"), ("centre", "dice", "error", "resolution")
"""Quantities with errors of either sign, as shares; and sizes of errors: of the centre of mass [pixels], 1 - Dice, the
relative error of δ, and the logarithm of the resolution over two pixels."""


def scale_of(name: str, values: np.ndarray) -> float:
    """How far off a quantity may be by its values in rehearsals [K]: their root mean square; of the resolution, whose
    logarithm is 0 or large, the mean."""
    return float(values.mean() if name == "resolution" else np.sqrt(np.square(values).mean()))


def true_sizes(found: float, low: float, high: float) -> tuple[float, float]:
    """The least and the largest positive value whose measurement `found` has an error, as a share, of `low` to `high`;
    a measurement of the wrong sign says nothing of the size."""
    if found <= 0:
        return 0.0, math.inf
    return found / (1 + high), found / (1 + low) if low > -1 else math.inf


def errors_of(found: Reconstruction, truth: Volume) -> dict[str, float]:
    """The quantities `SIGNED` and `SIZES` of a reconstruction against the true volume on its grid."""
    volume = found.object.voxelise(truth.grid)
    volume, truth = (volume, truth) if found.delta_told else (of_absorption(volume), of_absorption(truth))
    scores, cell = volume_scores(volume, truth), math.prod(truth.grid.voxel_size)
    stated = None if found.total is None else found.total.value
    true = float(truth.delta.sum(dtype=np.float64)) * cell
    size = float(np.abs(truth.delta).sum(dtype=np.float64)) * cell
    stated = float(volume.delta.sum(dtype=np.float64)) * cell if stated is None else stated
    widest, resolution = max(truth.grid.shape) / 2, scores.resolution_half_bit
    periods = 1.0 if resolution is None else min(resolution / (2 * scores.pitch), widest)
    matter, true_matter = (each.delta / scores.material_delta > 0.5 for each in (volume, truth))
    return {
        "total": (stated - true) / size,
        "delta": scores.delta_deviation,
        "volume": float(matter.sum()) / float(true_matter.sum()) - 1,
        "centre": float(np.linalg.norm(_centre(volume.delta) - _centre(truth.delta))),
        "dice": 1 - scores.dice,
        "error": scores.relative_error_delta,
        "resolution": math.log(periods),
    }


def _centre(delta: np.ndarray) -> np.ndarray:
    """The centre of mass [voxels]; the middle of an empty volume."""
    from scipy.ndimage import center_of_mass  # which takes long to load

    weight = np.abs(delta).astype(np.float64)
    return np.array(center_of_mass(weight if weight.any() else np.ones_like(weight)))


@dataclass(frozen=True)
class Again:
    """Reconstructs other frames as a run did, with what it decided on matter and light."""

    prior: MaterialPrior
    method: Method
    seed: int
    done: Reconstruction

    def __call__(self, scan: Scan, further: int = 0, **changed: Any) -> Reconstruction:
        """The reconstruction of the training frames of `scan`, with another seed and what is `changed` of it."""
        done = self.done
        taken = next((each.choice for each in reversed(done.choice.decisions) if each.name == STAGE), "")
        light = replace(done.light, noise="correlated" if CORRELATED in taken else "white")
        light = light if done.still is None else LightOptions()  # which finds the fixed pattern, too
        kind = done.choice.matter if done.choice.matter in self.method.kinds_of_matter else None  # as of older runs
        how = {"prior": self.prior, "method": self.method, "light": light, "matter": kind}
        return reconstruct(scan, seed=self.seed + further, **(how | changed))


def as_uncertain(done: Reconstruction, exposures: Exposures, bins: int, rng: np.random.Generator) -> Exposures:
    """`exposures` [V] of the training frames, on pixels joined `bins` × `bins`, where they may as well be: distance and
    energy are drawn from the intervals of a run's `constants` (95 %, as logarithms), poses from the standard errors of
    its `geometry`. Without either they are as given."""
    for each in done.constants:
        if each.name in ("distance", "energy_kev"):
            factor = math.exp(0.25 * math.log(each.high / each.low) * rng.normal())
            known = getattr(exposures, each.name)
            reference = None if each.name == "energy_kev" else exposures.reference_kev
            changed = {each.name: np.clip(known * factor, *each.given), "reference_kev": reference}
            exposures = replace(exposures, **changed)
    if done.geometry is None:
        return exposures
    errors = np.nan_to_num(done.geometry.errors[~done.geometry.held_out])
    away = torch.from_numpy(errors * rng.normal(size=errors.shape))
    shifts, turns, larger = away[:, :2] / bins, torch.deg2rad(away[:, 2:5]), away[:, 6]
    return Alignment(turns, shifts, away[:, 5], magnified=larger if larger.any() else None).exposures(exposures)


def turned_by(exposures: Exposures, degrees: float) -> Exposures:
    """Views turned by `degrees` about the object: about the line along y through what all look at."""
    views, by = exposures.views, rotation_y([degrees])[0]
    middle = Grid.of_views(views).centre
    rotations = views.rotations @ by
    shifts = views.shifts + ((rotations - views.rotations) @ middle)[:, :2]
    return replace(exposures, views=replace(views, rotations=rotations, shifts=shifts))


def drawn_frames(done: Reconstruction, scan: Scan, exposures: Exposures, seed: int) -> Scan:
    """`scan` with frames of a result as `exposures` see it, in the light and noise of the measured ones."""
    noise, factor = _noise_and_light(done, scan)
    with torch.no_grad():
        quiet = np.stack(list(simulated_frames(done.object, exposures, Simulation())))
    frames = quiet * factor + noise.drawn(seed).numpy() * np.sqrt(np.clip(quiet, 0, None))
    return replace(scan, frames=frames.astype(np.float32))


def _noise_and_light(done: Reconstruction, scan: Scan) -> tuple[NoiseModel, np.ndarray]:
    """Noise and light of measured frames at these pixels."""
    lit = light_of(scan, done.light, done.still)
    if lit is None:
        return NoiseModel.of_frames(scan.measured), np.ones((1, 1, 1))
    return lit.noise, lit.factor().numpy()


def doubts_of(done: Reconstruction, prior: MaterialPrior) -> dict[str, float]:
    """What the scale of a quantity is at least: of the total the standard error that the run states, as a share; where
    δ/β was estimated, that of δ/β, which rehearsals of one result take for true."""
    ratio, total = ratio_doubt(prior, done.constants) if done.delta_told else 0.0, done.total
    found = dict.fromkeys(("total", "delta", "error"), ratio) if ratio else {}
    return found | ({"total": total.error / abs(total.value)} if total and total.value and total.error else {})


NULL = "metadata as given"
"""The candidate that leaves scan and prior alone."""
NAME, BY = "mistake in the metadata", "held-out frames"
FEWEST = 4
"""Frames of which one can be held out, and parts of which one is."""
RANGE = 3.0
"""Factor by which a distance or δ/β may be larger or smaller than given."""
AWAY = 2.0
"""Pixels by which the axis is tried elsewhere: one that is wrong by more than half of that comes nearer."""


Change = Callable[[Scan, Again], tuple[Scan, Mapping[str, Any]]]
"""A scan and what is changed of its reconstruction, as `Again` takes it by name, if a mistake is put right."""


def _other_sign(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
    prior = again.prior
    flipped = [DeltaBeta(-delta, -beta) for delta, beta in prior.materials]
    return scan, {
        "prior": MaterialPrior.known(*flipped) if flipped else prior.signed(-1 if prior.delta_sign > 0 else 1)
    }


def _axis(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
    axis = find_axis(scan.train())
    require(not axis.stays, "the axis is where the scan says.")
    return replace(scan, exposures=axis.applied(scan.exposures)), {}


def _turned(angles: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Other angles [rad] than those of the scan."""

    def change(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
        views = scan.views
        if not views.shares_axis:
            raise InputError("views without a common axis have no angles.")
        rotations = rotation_y(np.rad2deg(angles(np.unwrap(angles_about_y(views.rotations)))))
        return replace(scan, exposures=replace(scan.exposures, views=replace(views, rotations=rotations))), {}

    return change


def _beside(pixels: float) -> Change:
    """An axis of rotation elsewhere, which `find_axis` may not tell in few views."""

    def change(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
        views = scan.views
        require(views.shares_axis, "views without a common axis have none that is elsewhere.")
        shifts = views.shifts + np.array([pixels * views.finest, 0.0])
        return replace(scan, exposures=replace(scan.exposures, views=replace(views, shifts=shifts))), {}

    return change


def _spread(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
    return scan, {"uncertain": Uncertain(distance=_about(float(np.median(scan.exposures.distance))))}


def _ratio(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
    prior = again.prior
    ratio = prior.materials[0].ratio if prior.materials else getattr(prior, "ratio", 0.0)
    if not ratio or len(prior.materials) > 1:
        raise InputError("there is no one known ratio δ/β.")
    return scan, {"prior": MaterialPrior.unknown(prior.sign), "uncertain": Uncertain(delta_beta=_about(abs(ratio)))}


def _about(value: float) -> tuple[float, float]:
    return value / RANGE, value * RANGE


def _beyond(scan: Scan, again: Again) -> tuple[Scan, Mapping[str, Any]]:
    """In every volume of the method: `Auto` has one for each kind of matter."""
    places = [path for path in paths(again.method) if path.endswith("volume.beside")]
    require(len(places) > 0, f"the method {again.method.kind} has no matter beyond the field.")
    return scan, {"method": overridden(again.method, [f"{path}=0.5" for path in places])}


def _steps(turn: float) -> Change:
    return _turned(lambda angles: np.arange(len(angles)) * turn / len(angles))


MISTAKES: Mapping[str, tuple[str, Change]] = {
    "axis of rotation": ("shift_x", _axis),
    "axis to the left": ("shift_x", _beside(-AWAY)),
    "axis to the right": ("shift_x", _beside(AWAY)),
    "other sign of δ": ("sign", _other_sign),
    "angles in reverse order": ("angles", _turned(lambda angles: angles[::-1])),
    "angles in radians": ("angles", _turned(lambda angles: np.rad2deg(angles))),
    "twice the angles": ("angles", _turned(lambda angles: 2 * angles)),
    "half the angles": ("angles", _turned(lambda angles: 0.5 * angles)),
    "equal steps over 180°": ("angles", _steps(np.pi)),
    "equal steps over 360°": ("angles", _steps(2 * np.pi)),
    "uneven light": ("light", lambda scan, again: (scan, {"light": LightOptions("smooth")})),
    "distance": ("distance", _spread),
    "δ/β": ("absorption", _ratio),
    "continuous matter": (STIFF, lambda scan, again: (scan, {"matter": "continuous"})),
    "matter beyond the field": ("beyond", _beyond),
}
"""Mistakes from simple to complex: each with the key of `STEPS`, and what puts it right."""


def compare_causes(
    scan: Scan, again: Again, rehearsed: Scan | None = None, on_progress: Progress = lambda stage, fraction: None
) -> Decision:
    """Which of `MISTAKES`, put right, predicts held-out frames better than the metadata as given, the null.

    rehearsed: the same frames, simulated of the result; there the metadata are right, so that what predicts better
    there, too, mends the method, and is no mistake
    Without held-out frames, a quarter of them is held out, as often as it takes. Another sense of rotation is none of
    the mistakes: the mirrored object gives the same frames. The choice is a key of `STEPS`, or the null.
    """
    if len(scan) < FEWEST:
        return Decision(NAME, NULL, f"fewer than {FEWEST} frames, of which none can be held out")
    folds = 1 if scan.is_test.any() else FEWEST
    score, possible, mends = _unseen(scan, again), [NULL], list[str]()
    for number, name in enumerate(MISTAKES):
        on_progress(f"cause: {name}", number / len(MISTAKES))
        if score(name, 0) is not score(NULL, 0):
            possible.append(name)
    mended = None if rehearsed is None else _unseen(rehearsed, again)
    while True:
        by = BY + (f"; in rehearsals, too: {', '.join(mends)}" if mends else "")
        decision = select(NAME, possible, score, folds, by=by)
        taken = decision.choice
        if taken == NULL or mended is None or select(NAME, (NULL, taken), mended, folds, by=BY).choice == NULL:
            return replace(decision, choice=NULL if taken == NULL else MISTAKES[taken][0])
        possible.remove(taken)
        mends.append(taken)


def _unseen(scan: Scan, again: Again) -> Callable[[str, int], Score]:
    """What reconstructions of a scan leave of its held-out frames, or of a quarter of its frames, with the mistake of a
    name put right; the same as the null where this mistake cannot have been made, and all where there is no matter."""

    @cache
    def score(name: str, fold: int) -> Score:
        aside = scan.is_test if scan.is_test.any() else (np.arange(len(scan)) + fold) % FEWEST == FEWEST - 1
        split = replace(scan, is_test=aside)
        try:
            changed, how = (split, {}) if name == NULL else MISTAKES[name][1](split, again)
            found = again(changed, **how)
            require("uncertain" not in how or all(each.told for each in found.constants), "frames do not tell it.")
        except InputError:
            return score(NULL, fold) if name != NULL else Score.of(split.test().left(torch.ones(())))
        placed = found.placed(changed)
        lit, test = light_of(placed, found.light, found.still), placed.test()
        predicted = predicted_frames(test.exposures, found.object, found.oversample)
        lamp = 1.0 if lit is None else lit.factor()[torch.from_numpy(aside)].to(predicted)
        return Score.of(test.left(predicted * lamp))

    return score
