"""Forecasts by mechanics: membranes on the surfaces that were seen, carried by the flow of a channel.

The model is not the truth: walls do not answer, moduli are those of healthy cells, and where a membrane's nodes are on
a surface is not seen. So it is run over the last times of the window first, against the paths that were fitted there:
what it misses is put down to the peak of the flow and the shear modulus, as far as a range is left to them, and to a
small linear flow about each cell, which then goes on. What it misses yet, a network that learnt from other cells may
know: the hybrid is the mean of both by the errors that they state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch

from ..checks import at_least, in_range, positive, require
from ..mesh import TriangleMesh
from ..representations import MovingSurfaces
from ..specimens.flow.suspension import PLASMA_VISCOSITY
from ..specimens.red_cells import RedCell
from .cell_model import CellModel, ChannelFrame, Range
from .forecast import (
    Forecast,
    Forecaster,
    History,
    Model,
    PathForecast,
    error_at_end,
    extrapolate,
    left_of,
    of_volume,
    on_paths,
    places_of,
    smoothed,
)

ALIKE = 0.3
"""A body whose volume differs from the median by more is no whole cell."""
STRETCHED = 1.15
"""Area of a cell over that of a resting one of its volume, at most: membranes tear at less, and tracks are rough."""
LEAST_OWN = 1e-4
"""Of a forecast's squared error, which is its own at least."""
PEAK = 0.04
"""How far the peak may be from that which the bodies' velocities say, as a share."""


@dataclass(frozen=True)
class DynamicsForecast:
    """How cells move on by mechanics."""

    kind: ClassVar[str] = "mechanics"

    frame: ChannelFrame
    """The channel; cells tell which way the flow goes along its axis."""
    peak: Range = (0.0, 0.0)
    """Velocity of the undisturbed flow on the axis [m/s], a range; (0, 0): found from the bodies' velocities."""
    shear: Range = (2e-6, 10e-6)
    """Skalak's shear modulus [N/m], a range: what was measured of healthy cells. Motion tells it over the viscosity."""
    viscosity: float = PLASMA_VISCOSITY
    """Of the fluid, inside and outside [Pa s]."""
    back: int = 8
    """Last times over which the model is compared with the paths, at most a third of the run's."""
    free: bool = True
    """Whether what is wrong with the flow about each cell is put down to a linear flow of its own."""
    frames: bool = False
    """Whether the model is fitted to the window's frames, and not to the paths that were fitted to them (4D-Var)."""
    paths: PathForecast = PathForecast()
    """How bodies go on that are no whole cells in the channel."""

    def fit(self, history: History) -> Model:
        """Mechanics on the history."""
        return Model(lambda ahead: carry(history, ahead, self))

    def __post_init__(self) -> None:
        in_range("viscosity", self.viscosity, 1e-6, 1e3, unit="pascal seconds")
        at_least(self, 1, "back")
        for name, (low, high) in (("peak", self.peak), ("shear", self.shear)):
            require(0 <= low <= high, f"{name} must be a range LOW:HIGH, but it is {low:g}:{high:g}; correct it.")
        positive("shear", self.shear[0], "newtons a metre")


@dataclass(frozen=True)
class Window:
    """State where mechanics begin. bodies: fitted to the frames; past: last times [P] s; every: the last one and those
    ahead [N + 1] s; seen: places of each body [P, Q, 3] [m]; spread: [P, B] m, of these; base: as paths go on; cells:
    numbers of the bodies that are whole cells in the channel; model: of these; peak: its range [m/s]."""

    bodies: MovingSurfaces
    options: DynamicsForecast
    past: np.ndarray
    every: np.ndarray
    seen: list[np.ndarray]
    spread: np.ndarray
    base: Forecast
    cells: list[int]
    model: CellModel
    peak: Range

    def meshes(self, time: int) -> list[TriangleMesh]:
        """The cells at the time numbered so of the past."""
        return [TriangleMesh(self.seen[k][time], self.bodies.body(k)[1].numpy()) for k in self.cells]

    def gone_on(self, later: list[np.ndarray], left: np.ndarray) -> Forecast:
        """Cells go on at `later` [N + 1, Q, 3] [m] of each, all others as paths do.

        left: [C] m, what the model misses of the cells over the past, which grows with time.
        """
        places, band = places_of(self.base.bodies, self.every), self.base.band.copy()
        growth = (self.every - self.every[0]) / (self.past[-1] - self.past[0])
        for k, own, missed in zip(self.cells, later, left):
            error = np.hypot(self.spread[-1, k], growth * missed)
            places[k], band[:, k] = own, error[1:]
        return Forecast(on_paths(self.bodies, self.every, places), self.every[1:], band)


def carry(history: History, ahead: np.ndarray, options: DynamicsForecast) -> Forecast:
    """The bodies of `history` at the later times `ahead` [N] s; told: what was found of the flow.

    Whole cells within the channel go by mechanics, from the state that their paths have at the last time; all others
    as `extrapolate` says. The band has the state's part, and what the model left of the window, growing with time.
    Errors: `InputError` where no body is a whole cell within the channel.
    """
    window = window_of(history, ahead, options)
    ranges = {"peak": window.peak, "shear": options.shear}
    tracked = [window.seen[k] for k in window.cells]
    fitted = window.model.fitted(window.meshes(0), tracked, window.past, ranges, options.free)
    later = window.model.run(window.meshes(-1), window.every, fitted.unknowns, fitted.wrong)
    for own, seen in zip(later, tracked):
        own += seen[-1] - own[0]  # what the coarse membrane does not follow
    return replace(window.gone_on(later, fitted.left), told=fitted.unknowns.as_dict(fitted.told))


