"""The thesis' configurations and schedule, in our units.

What the thesis says in its own units is translated here, and nowhere else: its scene is normalised to the cube
[-1, 1]³, taken to span the detector's width, so a length of 1 is half the width in pixels. Rates of log-scales and
quaternions have no unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from holosplat.checks import InputError, require
from holosplat.fit.density import DensityControl
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.methods import FitOptions
from holosplat.methods.gaussian_options import GaussianRates
from holosplat.methods.presets import preset
from holosplat.ranges import Natural, checked_dataclass
from holosplat.scan import Scan
from holosplat.volume import Object, Volume

from ..declaration import Case


@checked_dataclass
class Physics:
    """What differs from the case as it is declared; None for nothing.

    distance: of propagation [m]; psf_sigma_px: of the point-spread function [detector pixels]; photons: a pixel of the
    frames for training.
    """

    distance: float | None = None
    psf_sigma_px: float | None = None
    photons: float | None = None

    def of(self, case: Case) -> Case:
        """The case in this physics."""
        given = {"distance": self.distance, "psf_sigma_px": self.psf_sigma_px}
        changed = {name: np.asarray(value) for name, value in given.items() if value is not None}
        photons = case.photons if self.photons is None else self.photons
        return replace(case, exposures=replace(case.exposures, **changed), photons=photons)


PHYSICS = {
    "declared": Physics(),
    "contact": Physics(distance=0.0),
    "far": Physics(distance=0.5),
    "blurred": Physics(psf_sigma_px=0.5),
    "noisy": Physics(photons=2000.0),
}
"""The case as declared (10 cm, a sharp detector, no noise), and four that differ in one thing each: absorption alone,
five times the distance, a point-spread function ten times as wide, 2000 photons a pixel."""


@dataclass(frozen=True)
class Measured:
    """A case, measured once for all configurations: its name and that of its physics, frames, true scene and volume."""

    case: str
    physics: str
    scan: Scan
    scene: Object
    truth: Volume

    @classmethod
    def of(cls, case: Case, physics: str = "declared") -> Measured:
        """Simulate the case and voxelise its truth; `InputError` for unknown physics."""
        if physics not in PHYSICS:
            raise InputError(f"physics must be one of {', '.join(PHYSICS)}, but it is {physics!r}.")
        taken = PHYSICS[physics].of(case)
        return cls(case.name, physics, taken.scan(), taken.scene, taken.truth())


def mean_inside(volume: Volume, truth: Volume) -> tuple[float, float]:
    """Means (δ, β) of `volume` inside the matter of `truth`, weighted by the true δ of each voxel."""
    weight = truth.delta.astype(np.float64) / float(np.sum(truth.delta, dtype=np.float64))
    return float(np.sum(weight * volume.delta)), float(np.sum(weight * volume.beta))


LOOK_EVERY = 400
"""Steps of the full schedule between two looks; every fifth falls on a densification, and shows its shock."""
VOLUME_TV, VOLUME_EDGE = 0.05, 32
"""Weight of the total variation of the volume, and the edge [voxels] of the random block that a step looks at, where it
stands for that of the frames: those of Zha et al. 2024 (R²-Gaussian)."""


@checked_dataclass
class Configuration:
    """A configuration in the thesis' units.

    name: in tables and files
    count: Gaussians of the random start
    views: frames a step
    position_rate: of the centres [half widths of the field a step]
    shape_rate: of log-scales and quaternions
    amplitude_rate: of density, δ and β before softplus; the thesis does not say
    threshold: mean gradient of the loss [per half width] above which a Gaussian is cloned or split; the thesis does
        not say, and 2e-4 is what Kerbl et al. 2023 have
    faint: density, as a share of the start's, below which a Gaussian is removed; the thesis does not say
    variation: what total variation is taken of; the thesis does not say
    all_learn: frames whose loss exceeds the batch's median learn, too, which is not the thesis' rule
    one_unit: δ and β start in one and the same unit, instead of water's δ and β each
    """

    name: str
    count: Natural = 8_000
    views: Natural = 4
    position_rate: float = 1.6e-4
    shape_rate: float = 1e-3
    amplitude_rate: float = 0.01
    threshold: float = 2e-4
    faint: float = 0.2
    variation: Literal["frames", "volume"] = "frames"
    all_learn: bool = False
    one_unit: bool = False


THESIS_TABLE = (
    Configuration("8k-v1", views=1),
    Configuration("8k-v4"),
    Configuration("8k-v8", views=8),
    Configuration("32k-v4", 32_000),
    Configuration("98k-v4", 98_000),
    Configuration("244k-v4", 244_000),
    Configuration("8k-v4-position", position_rate=3.2e-4),
    Configuration("8k-v4-shape", shape_rate=2e-3),
)
"""The eight of the thesis' Table 2."""

