"""Rehearsal: frames of a result are simulated and reconstructed in the same way, which shows bias and spread of each
number, and the residual that the method leaves of frames whose matter it has found (a parametric bootstrap; Efron &
Tibshirani 1993, chapter 6)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ..beamline.simulate import Simulation, simulated_frames
from ..checks import InputError, as_written, require
from ..geometry import Grid
from ..inference import Decision
from ..matter import MaterialPrior
from ..methods import Auto, Method
from ..methods.illumination import CORRELATED, STAGE
from ..metrics import volume_scores
from ..optics.background import LightOptions
from ..optics.noise_model import NoiseModel
from ..progress import Progress
from ..representations import InMotion
from ..scan import Scan
from ..tables import read_table
from ..units import in_percent, two_digits
from ..volume import Volume
from .evaluate import of_absorption
from .next_step import NULL, compare_causes, next_step
from .reconstruct import reconstruct
from .reconstruction import Reconstruction
from .run_folder import RunFolder
from .run_illumination import light_of
from .verdict import Verdict

SIDE = 48
"""Pixels along the shorter side of the frames of a rehearsal, about: a reconstruction then takes seconds."""
FEWEST = 2
"""Rehearsals that have a spread."""
FACTORS = Path(__file__).with_name("conformal.toml")
"""Factors of stated errors, with the scenes that they are of: benchmarks/calibrate_intervals.py."""
LEVEL = 0.9
"""Part of the calibration's scenes whose truth lies in an interval."""
ENTRY = "rehearsal"
"""The entry of summary.json."""
Word = Literal["consistent", "limited", "wrong"]


@dataclass(frozen=True)
class Factor:
    """How a quantity of rehearsals becomes an interval that holds the truth in `LEVEL` of the calibration's scenes.

    floor: median of the quantity's scale over the scenes, added to that of a run: a scale near 0 promises too much
    (Papadopoulos et al. 2008, normalised nonconformity); factor: of the sum of both
    """

    floor: float
    factor: float
    scenes: int


@cache
def factors() -> Mapping[str, Factor]:
    """The table of the calibration, by quantity."""
    return {name: Factor(**entry) for name, entry in read_table(FACTORS).items()}


def conformal_quantile(scores: np.ndarray, level: float) -> float:
    """The ⌈(n + 1) level⌉-th smallest of n scores, which the next one exceeds with a probability of at most 1 - level
    (Vovk et al. 2005; Lei et al. 2018, section 2.2); infinite for too few."""
    rank = math.ceil((len(scores) + 1) * level)
    return float(np.sort(scores)[rank - 1]) if rank <= len(scores) else math.inf


SIGNED, SIZES = ("total", "delta", "volume"), ("centre", "dice", "error")
"""Quantities with errors of either sign, as shares; and sizes of errors: of the centre of mass [pixels], 1 - Dice, and
the relative error of δ. Beside them stands `resolution`, the logarithm of a length over two pixels."""
RESIDUAL = "residual"


def centre_and_scale(name: str, values: np.ndarray) -> tuple[float, float]:
    """Where a quantity's error is expected by its values in rehearsals [K], and how far off that may be.

    Resolutions at the limit of the sampling have no spread, so that all runs have the same scale.
    """
    if name == "resolution":
        return float(values.mean()), 1.0
    return 0.0, float(np.sqrt(np.square(values).mean()))


def errors_of(found: Reconstruction, truth: Volume) -> dict[str, float]:
    """The quantities `SIGNED`, `SIZES` and `resolution` of a reconstruction against the true volume on its grid."""
    volume = found.object.voxelise(truth.grid)
    volume, truth = (volume, truth) if found.delta_told else (of_absorption(volume), of_absorption(truth))
    scores, cell = volume_scores(volume, truth), math.prod(truth.grid.voxel_size)
    stated = None if found.total is None else found.total.value
    true = float(truth.delta.sum(dtype=np.float64)) * cell
    size = float(np.abs(truth.delta).sum(dtype=np.float64)) * cell
    stated = float(volume.delta.sum(dtype=np.float64)) * cell if stated is None else math.copysign(stated, true)
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
    weight = np.abs(delta).astype(np.float64)
    weight = weight if weight.any() else np.ones_like(weight)
    axes = [weight.sum(axis=tuple(b for b in range(3) if b != a)) for a in range(3)]
    return np.array([float(np.average(np.arange(len(w)), weights=w)) for w in axes])


