"""The thesis' study, rerun: its eight configurations, its schedule and loss, and curves of every score over steps.

What the thesis says in its own units is translated here, and nowhere else: its scene is normalised to the cube
[-1, 1]³, taken to span the detector's width, so a length of 1 is half the width in pixels. Rates of log-scales and
quaternions have no unit.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..backends import resolve
from ..bench.case import Case
from ..bench.record import source_commit
from ..checks import InputError, require
from ..fit.loop import DivergedError, Fit
from ..geometry import Grid, Views
from ..io.atomic import atomic_path
from ..io.folder import require_new
from ..io.json import read_json, write_json
from ..materials import WATER
from ..matter import Matter
from ..methods import FitOptions, finished, gaussian_fit
from ..methods.presets import preset
from ..progress import FitProgress
from ..representations.gaussians import GaussianCloud, raw_of
from ..scan import Scan
from ..volume import Volume
from ..workflows.evaluate import score_object
from ..workflows.provenance import environment, scan_hash

START_DENSITY = 0.01
"""Density of the random start, in units of water: about what 16 cells fill of their channel."""
LOOK_EVERY = 400
"""Steps of the full schedule between two looks; every fifth falls on a densification, and shows its shock."""
CURVES = (
    *("step", "seconds", "count"),
    *(f"{split}_{score}" for split in ("test", "train") for score in ("ssim", "frcm", "psnr", "l1")),
    *("dice", "relative_error_delta", "mean_delta", "mean_beta", "ratio"),
)
"""Columns of a configuration's curves: δ, β and δ/β are means inside the true cells, weighted by true matter."""


@dataclass(frozen=True)
class Configuration:
    """A row of the thesis' Table 2, in the thesis' units.

    count: Gaussians of the random start; views: frames a step; position_rate: in half widths of the field a step;
    shape_rate: of log-scales and quaternions. Not the thesis': all_learn, where views whose loss exceeds the batch's
    median learn, too; one_unit, where δ and β start in one and the same unit, instead of water's δ and β each.
    """

    name: str
    count: int
    views: int = 4
    position_rate: float = 1.6e-4
    shape_rate: float = 1e-3
    all_learn: bool = False
    one_unit: bool = False


THESIS_TABLE = (
    Configuration("8k-v1", 8_000, views=1),
    Configuration("8k-v4", 8_000),
    Configuration("8k-v8", 8_000, views=8),
    Configuration("32k-v4", 32_000),
    Configuration("98k-v4", 98_000),
    Configuration("244k-v4", 244_000),
    Configuration("8k-v4-position", 8_000, position_rate=3.2e-4),
    Configuration("8k-v4-shape", 8_000, shape_rate=2e-3),
)
"""The thesis' eight configurations."""

EXTRA = (
    Configuration("8k-v4-all-learn", 8_000, all_learn=True),
    Configuration("8k-v4-one-unit", 8_000, one_unit=True),
)
"""Ours beside them, to ask why; run when they are asked for by name."""


