"""The content of a report as data: quantities, bodies in motion, guesses, scores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..align.geometry import Geometry
from ..checks import InputError, positive, require, shaped
from ..geometry import Grid, Views
from ..inference import Decision
from ..metrics import ImageScores, VolumeScores, require_same_grid, robust_material_delta
from ..representations import MovingSurfaces
from ..rotations import angles_about_y
from ..units import in_percent, wavenumber
from ..volume import Volume
from ..workflows.rehearsal import Rehearsal
from ..workflows.totals import TotalMatter
from ..workflows.verdict import Verdict
from .style import scientific
from .surface import ForecastShown
from .view3d.view import View3D


@dataclass(frozen=True)
class Quantity:
    """symbol: its letter; factor: by which δ (or β, which then stands for it) is multiplied; unit: empty for none."""

    symbol: str
    factor: float
    unit: str

    def text(self, value: float) -> str:
        """A δ, or the β that stands for it, as this quantity with its unit."""
        return f"{scientific(self.factor * value)}\u00a0{self.unit}".rstrip()

    def label(self, power: str = "") -> str:
        """The name of an axis in units of `power`, such as 10⁻⁷."""
        unit = " ".join(filter(None, (power, self.unit)))
        return f"{self.symbol} ({unit})" if unit else self.symbol


DELTA = Quantity("δ", 1.0, "")


def attenuation(energy_kev: float) -> Quantity:
    """The attenuation coefficient µ = 4πβ/λ [m⁻¹] at `energy_kev` [keV]."""
    return Quantity("µ", 2 * float(wavenumber(energy_kev)), "m⁻¹")


WHOLE = 0.999
"""Part of the vertices in the field from which on a body is whole there."""


@dataclass(frozen=True)
class Moving:
    """Bodies in motion, their numbers, and one frame of each of a few times.

    - bodies: on their paths; times: [T] of the frames [s]
    - tracks: numbers by the names of tracks.csv, [T, B] each; errors: standard errors of some of them, [T, B] each
    - low, high: corners `(x, y, z)` of the field of view [m]
    - shown: [K] indices of the times that are drawn; views: K, one of each; measured, predicted: their frames
      [K, H, W], relative intensity
    """

    bodies: MovingSurfaces
    times: np.ndarray
    tracks: Mapping[str, np.ndarray]
    low: np.ndarray
    high: np.ndarray
    shown: np.ndarray
    views: Views
    measured: np.ndarray
    predicted: np.ndarray
    errors: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def whole(self) -> np.ndarray:
        """[T, B] whether a body is whole in the field."""
        return self.tracks["in_field"] >= WHOLE

    def mean(self, name: str) -> np.ndarray:
        """[B] of a column, over the times at which a body is whole in the field; NaN where it never is."""
        return self._over_time(name, np.mean)

    def spread(self, name: str) -> np.ndarray:
        """[B] standard deviations of a column, over the same times."""
        return self._over_time(name, np.std)

    def _over_time(self, name: str, what: object) -> np.ndarray:
        assert callable(what)
        columns = zip(self.tracks[name].T, self.whole.T)
        return np.array([what(values[whole]) if whole.any() else np.nan for values, whole in columns])


UNSURE = 0.2
"""Spread from which on matter counts as guessed."""


@dataclass(frozen=True)
class GuessShown:
    """occupancy, found: [Z, Y, X] of the guess and of the reconstruction, both in units of the material's δ; spread:
    [Z, Y, X] standard deviation of guesses, or None; words: what the run began with, and why; of_copies: whether these
    guesses are of copies of the scene, mirrored and turned, and not without one of the views each."""

    occupancy: np.ndarray
    found: np.ndarray
    spread: np.ndarray | None
    grid: Grid
    words: str
    of_copies: bool = False

    def __post_init__(self) -> None:
        for name in ("occupancy", "found", "spread"):
            if getattr(self, name) is not None:
                shaped(name, np.asarray(getattr(self, name)), self.grid.shape)

    @property
    def unsure(self) -> float | None:
        """Share of the reconstructed matter where guesses differ by more than `UNSURE`; None without a spread."""
        if self.spread is None:
            return None
        matter = np.clip(self.found, 0, None, dtype=np.float64)
        return float(matter[self.spread > UNSURE].sum() / max(float(matter.sum()), np.finfo(float).tiny))


WIDER_GAP = 1.5
"""How many times wider than the gap across 0° another gap between angles must be for angles to be counted from it."""


@dataclass(frozen=True)
class HeldOutViews:
    """Frames that the fit never saw, and what the reconstruction predicts for them.

    measured, predicted: [T, H, W] relative intensity; labels: T texts, from `view_labels`; scores: of these
    frames; pixels: [T] their sizes [m], None where all are that of the report; explained: the verdict on these frames,
    None: not judged.
    """

    measured: np.ndarray
    predicted: np.ndarray
    labels: tuple[str, ...]
    scores: ImageScores
    pixels: np.ndarray | None = None
    explained: Verdict | None = None

    def __post_init__(self) -> None:
        measured = shaped("measured frames", np.asarray(self.measured), (None, None, None))
        shaped("predicted frames", np.asarray(self.predicted), measured.shape)
        if not (len(measured) == len(self.labels) == len(self.scores) > 0):
            raise InputError(
                f"held-out views need one label and one score a frame, but there are {len(measured)} frames, "
                f"{len(self.labels)} labels and {len(self.scores)} scores."
            )


@dataclass(frozen=True)
class LitViews:
    """Training frames in uneven light: measured, their light beside the prediction, and what even light would give.

    measured, light, predicted: [T, H, W] relative intensity; labels: T texts, from `view_labels`; words: on the light
    of all frames; pixels: as in `HeldOutViews`.
    """

    measured: np.ndarray
    light: np.ndarray
    predicted: np.ndarray
    labels: tuple[str, ...]
    words: str
    pixels: np.ndarray | None = None

    def __post_init__(self) -> None:
        measured = shaped("measured frames", np.asarray(self.measured), (len(self.labels), None, None))
        shaped("light", np.asarray(self.light), measured.shape)
        shaped("predicted frames", np.asarray(self.predicted), measured.shape)


@dataclass(frozen=True)
class ProjectedMaps:
    """Line integrals of the reconstruction, and of the truth where it is known, for a few views.

    projected_beta, projected_delta: B = ∫β dz and D = ∫δ dz, [V, H, W] [m]; true_projected_beta,
    true_projected_delta: likewise, or None; labels: V texts, from `view_labels`; pixels: as in `HeldOutViews`.
    """

    projected_beta: np.ndarray
    projected_delta: np.ndarray
    labels: tuple[str, ...]
    true_projected_beta: np.ndarray | None = None
    true_projected_delta: np.ndarray | None = None
    pixels: np.ndarray | None = None

    def __post_init__(self) -> None:
        shape = shaped("projected δ", np.asarray(self.projected_delta), (None, None, None)).shape
        shaped("projected β", np.asarray(self.projected_beta), shape)
        require(len(self.labels) == shape[0], "projected maps need one label a view; correct the labels.")
        require(
            (self.true_projected_beta is None) == (self.true_projected_delta is None),
            "give both true projections, of β and of δ, or neither.",
        )
        if self.true_projected_beta is not None and self.true_projected_delta is not None:
            shaped("true projected β", np.asarray(self.true_projected_beta), shape)
            shaped("true projected δ", np.asarray(self.true_projected_delta), shape)


@dataclass(frozen=True)
class ReportContent:
    """The content of the page; absent parts are named on it.

    - title: what was reconstructed; summary: a sentence or two on the experiment, plain text
    - reconstruction, truth: volumes on one grid
    - energy_kev: at which δ and β hold [keV]; pixel_size: of the frames [m],
      the smallest where they differ
    - held_out: test views; projections: line integrals of a few views; volume_scores: against the truth
    - seen: voxels of these volumes [Z, Y, X] bool that all training views show; None: all of them
    - material_delta: the material's δ, for surfaces and masks; None: the robust maximum of the truth, or else
      of the reconstruction
    - lit: training frames in uneven light; None: the light is even
    - explained: the verdict on the training frames; None: not judged; scan: their name, as a command takes it
    - delta_told: whether δ is known from frames or prior; else β stands for δ in all volumes
    - total: the total δ by these frames; None: unknown
    - rehearsal: what rehearsals of the run show; None: there were none; at_rest: whether there can be any
    - moving: bodies in motion, whose volumes are those of one time; None: matter stands still
    - view: the interactive 3D view; None: there is none
    - guess: that of a network before the fit; None: there was none
    - forecast: of a forecast, its errors and scores; None: it is none
    - geometry: where the frames were found to be; None: as the scan says
    - history: columns of metrics.csv, each [S]: step, seconds, loss, the loss' terms, count, val_ssim …
    - seconds: time of the reconstruction [s]
    - settings: the resolved configuration, nested or flat; usual: the defaults of the method
    - decisions: between hypotheses, with the evidence
    - versions, machine, timing: tables of names and values; input_hash: of the scan; run: its name
    """

    title: str
    reconstruction: Volume
    energy_kev: float
    pixel_size: float
    summary: str = ""
    truth: Volume | None = None
    held_out: HeldOutViews | None = None
    projections: ProjectedMaps | None = None
    volume_scores: VolumeScores | None = None
    seen: np.ndarray | None = None
    material_delta: float | None = None
    explained: Verdict | None = None
    delta_told: bool = True
    total: TotalMatter | None = None
    rehearsal: Rehearsal | None = None
    at_rest: bool = True
    geometry: Geometry | None = None
    lit: LitViews | None = None
    moving: Moving | None = None
    view: View3D | None = None
    guess: GuessShown | None = None
    forecast: ForecastShown | None = None
    decisions: tuple[Decision, ...] = ()
    history: Mapping[str, np.ndarray] = field(default_factory=dict)
    seconds: float | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    usual: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, Any] = field(default_factory=dict)
    machine: Mapping[str, Any] = field(default_factory=dict)
    timing: Mapping[str, Any] = field(default_factory=dict)
    input_hash: str = ""
    run: str = ""
    scan: str = "SCAN"

    def __post_init__(self) -> None:
        positive("energy", self.energy_kev, "keV")
        positive("pixel size", self.pixel_size, "metres")
        if self.truth is not None:
            require_same_grid(self.reconstruction.grid, self.truth.grid)
        lengths = {name: len(column) for name, column in self.history.items()}
        require(len(set(lengths.values())) <= 1, f"history columns must have one length, but have {lengths}.")

    @property
    def trust(self) -> str:
        """Where all views show the volume, and how much matter lies elsewhere; nothing where they show all of it."""
        size = np.abs(self.reconstruction.delta)
        if self.seen is None or self.seen.all() or not size.any():
            return ""
        share = float(size[~self.seen].sum(dtype=np.float64) / size.sum(dtype=np.float64))
        return (
            "Inside the dashed line all training views show the matter and its first fringe. Beyond it lies "
            f"{in_percent(round(share, 5))} of the matter; trust its values less."
        )

    @property
    def quantity(self) -> Quantity:
        """What is shown of the matter: δ, or µ where δ is not known."""
        return DELTA if self.delta_told else attenuation(self.energy_kev)

    def surface_material(self) -> float | None:
        """The material's δ for surfaces and masks; None when there is no matter at all."""
        if self.material_delta is not None:
            return self.material_delta
        if self.volume_scores is not None:
            return self.volume_scores.material_delta
        volume = self.truth if self.truth is not None else self.reconstruction
        return robust_material_delta(volume) if np.any(volume.delta) else None