def residual_by_band(found: Verdict) -> np.ndarray:
    """[B] root mean squares of the residual over all views."""
    return np.sqrt(np.square(found.residual).mean(axis=0))


@dataclass(frozen=True)
class Rehearsal:
    """What rehearsals of a run show.

    binned: pixels of the frames along an edge of one in a rehearsal; pixel: that edge [m]
    explained: the verdict on the measured frames at these pixels, reconstructed likewise
    runs: [K] tables of `errors_of`, the `residual` [B] and the likely `cause` of each rehearsal
    total: that the run states [m³], None for none; quantity: of which index
    cause: between the metadata as given, the null, and mistakes in them; None where the residual gave no reason
    """

    binned: int
    pixel: float
    explained: Verdict
    runs: tuple[Mapping[str, Any], ...]
    total: float | None = None
    quantity: str = "δ"
    cause: Decision | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON, with what they say; `from_dict` reads them."""
        plain = {"binned": self.binned, "pixel_m": self.pixel, "explained": self.explained.as_dict()}
        plain |= {"runs": list(self.runs), "total_m3": self.total, "quantity": self.quantity}
        plain |= {"cause": self.cause and self.cause.as_dict()}
        if len(self.runs) < FEWEST:
            return plain
        said = {name: list(self.interval(name)) for name in (*SIGNED, *SIZES, "resolution")}
        return plain | {"word": self.word, "intervals_of_errors": said, "words": self.lines()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Rehearsal:
        """What `as_dict` described; `InputError` for anything else."""
        try:
            total, cause = values["total_m3"], values["cause"]
            return cls(
                int(values["binned"]),
                float(values["pixel_m"]),
                Verdict.from_dict(values["explained"]),
                tuple({name: _plain(value) for name, value in run.items()} for run in values["runs"]),
                None if total is None else float(total),
                str(values["quantity"]),
                None if cause is None else Decision.from_dict(cause),
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise InputError(f"a rehearsal must be what rehearse wrote, but it lacks or garbles {error}.") from error

    def values(self, name: str) -> np.ndarray:
        """A quantity in all rehearsals, [K] or [K, B]."""
        return np.array([run[name] for run in self.runs], dtype=np.float64)

    def interval(self, name: str) -> tuple[float, float]:
        """Ends of the interval of a quantity's error; that of a size begins at 0."""
        centre, scale = centre_and_scale(name, self.values(name))
        of = factors()[name]
        reach = of.factor * (scale + of.floor)
        return (0.0 if name in SIZES else centre - reach), centre + reach

    @property
    def excess(self) -> tuple[float, int]:
        """The residual over what rehearsals leave of the same band, or over what the verdict allows there if that is
        more (root mean squares): in the band where that is most, and the number of this band."""
        of_rehearsals = np.sqrt(np.square(self.values(RESIDUAL)).mean(axis=0))
        allowed = np.sqrt(np.square(self.explained.allowed).mean(axis=0))
        over = residual_by_band(self.explained) / np.maximum(of_rehearsals, allowed)
        return float(over.max()), int(over.argmax())

    @property
    def limit(self) -> float:
        """The excess that 95 % of the right runs of the calibration stay below."""
        return factors()[RESIDUAL].factor

    @property
    def doubtful(self) -> bool:
        """Whether the residual is more than this method leaves, or has a cause that no rehearsal shows."""
        found = self.explained
        own = not found.good and found.cause not in [str(run["cause"]) for run in self.runs]
        return self.excess[0] > self.limit or own

    @property
    def word(self) -> Word:
        """consistent: the frames are explained; limited: they are not, but the method leaves as much of frames whose
        matter it has found; wrong: it leaves less of them, or a mistake in the scan explains held-out frames better."""
        if self.excess[0] > self.limit or (self.cause is not None and self.cause.choice != NULL):
            return "wrong"
        return "consistent" if self.explained.good else "limited"

    def lines(self) -> list[str]:
        """The verdict and the intervals, as lines of text."""
        return [self.said, *self._cause_lines(), *self.intervals()]

    @property
    def said(self) -> str:
        """The verdict and the number that decided, in a line."""
        (over, band), found = self.excess, self.explained
        low, high = 1e6 * found.periods[band]
        at = f"at periods above {low:.3g} µm" if math.isinf(high) else f"at periods of {low:.3g} to {high:.3g} µm"
        number = f"the residual {at} is {two_digits(over)} times what they leave or noise and model allow; 95 % of "
        number += f"{factors()[RESIDUAL].scenes} right runs on simulated scenes stay below {two_digits(self.limit)}"
        why = {
            "consistent": "the frames are explained",
            "limited": "this method leaves as much of simulated frames of its own result; more views, or another "
            "method, may do better",
            "wrong": "this method would explain the frames better if metadata and material were right",
        }[self.word]
        many, pixel = len(self.runs), 1e6 * self.pixel
        return f"verdict by {many} rehearsals on pixels of {pixel:.3g} µm: {self.word}: {why} ({number})"

    def _cause_lines(self) -> list[str]:
        if self.cause is None:
            return []
        if self.cause.choice == NULL:
            return [f"  No mistake that was tried predicts held-out frames better ({self.cause.line})."]
        step = next_step(self.cause.choice)
        return [f"  Likely cause: {self.cause.line}", *([f"  Next: {step.why} {step.command}"] if step else [])]

    def intervals(self) -> list[str]:
        """What the intervals are of, and a line for each quantity."""
        ends = {name: self.interval(name) for name in (*SIGNED, *SIZES, "resolution")}
        scenes = min(each.scenes for each in factors().values())
        level = min(LEVEL, scenes / (scenes + 1))  # the largest of few scores stands for their quantile
        lines = [f"intervals of {level:.0%}, by {len(self.runs)} rehearsals and {scenes} simulated scenes:"]
        if self.total is not None:
            low, high = (self.total / (1 + end) if end > -1 else math.inf for end in reversed(ends["total"]))
            said = f"{low:.3g} to {high:.3g} m³ {self._told('total')}"
            lines.append(f"total {self.quantity} {self.total:.3g} m³: {said}")
        for name, said in (("delta", f"mean {self.quantity} in the matter"), ("volume", "volume of the matter")):
            low, high = (in_percent(abs(end)) for end in ends[name])
            lines.append(f"{said}: up to {low} too low or {high} too high {self._told(name)}")
        lengths = [2e6 * self.pixel * max(1.0, math.exp(end)) for end in ends["resolution"]]
        return [
            *lines,
            f"Dice: at least {max(0.0, 1 - ends['dice'][1]):.2f} (rehearsals: {1 - self.values('dice').mean():.2f})",
            f"relative error of {self.quantity}: at most {ends['error'][1]:.2f} (rehearsals: "
            f"{self.values('error').mean():.2f})",
            f"centre of mass: within {1e6 * ends['centre'][1] * self.pixel:.2g} µm",
            f"resolution: {lengths[0]:.3g} to {lengths[1]:.3g} µm (full period, half-bit)",
        ]

    def _told(self, name: str) -> str:
        values = self.values(name)
        return f"(rehearsals: {values.mean():+.1%} ± {values.std(ddof=1):.1%})"