def window_of(history: History, ahead: np.ndarray, options: DynamicsForecast) -> Window:
    """Initial state of the mechanics, as of `carry`."""
    bodies, times, halves = history.bodies, history.times, history.halves
    known = options.paths.times(times)
    past = known[-1 - min(options.back, max(1, len(known) // 3)) :]
    seen, spread = smoothed(bodies, known, past, options.paths, halves)
    spread = np.hypot(spread, np.sqrt(left_of(history, [one[-1:] for one in seen], spread[-1])))
    base = extrapolate(history, ahead, options.paths)
    faces = [bodies.body(k)[1].numpy() for k in range(bodies.count)]
    cells = whole_cells([TriangleMesh(one[-1], f) for one, f in zip(seen, faces)], options.frame)
    require(
        len(cells) > 0,
        "dynamics need cells that are whole and within the channel at the last time, but there are none; check "
        "--channel, --flow-axis and --channel-centre.",
    )
    last = [TriangleMesh(seen[k][-1], faces[k]) for k in cells]
    speeds = bodies.velocities(float(times[-1]))
    along = sum(float(speeds[k].mean(0) @ options.frame.rotation[0]) for k in cells)
    frame = replace(options.frame, back=options.frame.back != (along < 0))
    model = CellModel(frame, last, float(np.sqrt(np.prod(options.shear))), options.viscosity)
    peak = _peak(model, bodies, cells, known, options)
    return Window(bodies, options, past, np.r_[times[-1], ahead], seen, spread, base, cells, model, peak)


def whole_cells(meshes: list[TriangleMesh], frame: ChannelFrame) -> list[int]:
    """Numbers of the bodies that are red cells within the channel.

    They have nearly the median volume of those within, and no more area than a cell of that volume can have.
    """
    channel, rest = frame.channel, RedCell().mesh()
    depths = [channel.depth(torch.from_numpy(frame.inward(mesh.vertices))).min().item() for mesh in meshes]
    volumes = np.array([mesh.volume for mesh in meshes])
    within = (np.array(depths) > 0) & (volumes > 0)
    if not within.any():
        return []
    usual = np.median(volumes[within])
    alike = within & (np.abs(volumes / usual - 1) < ALIKE)
    most = STRETCHED * rest.area / rest.volume ** (2 / 3)
    return [int(k) for k in np.flatnonzero(alike) if meshes[k].area < most * volumes[k] ** (2 / 3)]


def _peak(
    model: CellModel, bodies: MovingSurfaces, cells: list[int], window: np.ndarray, options: DynamicsForecast
) -> Range:
    """The range of the peak [m/s]: as given, or about that of the cells' velocities."""
    if options.peak[1] > 0:
        return options.peak
    places, speeds = list[np.ndarray](), list[np.ndarray]()
    for time in window:
        meshes, velocities = bodies.bodies(float(time)), bodies.velocities(float(time))
        places += [meshes[k].vertices for k in cells]
        speeds += [velocities[k] for k in cells]
    found = model.peak_of(places, speeds)
    require(found > 0, "cells must go with the flow, but they go against it; check --flow-axis.")
    return (1 - PEAK) * found, (1 + PEAK) * found


@dataclass(frozen=True)
class HybridForecast:
    """The mean of several ways on."""

    kind: ClassVar[str] = "hybrid"

    ways: tuple[Forecaster, ...]
    """Two at least, such as mechanics and the network that learnt from other cells."""

    def fit(self, history: History) -> Model:
        """Each of them on the history."""
        models = [way.fit(history) for way in self.ways]
        return Model(lambda ahead: pooled([one.ahead(ahead) for one in models], history))


def pooled(found: Sequence[Forecast], history: History) -> Forecast:
    """The mean of forecasts at the same times, of each body by the inverse squares of the errors that they state.

    The error of the state that all begin with is in each, and only what is beyond it counts. How that is correlated is
    not known: two models may be wrong alike, and the band is that of errors which are (Cauchy and Schwarz's bound).
    Bodies keep the mean of the volumes, too.
    """
    times, bodies = np.r_[history.times[-1], found[0].times], history.bodies
    state = error_at_end(history)
    square = np.stack([one.band for one in found]) ** 2
    own = np.maximum(square - state**2, np.maximum(LEAST_OWN * square, np.finfo(float).tiny))
    precision = np.where(np.isnan(square), 0.0, 1 / own)  # none, where nothing tells the error
    total = precision.sum(0)
    weights = np.divide(precision, total, out=np.full_like(own, 1 / len(found)), where=total > 0)
    shared = np.minimum(state**2, np.where(np.isnan(square), np.inf, square).min(0))
    band = np.sqrt(shared + np.where(precision > 0, weights * np.sqrt(own), 0.0).sum(0) ** 2)
    band[total == 0] = np.nan
    all_places = [places_of(one.bodies, times) for one in found]
    places = []
    for k in range(bodies.count):
        faces, shares = bodies.body(k)[1].numpy(), weights[:, [0, *range(len(times) - 1)], k]
        said = np.stack([one[k] for one in all_places])
        volumes = np.array([[TriangleMesh(x, faces).volume for x in one] for one in said])
        mean = np.einsum("wt,wtpx->tpx", shares, said)
        places.append(np.array([of_volume(x, faces, v) for x, v in zip(mean, (shares * volumes).sum(0))]))
    told = {name: value for one in found for name, value in one.told.items()}
    return Forecast(on_paths(bodies, times, places), found[0].times, band, told)
