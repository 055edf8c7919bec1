"""Rehearsal: frames of a result are simulated and reconstructed in the same way, which shows bias and spread of each
number, and the residual that the method leaves of frames whose matter it has found (a parametric bootstrap; Efron &
Tibshirani 1993, chapter 6). In each the views stand at other angles about the result, so that it has parts that they do
not show (equivariant bootstrap; Tachella & Pereyra 2024, AISTATS)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from ..beamline.simulate import simulate
from ..checks import InputError, as_written, require
from ..geometry import Grid
from ..inference import Decision
from ..io.volumes import read_volume, write_volume
from ..matter import MaterialPrior
from ..methods import Auto, Method
from ..methods.continued import Continued
from ..metrics import robust_material_delta
from ..progress import Progress
from ..representations import InMotion
from ..scan import Exposures, Scan
from ..units import in_percent, two_digits
from ..volume import Object, Volume
from .certainty import (
    LEVEL,
    NULL,
    SIGNED,
    SIZES,
    Again,
    as_uncertain,
    compare_causes,
    doubts_of,
    drawn_frames,
    errors_of,
    factors,
    scale_of,
    true_sizes,
    turned_by,
)
from .evaluate import of_absorption
from .matter_map import MATTER, VOXELS, MatterMap, matter_probabilities, occupancy_counts
from .next_step import next_step
from .reconstruct import reconstruct
from .reconstruction import Reconstruction
from .run_folder import RunFolder
from .verdict import Verdict

SIDE = 48
"""Pixels along the shorter side of the frames of a rehearsal, about: a reconstruction then takes seconds."""
FEWEST = 2
"""Rehearsals that have a spread."""
ENTRY = "rehearsal"
"""The entry of summary.json."""
FOUND = "rehearsed.h5"
"""The volume of the measured frames at the pixels of the rehearsals, in the run folder."""
RESIDUAL = "residual"
Word = Literal["consistent", "limited", "wrong"]


def residual_by_band(found: Verdict) -> np.ndarray:
    """[B] root mean squares of the residual over all views."""
    return np.sqrt(np.square(found.residual).mean(axis=0))


@dataclass(frozen=True)
class Rehearsal:
    """What rehearsals of a run show.

    binned: pixels of the frames along an edge of one in a rehearsal; pixel: that edge [m]
    explained: the verdict on the measured frames at these pixels, reconstructed likewise
    runs: [K] tables of `errors_of` and `occupancy_counts`, the `residual` [B] and the likely `cause` of each rehearsal
    unit: the δ, or without δ the β, of the material in the rehearsals; found: what the measured frames gave at these
    pixels, with β in place of an unknown δ; None if it was not kept
    total: that the run states [m³], None for none; quantity: of which index
    cause: between the metadata as given, the null, and mistakes in them; None where the residual gave no reason
    doubts: standard errors, as shares, of what rehearsals do not show (`doubts_of`), by quantity
    """

    binned: int
    pixel: float
    explained: Verdict
    runs: tuple[Mapping[str, Any], ...]
    unit: float = 1.0
    found: Volume | None = None
    total: float | None = None
    quantity: str = "δ"
    cause: Decision | None = None
    doubts: Mapping[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON, with what they say; `from_dict` reads them."""
        plain = {"binned": self.binned, "pixel_m": self.pixel, "unit": self.unit}
        plain |= {"explained": self.explained.as_dict()}
        plain |= {"runs": list(self.runs), "total_m3": self.total, "quantity": self.quantity}
        plain |= {"cause": self.cause and self.cause.as_dict(), "doubts": dict(self.doubts)}
        if len(self.runs) < FEWEST:
            return plain
        said = {name: list(self.interval(name)) for name in (*SIGNED, *SIZES)}
        return plain | {"word": self.word, "intervals_of_errors": said, "words": self.lines()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], found: Volume | None = None) -> Rehearsal:
        """What `as_dict` described, beside the volume that was `found`; `InputError` for anything else."""
        with as_written("a rehearsal", "what rehearse wrote"):
            total, cause = values["total_m3"], values["cause"]
            return cls(
                int(values["binned"]),
                float(values["pixel_m"]),
                Verdict.from_dict(values["explained"]),
                tuple({name: _plain(value) for name, value in run.items()} for run in values["runs"]),
                float(values["unit"]),
                found,
                None if total is None else float(total),
                str(values["quantity"]),
                None if cause is None else Decision.from_dict(cause),
                {name: float(value) for name, value in values.get("doubts", {}).items()},
            )

    def values(self, name: str) -> np.ndarray:
        """A quantity in all rehearsals, [K] or [K, B]."""
        return np.array([run[name] for run in self.runs], dtype=np.float64)

    def interval(self, name: str) -> tuple[float, float]:
        """Ends of the interval of a quantity's error; that of a size begins at 0."""
        scale = max(scale_of(name, self.values(name)), self.doubts.get(name, 0.0))
        reach = factors()[name].reach(scale, self.excess[0])
        return 0.0 if name in SIZES else -reach, reach

    @property
    def total_ends(self) -> tuple[float, float]:
        """Ends of the interval of the total [m³], the smaller size first; nan where the run states none."""
        sign = math.copysign(1.0, self.unit)
        low, high = true_sizes(sign * (math.nan if self.total is None else self.total), *self.interval("total"))
        return sign * low, sign * high

    @property
    def least_dice(self) -> float:
        """The lower bound of Dice."""
        return max(0.0, 1 - self.interval("dice")[1])

    @property
    def matter(self) -> MatterMap:
        """Where matter is likely; `InputError` where what was found is not kept."""
        if self.found is None:
            raise InputError("a map of matter needs the volume that was rehearsed, but it is not kept; rehearse again.")
        voxels, matter = (self.values(name).sum(axis=0) for name in (VOXELS, MATTER))
        return MatterMap(self.found, self.unit, matter_probabilities(voxels, matter))

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
        """Whether the frames are not explained, or leave more than this method does: rehearsals of wrong metadata have
        them, too, and may leave as much."""
        return self.excess[0] > self.limit or not self.explained.good

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
        ends = {name: self.interval(name) for name in (*SIGNED, *SIZES)}
        scenes = min(each.scenes for each in factors().values())
        level = min(LEVEL, scenes / (scenes + 1))  # the largest of few scores stands for their quantile
        lines = [
            f"intervals of {level:.0%}, by {len(self.runs)} rehearsals and {scenes} simulated scenes, on pixels of "
        ]
        lines[0] += f"{1e6 * self.pixel:.3g} µm:"
        if self.total is not None:
            low, high = self.total_ends
            said = f"{low:.3g} m³ or more in size" if math.isinf(high) else f"{low:.3g} to {high:.3g} m³"
            lines.append(f"total {self.quantity} {self.total:.3g} m³: {said} {self._told('total')}")
        named = [("total", f"total {self.quantity}")] if self.total is None else []
        named += [("delta", f"mean {self.quantity} in the matter"), ("volume", "volume of the matter")]
        for name, said in named:
            low, high = (in_percent(end) for end in (min(1.0, -ends[name][0]), ends[name][1]))
            lines.append(f"{said}: up to {low} too low or {high} too high {self._told(name)}")
        expected = "" if self.found is None else f"; expected by the map of matter: {self.matter.expected_dice:.2f}"
        widest = math.inf if self.found is None else max(self.found.grid.shape) / 2
        finest, coarsest = (2e6 * self.pixel * size for size in (1, min(math.exp(ends["resolution"][1]), widest)))
        return [
            *lines,
            f"Dice: at least {self.least_dice:.2f} (rehearsals: {1 - self.values('dice').mean():.2f}{expected})",
            f"relative error of {self.quantity}: at most {ends['error'][1]:.2f} (rehearsals: "
            f"{self.values('error').mean():.2f})",
            f"centre of mass: within {1e6 * ends['centre'][1] * self.pixel:.2g} µm",
            f"resolution: at worst {coarsest:.3g} µm (full period, half-bit; these pixels allow {finest:.3g} µm)",
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
    causes: whether mistakes in the scan are compared on held-out frames (`certainty`) if the frames are not explained
    folder: of the run, whose summary.json keeps each rehearsal, so that a later call makes those that are missing

    Frames have noise of the measured ones' power, and their light. They are simulated on a raster of their own, several
    times finer than that of fits, in plain torch; line integrals are those of the result's own representation. All
    views are turned by one random angle about the result, which is as smooth as its own views leave it.
    What the run found of distance, energy and poses is drawn from its errors; what the scan gave of them, and decisions
    on matter and light, are taken for exact. Errors: `InputError` for results in motion, without matter or verdict, and
    for fewer than 2 rehearsals.

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
    method = method.afresh(done.object) if isinstance(method, Continued) else method  # its start knows the truth
    method = method.suited(done.choice.matter) if isinstance(method, Auto) else method
    bins = max(1, min(scan.views.shape) // SIDE) if bins is None else bins
    require(bins >= 1, f"bins must be 1 pixel or more, but it is {bins}.")
    coarse = scan.binned(bins)
    again = Again(prior, method, seed, done)
    grid = Grid.of_views(coarse.views)
    truth = done.object.voxelise(grid)
    require(bool(truth.delta.any()), "a run must have found matter to be rehearsed, but its volume is empty.")
    kept = None if folder is None else _kept(folder)
    if kept is None or kept.binned != bins or kept.found is None:
        on_progress("measured frames on larger pixels", 0.0)
        judged = done if bins == 1 else again(coarse)
        assert judged.verdict is not None
        stated, quantity = (None, "δ") if done.total is None else (done.total.value, done.total.quantity)
        told = _told(done, judged.object.voxelise(grid))
        unit = robust_material_delta(_told(done, truth))
        doubts = doubts_of(done, prior)
        kept = Rehearsal(bins, coarse.views.finest, judged.verdict, (), unit, told, stated, quantity, doubts=doubts)
        if folder is not None:  # what was there is of another volume
            folder.write_summary({name: said for name, said in folder.read_summary().items() if name != ENTRY})
            write_volume(folder.path / FOUND, told)
    train = coarse.train()
    while len(kept.runs) < times:
        number = len(kept.runs)
        on_progress(f"rehearsal {number + 1} of {times}", number / times)
        rng = np.random.default_rng([seed, number])
        turned = turned_by(train.exposures, rng.uniform(0, 360))
        drawn = drawn_frames(done, train, as_uncertain(done, turned, bins, rng), seed + number)
        found = again(replace(drawn, exposures=turned), number + 1)
        kept = replace(kept, runs=(*kept.runs, _shown_by(found, truth)))
        _keep(folder, kept)
    if causes and kept.cause is None and kept.doubtful:
        rehearsed = drawn_frames(done, coarse, coarse.exposures, seed)
        kept = replace(kept, cause=compare_causes(coarse, again, rehearsed, on_progress))
        _keep(folder, kept)
    on_progress("rehearsals", 1.0)
    return kept


def foresee(
    matter: Object,
    exposures: Exposures,
    photons: float,
    prior: MaterialPrior,
    method: Method,
    *,
    times: int = 8,
    on_progress: Progress = lambda stage, fraction: None,
) -> Rehearsal:
    """What rehearsals of an experiment show before it is made: the same as of a run, but with known `matter`, and
    frames of `photons` a pixel in even light. The verdict is that on the first of them. Errors: as of `rehearse`."""
    require(times >= FEWEST, f"times must be {FEWEST} rehearsals or more, but it is {times}; a spread needs two.")
    truth, all_train = matter.voxelise(Grid.of_views(exposures.views)), np.zeros(len(exposures), dtype=bool)
    verdicts, runs = list[Verdict](), list[Mapping[str, Any]]()
    for number in range(times):
        on_progress(f"rehearsal {number + 1} of {times}", number / times)
        turned = turned_by(exposures, np.random.default_rng([0, number]).uniform(0, 360))
        scan = simulate(matter, turned, photons_per_pixel=photons, seed=number, is_test=all_train)
        found = reconstruct(scan, prior, method, seed=number)
        assert found.verdict is not None
        verdicts.append(found.verdict)
        runs.append(_shown_by(found, truth))
    on_progress("rehearsals", 1.0)
    return Rehearsal(1, exposures.views.finest, verdicts[0], tuple(runs), robust_material_delta(truth))


def _shown_by(found: Reconstruction, truth: Volume) -> dict[str, Any]:
    """What a rehearsal shows of its `truth`."""
    assert found.verdict is not None
    counts = occupancy_counts(_told(found, found.object.voxelise(truth.grid)), _told(found, truth))
    residual = residual_by_band(found.verdict).tolist()
    return errors_of(found, truth) | counts | {RESIDUAL: residual, "cause": found.verdict.cause}


def _told(done: Reconstruction, volume: Volume) -> Volume:
    """A volume with β in place of δ if a run does not tell δ."""
    return volume if done.delta_told else of_absorption(volume)


def read_rehearsal(folder: RunFolder) -> Rehearsal | None:
    """The rehearsals in the summary.json of a run; None where fewer than two were made, which have no spread."""
    kept = _kept(folder)
    return None if kept is None or len(kept.runs) < FEWEST else kept


def _kept(folder: RunFolder) -> Rehearsal | None:
    if not folder.summary.is_file():
        return None
    with as_written(folder.summary, "what rehearse wrote"):
        table = folder.read_summary().get(ENTRY)
        if table is None:
            return None
        kept = folder.path / FOUND
        return Rehearsal.from_dict(table, read_volume(kept) if kept.is_file() else None)


def matter_of(folder: RunFolder) -> MatterMap | None:
    """Where rehearsals of a run say that matter is likely; None where none are kept."""
    kept = read_rehearsal(folder)
    return None if kept is None or kept.found is None else kept.matter


def _keep(folder: RunFolder | None, kept: Rehearsal) -> None:
    if folder is not None:
        folder.write_summary(folder.read_summary() | {ENTRY: kept.as_dict()})