BESIDE = (
    Configuration("8k-v2", views=2),
    Configuration("8k-v4-position-half", position_rate=0.8e-4),
    Configuration("8k-v4-shape-half", shape_rate=0.5e-3),
    Configuration("8k-v4-both", position_rate=3.2e-4, shape_rate=2e-3),
)
"""What the thesis tried beside them."""

DECLARED = (
    Configuration("8k-v4-amplitude", amplitude_rate=0.05),
    Configuration("8k-v4-volume-tv", variation="volume"),
    Configuration("8k-v4-threshold", threshold=5e-5),
    Configuration("8k-v4-faint", faint=0.5),
)
"""The second value of each number that the thesis does not state; the first is that of `8k-v4`."""

EXTRA = (
    Configuration("8k-v4-all-learn", all_learn=True),
    Configuration("8k-v4-one-unit", one_unit=True),
)
"""Ours, to ask why."""

EVERY = (*THESIS_TABLE, *BESIDE, *DECLARED, *EXTRA)


def configurations(names: Sequence[str] = ()) -> tuple[Configuration, ...]:
    """The configurations called `names`, or the thesis' eight; `InputError` listing the names for an unknown one."""
    table = {c.name: c for c in EVERY}
    for name in names:
        require(name in table, f"a configuration must be one of {', '.join(table)}, but it is {name!r}.")
    return tuple(table[name] for name in dict.fromkeys(names)) or THESIS_TABLE


@dataclass(frozen=True)
class Recipe:
    """How a configuration is fitted. raw_densities: the rate of the densities before softplus."""

    fit: FitOptions
    raw_densities: float

    def rates(self, factor: float, step: int) -> dict[str, float]:
        """The rate of each parameter at `step`, of which `factor` is left: until the warm-up is over only density, δ
        and β move."""
        moving = step >= self.fit.schedule.warmup_steps
        return {**self.fit.rates.at(factor, moving), "object.raw_densities": self.raw_densities * factor}


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

    def recipe(self, configuration: Configuration, width_px: int, start_density: float) -> Recipe:
        """How `configuration` is fitted to frames `width_px` wide from Gaussians of density `start_density`: the preset
        `thesis` at this pace, no frame taken to judge."""
        fit = replace(
            preset("thesis").fit,
            objective=_objective(configuration),
            schedule=self._schedule(configuration),
            rates=_rates(configuration, 0.5 * width_px),
            density=self._density(configuration, 0.5 * width_px, start_density),
        )
        return Recipe(fit, configuration.amplitude_rate)

    def _schedule(self, configuration: Configuration) -> Schedule:
        thesis = preset("thesis").fit.schedule
        return replace(
            thesis,
            steps=max(1, thesis.steps // self.shortened),
            warmup_steps=thesis.warmup_steps // self.shortened,
            views_per_step=configuration.views,
            volume_edge=VOLUME_EDGE,
            detach_worst=thesis.detach_worst and not configuration.all_learn,
            validation_views=0,
        )

    def _density(self, configuration: Configuration, half_width: float, start_density: float) -> DensityControl:
        thesis = preset("thesis").fit.density
        return replace(
            thesis,
            every=max(1, thesis.every // self.shortened),
            grow_gradient=configuration.threshold / half_width,
            faint=configuration.faint * start_density,
        )


def _objective(configuration: Configuration) -> Objective:
    thesis = preset("thesis").fit.objective
    if configuration.variation == "frames":
        return thesis
    return replace(thesis, tv_image=0.0, tv_volume=VOLUME_TV)


def _rates(configuration: Configuration, half_width: float) -> GaussianRates:
    return GaussianRates(
        centres=configuration.position_rate * half_width,
        log_scales=configuration.shape_rate,
        quaternions=configuration.shape_rate,
        raw_amplitudes=configuration.amplitude_rate,
    )


PACES = {pace.name: pace for pace in (Pace("full", 1), Pace("third", 3), Pace("short", 10))}
