"""Options of the method of Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from ..backends import Backend
from ..baselines import HolographicTV
from ..baselines.material import MaterialEstimate
from ..baselines.two_materials import TwoMaterials
from ..fit.density import DensityControl
from ..fit.problem import Schedule
from ..fit.terms import Objective
from ..learning.start import LearnedStart
from ..ranges import Natural, Positive, Rate, Share, Weight, Within, checked_dataclass
from .coarse import CoarseToFine
from .ground import ExtraTerm


@checked_dataclass
class GaussianRates:
    """Adam's rates of the parameters at the start of a fit."""

    centres: Rate = 0.01
    """Of the centres [detector pixels]."""
    log_scales: Rate = 0.01
    """Of the logarithms of the axes."""
    quaternions: Rate = 0.01
    """Of the orientations."""
    raw_amplitudes: Rate = 0.01
    """Of the amplitudes before softplus."""

    def at(self, factor: float, moving: bool) -> Mapping[str, float]:
        """The rates by parameter, of which `factor` is left; only amplitudes move unless `moving`."""
        still = () if moving else ("centres", "log_scales", "quaternions")
        return {f"object.{name}": 0.0 if name in still else rate * factor for name, rate in vars(self).items()}


@dataclass(frozen=True)
class FitOptions:
    """What is minimised, how, where Gaussians come and go, and which backend does it (see `backends`)."""

    objective: Objective = field(
        default_factory=lambda: Objective(
            l1=1.0, tv_volume=0.25, overfull=10.0, two_levels=1.25, noise_gain=0.5, noise_width=1.0, coarse=1.0
        )
    )
    schedule: Schedule = field(default_factory=Schedule)
    rates: GaussianRates = field(default_factory=GaussianRates)
    density: DensityControl = field(default_factory=DensityControl)
    terms: tuple[ExtraTerm, ...] = ()
    """Further terms by name."""
    backend: Backend = "auto"
    """What computes the fit."""


@checked_dataclass
class GaussianOptions:
    """Options of Gaussians: their start, and their fit."""

    start: Literal["phase", "learned", "random"] = "phase"
    """`phase`: phase retrieval, total-variation tomography, Gaussians where there is matter; `learned`: the same where
    a network guesses it, if that explains the frames clearly better; or `random`."""
    spacing_px: Positive = 1.0
    """Distance between Gaussians at a phase start [pixels]."""
    spacing_noise: Weight = 2.3
    """What it grows by, as a share, for the share of the frames' contrast that is noise, at most to twice."""
    max_start: Natural = 150_000
    """Gaussians at the start, at most: their distance grows rather than their number."""
    start_per_pixel: Positive = 1.5
    """Gaussians at the start for each pixel of all frames, at most: beyond that, the insides of bulky bodies, where
    nothing changes, get larger ones."""
    approximate_steps: int = 50
    """Steps in which the Gaussians learn the starting volume."""
    approximate_rates: GaussianRates = GaussianRates(0.02, 0.02, 0.02, 0.05)
    """Adam's rates in these steps, of which a tenth is left at the last one."""
    filled: Share = 0.05
    """Share of matter from which on a block of the starting volume becomes a Gaussian."""
    random_count: Natural = 8_000
    """Gaussians of a random start."""
    separate: bool = False
    """Whether, with nothing known of the matter, δ and β are fitted apart, not at the one ratio that frames suggest."""
    most_materials: Annotated[int, Within(1, 2)] = 2
    """How many materials (1 or 2) may be found where nothing is known."""
    estimate: MaterialEstimate = field(default_factory=MaterialEstimate)
    """How δ/β and δ are found where they are not known."""
    two_materials: TwoMaterials = field(default_factory=TwoMaterials)
    """How two materials are told apart."""
    volume: HolographicTV = field(default_factory=HolographicTV)
    """The starting volume."""
    learned: LearnedStart = field(default_factory=LearnedStart)
    """The network, and when its guess is taken."""
    coarse: CoarseToFine = field(default_factory=CoarseToFine)
    """How large frames of closed bodies start."""
    fit: FitOptions = field(default_factory=FitOptions)