def pixel_of(shown: HeldOutViews | LitViews | ProjectedMaps, row: int, pixel_size: float) -> float:
    """The pixel size [m] of frame `row`."""
    return pixel_size if shown.pixels is None else float(shown.pixels[row])


def view_labels(views: Views) -> tuple[str, ...]:
    """A label for each view: "θ = 15.0°" where all turn about the y axis, else "view k" (counted from 1).

    With their pixels where these differ.
    """
    if not views.has_one_pixel:
        return tuple(f"view {k + 1}, pixels of {1e6 * p:.4g} µm" for k, p in enumerate(views.pixel_sizes))
    if not views.shares_axis:
        return tuple(f"view {k + 1}" for k in range(len(views)))
    angles = _along_one_arc(np.degrees(angles_about_y(views.rotations)) % 360.0)
    return tuple(f"θ = {round(float(angle), 1) + 0.0:.1f}°".replace("-", "−") for angle in angles)


def _along_one_arc(angles: np.ndarray) -> np.ndarray:
    """Angles [°] from 0 to 360, or with those beyond a wide gap below 0, so that −88° does not become 272°."""
    turned = np.sort(angles)
    gaps = np.diff(turned)
    if not len(gaps) or gaps.max() <= WIDER_GAP * (turned[0] + 360.0 - turned[-1]):
        return angles
    return np.where(angles > turned[gaps.argmax()], angles - 360.0, angles)


def flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested settings as dotted names and texts: {"fit": {"steps": 3}} → {"fit.steps": "3"}."""
    flat: dict[str, str] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = f"{value:.6g}" if isinstance(value, float) else str(value)
    return flat