@dataclass(frozen=True)
class Pace:
    """The thesis' schedule with all its steps divided by `shortened`."""

    name: str
    shortened: int

    def __post_init__(self) -> None:
        require(self.shortened >= 1, f"shortened must be at least 1, but it is {self.shortened}.")

    @property
    def look_every(self) -> int:
        """Steps between two looks at the held-out frames."""
        return max(1, LOOK_EVERY // self.shortened)

    def options(self, configuration: Configuration, width_px: int) -> FitOptions:
        """What the fit does, for frames `width_px` wide: the preset `thesis` at this pace, no frame taken to judge."""
        thesis = preset("thesis").fit
        schedule = replace(
            thesis.schedule,
            steps=max(1, thesis.schedule.steps // self.shortened),
            warmup_steps=thesis.schedule.warmup_steps // self.shortened,
            views_per_step=configuration.views,
            detach_worst=thesis.schedule.detach_worst and not configuration.all_learn,
            validation_views=0,
        )
        rates = replace(
            thesis.rates,
            centres=configuration.position_rate * 0.5 * width_px,
            log_scales=configuration.shape_rate,
            quaternions=configuration.shape_rate,
        )
        density = replace(thesis.density, every=max(1, thesis.density.every // self.shortened))
        return replace(thesis, schedule=schedule, rates=rates, density=density)


PACES = {pace.name: pace for pace in (Pace("full", 1), Pace("short", 10))}


@dataclass(frozen=True)
class Measured:
    """A case, measured once for all configurations: its name, frames, and true volume."""

    case: str
    scan: Scan
    truth: Volume

    @classmethod
    def of(cls, case: Case) -> Measured:
        """Simulate the case and voxelise its truth."""
        return cls(case.name, case.scan(), case.truth())


def configurations(names: Sequence[str] = ()) -> tuple[Configuration, ...]:
    """The configurations called `names`, or the thesis' eight; `InputError` listing the names for an unknown one."""
    table = {c.name: c for c in (*THESIS_TABLE, *EXTRA)}
    for name in names:
        require(name in table, f"a configuration must be one of {', '.join(table)}, but it is {name!r}.")
    return tuple(table[name] for name in dict.fromkeys(names)) or THESIS_TABLE


class StudyFolder:
    """study.json, and NAME.config.json, NAME.curves.csv and NAME.row.json of each configuration.

    The row is written last: where there is one, the configuration is finished.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.about = self.path / "study.json"

    def begin(self, about: Mapping[str, Any]) -> None:
        """Make the folder, or go on in it; `InputError` if it is something else's, or another study's."""
        if self.about.is_file():
            old = read_json(self.about)
            for key in ("case", "pace", "seed", "scan_hash"):
                same = old.get(key) == about[key]
                require(same, f"the study in {self.path} has another {key.replace('_', ' ')}; choose another --out.")
            return
        require_new(self.path, "choose another --out, or a study to go on with")
        self.path.mkdir(exist_ok=True)
        write_json(self.about, dict(about))

    def finished(self, name: str) -> bool:
        """Whether the configuration `name` is done."""
        return self._file(name, "row.json").is_file()

    def write_config(self, name: str, values: dict[str, Any]) -> None:
        """NAME.config.json."""
        write_json(self._file(name, "config.json"), values)

    def write_row(self, name: str, values: dict[str, Any]) -> None:
        """NAME.row.json: the configuration is done."""
        write_json(self._file(name, "row.json"), values)

    def write_curves(self, name: str, looks: Sequence[Mapping[str, float]]) -> None:
        """NAME.curves.csv, of everything seen so far."""
        with atomic_path(self._file(name, "curves.csv")) as temporary, temporary.open("w", newline="") as file:
            table = csv.DictWriter(file, CURVES, lineterminator="\n")
            table.writeheader()
            table.writerows({key: f"{look[key]:.6g}" for key in CURVES} for look in looks)

    def curves(self, name: str) -> dict[str, np.ndarray]:
        """The columns of NAME.curves.csv, float64."""
        path = self._file(name, "curves.csv")
        try:
            with path.open(newline="") as file:
                rows = list(csv.DictReader(file))
            return {key: np.array([float(row[key]) for row in rows]) for key in CURVES}
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path} must hold a study's curves, but it does not: {error!r}; run it again.") from error

    def row(self, name: str) -> dict[str, Any]:
        """What NAME.row.json holds."""
        return read_json(self._file(name, "row.json"))

    def _file(self, name: str, kind: str) -> Path:
        return self.path / f"{name}.{kind}"


@dataclass(frozen=True)
class Study:
    """A study as far as it is done: what study.json says, and rows and curves by configuration, in the thesis' order.

    rows: what NAME.row.json holds; curves: columns `CURVES` [looks].
    """

    about: dict[str, Any]
    rows: dict[str, dict[str, Any]]
    curves: dict[str, dict[str, np.ndarray]]


def load_study(folder: StudyFolder) -> Study:
    """All finished configurations of `folder`; `InputError` if there is none."""
    names = [c.name for c in (*THESIS_TABLE, *EXTRA) if folder.finished(c.name)]
    require(len(names) > 0, f"{folder.path} must hold a finished configuration of the study, but it holds none.")
    return Study(read_json(folder.about), {n: folder.row(n) for n in names}, {n: folder.curves(n) for n in names})


def run_study(
    measured: Measured,
    chosen: Sequence[Configuration],
    pace: Pace,
    seed: int,
    folder: StudyFolder,
    on_progress: FitProgress = lambda name, fraction, record: None,
) -> None:
    """Run what is not finished yet of the `chosen` configurations, one after the other.

    Ctrl-C (KeyboardInterrupt) is passed on; what is finished stays, and the next call goes on behind it.
    """
    about = {
        "case": measured.case,
        "pace": asdict(pace),
        "warmup_steps": pace.options(THESIS_TABLE[0], 1).schedule.warmup_steps,
        "seed": seed,
        "scan_hash": scan_hash(measured.scan),
        "frames": list(measured.scan.frames.shape),
        "pixel_size_m": measured.scan.views.pixel_size,
        "held_out": int(measured.scan.is_test.sum()),
        **dict(zip(("true_delta", "true_beta"), mean_inside(measured.truth, measured.truth))),
    }
    folder.begin(about | environment(resolve("auto")) | {"commit": source_commit()})
    for configuration in chosen:
        if not folder.finished(configuration.name):
            run_configuration(measured, configuration, pace, seed, folder, on_progress)


def run_configuration(
    measured: Measured,
    configuration: Configuration,
    pace: Pace,
    seed: int,
    folder: StudyFolder,
    on_progress: FitProgress = lambda name, fraction, record: None,
) -> None:
    """Fit one configuration to the training frames, look at the held-out ones on the way, and write all of it.

    The looks judge only: nothing is chosen or stopped by them. A fit that diverges is a result, and said so.
    """
    name, train = configuration.name, measured.scan.train()
    options = pace.options(configuration, train.views.shape[1])
    folder.write_config(name, {"configuration": asdict(configuration), "seed": seed, "fit": asdict(options)})
    energy = train.exposures.one_energy("the thesis' study")
    cloud = random_start(configuration, train.views, energy, seed)
    fit, looks, diverged = gaussian_fit(train, cloud, options, seed), [], None
    looks.append(_look(fit, measured))
    try:
        while not fit.finished:
            fit.run(
                lambda record: on_progress(name, fit.step / options.schedule.steps, record),
                until=fit.step + pace.look_every,
            )
            looks.append(_look(fit, measured))
            folder.write_curves(name, looks)
    except DivergedError as error:
        diverged = error.step
    folder.write_curves(name, looks)
    folder.write_row(name, _row(configuration, fit, looks, diverged))


def random_start(configuration: Configuration, views: Views, energy_kev: float, seed: int) -> GaussianCloud:
    """Two-channel Gaussians at uniformly random places of the field of view's box, all alike, and faint.

    Their size is half the mean distance between neighbours. Amplitudes are in units of water's δ and β.
    """
    grid, count = Grid.of_views(views), configuration.count
    generator = torch.Generator().manual_seed(seed)
    extent = torch.tensor([float(n) for n in grid.shape[::-1]])
    middle = torch.from_numpy(grid.centre / views.pixel_size).float()
    centres = (torch.rand(count, 3, generator=generator) - 0.5) * extent + middle
    sigma = 0.5 * (float(extent.prod()) / count) ** (1 / 3)
    peak = START_DENSITY * float(extent.prod()) / count / ((2 * np.pi) ** 1.5 * sigma**3)
    parameters = (
        centres,
        torch.full((count, 3), float(np.log(sigma))),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        raw_of(torch.full((count, 2), peak)),
    )
    water = WATER.delta_beta(energy_kev)
    matter = Matter.free(water.delta, water.delta if configuration.one_unit else water.beta)
    return GaussianCloud(parameters, views.pixel_size, matter)


def mean_inside(volume: Volume, truth: Volume) -> tuple[float, float]:
    """Means (δ, β) of `volume` inside the matter of `truth`, weighted by the true δ of each voxel."""
    weight = truth.delta.astype(np.float64) / float(np.sum(truth.delta, dtype=np.float64))
    return float(np.sum(weight * volume.delta)), float(np.sum(weight * volume.beta))


def _look(fit: Fit, measured: Measured) -> dict[str, float]:
    """All scores of the cloud as it is now."""
    cloud = finished(fit)
    assert isinstance(cloud, GaussianCloud)
    scores = score_object(cloud, measured.scan, measured.truth, fit.model.instrument.oversample)
    assert scores.test is not None
    assert scores.train is not None
    assert scores.volume is not None
    delta, beta = mean_inside(cloud.voxelise(measured.truth.grid), measured.truth)
    return {
        "step": fit.step,
        "seconds": fit.seconds,
        "count": len(cloud),
        **{f"test_{score}": value for score, value in scores.test.mean.items()},
        **{f"train_{score}": value for score, value in scores.train.mean.items()},
        "dice": scores.volume.dice,
        "relative_error_delta": scores.volume.relative_error_delta,
        "mean_delta": delta,
        "mean_beta": beta,
        "ratio": delta / beta if beta > 0 else float("inf"),
    }


def _row(
    configuration: Configuration, fit: Fit, looks: Sequence[Mapping[str, float]], diverged: int | None
) -> dict[str, Any]:
    """The final row: the last look, and what it took; `diverged_at` is the step where the fit broke down, or None."""
    last = {key: float(f"{looks[-1][key]:.6g}") for key in CURVES}
    return {
        "configuration": asdict(configuration),
        "status": "done" if diverged is None else "diverged",
        "diverged_at": diverged,
        "steps": fit.step,
        "seconds": fit.seconds,
        "last": {key: value if np.isfinite(value) else None for key, value in last.items()},
    }