def _plain(value: Any) -> Any:
    return (
        [float(one) for one in value] if isinstance(value, list) else value if isinstance(value, str) else float(value)
    )


def rehearse(
    done: Reconstruction,
    scan: Scan,
    prior: MaterialPrior,
    method: Method = Auto(),
    *,
    times: int = 8,
    bins: int | None = None,
    seed: int = 0,
    causes: bool = True,
    folder: RunFolder | None = None,
    on_progress: Progress = lambda stage, fraction: None,
) -> Rehearsal:
    """Simulate the training frames of a result, reconstruct them in the same way, and compare: `times` times.

    done: a run of one time; scan: its frames, as `done.placed` gives them; prior, method, seed: of the run
    bins: pixels joined along an edge (default: to about `SIDE` pixels); of joined pixels the measured frames are
    reconstructed, too
    causes: whether mistakes in the scan are compared on held-out frames (`next_step`) if the residual is more than the
    rehearsals leave
    folder: of the run, whose summary.json keeps each rehearsal, so that a later call makes those that are missing

    Frames have noise of the measured ones' power, and their light. They are simulated on a raster of their own, several
    times finer than that of fits, in plain torch; line integrals are those of the result's own representation.
    Rehearsals take decisions on matter and light, poses and distances for exact. Errors: `InputError` for results in
    motion, without matter or verdict, and for fewer than 2 rehearsals.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> prior, method = hs.MaterialPrior.known(water), hs.methods.METHODS["holographic-tv"]
        >>> run = hs.reconstruct(scan, prior, method)
        >>> shown = hs.workflows.rehearse(run, scan, prior, method, times=2)
        >>> shown.word, len(shown.runs)
        ('consistent', 2)
    """
    require(times >= FEWEST, f"times must be {FEWEST} rehearsals or more, but it is {times}; a spread needs two.")
    require(
        not isinstance(done.object, InMotion) and done.verdict is not None,
        "rehearse takes a run of reconstruct, of matter at one time; this one moves or has no verdict.",
    )
    method = method.suited(done.choice.matter) if isinstance(method, Auto) else method
    bins = max(1, min(scan.views.shape) // SIDE) if bins is None else bins
    require(bins >= 1, f"bins must be 1 pixel or more, but it is {bins}.")
    coarse = scan.binned(bins)
    again = Again(prior, method, seed, done)
    truth = done.object.voxelise(Grid.of_views(coarse.views))
    require(bool(truth.delta.any()), "a run must have found matter to be rehearsed, but its volume is empty.")
    kept = None if folder is None else read_rehearsal(folder)
    if kept is None or kept.binned != bins:
        on_progress("measured frames on larger pixels", 0.0)
        judged = done if bins == 1 else again(coarse)
        assert judged.verdict is not None
        stated, quantity = (None, "δ") if done.total is None else (done.total.value, done.total.quantity)
        kept = Rehearsal(bins, coarse.views.finest, judged.verdict, (), stated, quantity)
    quiet, noise, factor = _frames(done, coarse)
    while len(kept.runs) < times:
        number = len(kept.runs)
        on_progress(f"rehearsal {number + 1} of {times}", number / times)
        drawn = quiet * factor + noise.drawn(seed + number).numpy() * np.sqrt(np.clip(quiet, 0, None))
        found = again(replace(coarse.train(), frames=drawn.astype(np.float32)), number + 1)
        assert found.verdict is not None
        run = errors_of(found, truth) | {
            RESIDUAL: residual_by_band(found.verdict).tolist(),
            "cause": found.verdict.cause,
        }
        kept = replace(kept, runs=(*kept.runs, run))
        _keep(folder, kept)
    if causes and kept.cause is None and kept.doubtful:
        kept = replace(kept, cause=compare_causes(coarse, again, on_progress))
        _keep(folder, kept)
    on_progress("rehearsals", 1.0)
    return kept


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
        how = {"prior": self.prior, "method": self.method, "light": light, "matter": done.choice.matter}
        return reconstruct(scan, seed=self.seed + further, **(how | changed))


def _frames(done: Reconstruction, coarse: Scan) -> tuple[np.ndarray, NoiseModel, np.ndarray]:
    """Training frames [V, H, W] of a result without light and noise; noise and light of the measured ones."""
    train = coarse.train()
    lit = light_of(train, done.light, done.still)
    noise = NoiseModel.of_frames(train.measured) if lit is None else lit.noise
    factor = np.ones((1, 1, 1)) if lit is None else lit.factor().numpy()
    with torch.no_grad():
        frames = np.stack(list(simulated_frames(done.object, train.exposures, Simulation())))
    return frames, noise, factor


def read_rehearsal(folder: RunFolder) -> Rehearsal | None:
    """The rehearsals in the summary.json of a run; None where none was made."""
    if not folder.summary.is_file():
        return None
    with as_written(folder.summary, "what rehearse wrote"):
        table = folder.read_summary().get(ENTRY)
        return None if table is None else Rehearsal.from_dict(table)


def _keep(folder: RunFolder | None, kept: Rehearsal) -> None:
    if folder is not None:
        folder.write_summary(folder.read_summary() | {ENTRY: kept.as_dict()})
