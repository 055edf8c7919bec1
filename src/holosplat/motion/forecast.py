"""Forecasts of bodies beyond the last frames: each part of the motion is extrapolated as far as it is determined."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol

import numpy as np

from ..checks import InputError
from ..inference import Decision, Score, select
from ..mesh import TriangleMesh, across, areas
from ..plugins import Extended
from ..ranges import Degree, ranged
from ..representations import MovingSurfaces, TimeBasis
from ..representations.flow import path_positions
from .elastic import Rest
from .split import Split, Window, shrunk

Places = list[np.ndarray]
"""Of each body the places [T, P, 3] [m] of its vertices."""
Halves = tuple[MovingSurfaces, MovingSurfaces]
"""The same bodies by two halves of the frames."""
SAME_TIME = 1e-3
"""Share of a step within which two times are one."""
SMOOTH = 3
"""Degree of the paths between the times of a forecast."""


@dataclass(frozen=True)
@ranged
class PathForecast:
    """How fitted paths go on."""

    kind: ClassVar[str] = "paths"

    degree: Degree = 2
    """Powers of time that are believed, at most: 2 leaves 0.03 µm of the paths of flowing cells over 50 times."""
    window: int = 0
    """Last times of the run that tell the motion (0: all)."""
    rigid: bool = False
    """Whether shapes stay as they are at the last time, and bodies move and turn alone."""
    keep_volume: bool = True
    """Whether bodies have the mean volume of the window; of flowing cells it is kept to 0.6 %."""

    def times(self, times: np.ndarray) -> np.ndarray:
        """The times of the window, of all `times` [T] of the run: one more than the degree at least, where there are
        so many."""
        return times[-max(self.window, self.degree + 1) :] if self.window else times

    def fit(self, history: History) -> Model:
        """The paths as they go on."""
        return Model(lambda ahead: extrapolate(history, ahead, self))


@dataclass(frozen=True)
class Forecast:
    """A forecast after the last frames.

    bodies: on paths from the last frames' time on; times: [N] s of the forecast; band: [N, B] m, standard error of each
    body's surface along its normals (rms over it), NaN where nothing tells it; told: numbers found on the way; rest:
    the shape of all bodies at rest, where it is known.
    """

    bodies: MovingSurfaces
    times: np.ndarray
    band: np.ndarray
    told: dict[str, float] = field(default_factory=dict)
    rest: Rest | None = None

    @property
    def object(self) -> MovingSurfaces:
        """The bodies."""
        return self.bodies

    def usual_band(self) -> np.ndarray:
        """[N] m, the median over bodies."""
        return np.sqrt(np.median(self.band**2, axis=1))


@dataclass(frozen=True)
class History:
    """What a forecast begins with. bodies: fitted to frames at `times` [T] s; halves: fits to two halves of them, which
    say how far each part of the motion is believed and how uncertain the forecast is; early: such fits to the frames of
    the first two thirds of the times alone, which later frames never changed. Without them bodies count as exact."""

    bodies: MovingSurfaces
    times: np.ndarray
    halves: Halves | None = None
    early: Halves | None = None

    @property
    def before(self) -> History:
        """The history that ends with the first two thirds of the times, from which forecasts are tested."""
        times = self.times[: early_count(len(self.times))]
        if self.early is None:
            return History(self.bodies, times, self.halves)
        one, other = self.early
        mean = one.with_parameters({"coefficients": 0.5 * (one.coefficients + other.coefficients)})
        return History(mean, times, self.early)

    def last(self, count: int) -> np.ndarray:
        """The last `count` times [s] (0: all)."""
        return self.times[-count:] if count else self.times


@dataclass(frozen=True)
class Model:
    """A motion that was learnt from a history. ahead: the forecast at later times [N] s."""

    ahead: Callable[[np.ndarray], Forecast]


class Forecaster(Protocol):
    """A way in which bodies go on."""

    kind: ClassVar[str]
    """Its name."""

    def fit(self, history: History) -> Model:
        """The motion that the history tells."""
        ...


FORECASTERS: Extended[Callable[[int, bool], Forecaster]] = Extended({}, "holosplat.forecasters")
"""Ways that other packages add (docs/adding.md), by name: of a window, the number of the last times that are seen (0:
all), and of whether bodies keep their volume."""


def early_count(times: int) -> int:
    """How many of so many times are the first two thirds."""
    return (2 * times + 2) // 3


def extrapolate(history: History, ahead: np.ndarray, options: PathForecast = PathForecast()) -> Forecast:
    """The paths of `history` at the later times `ahead` [N] s.

    The band is half of what forecasts from two halves of the frames differ by, what the model leaves of the last time
    beyond its noise, and what a forecast of this from the first two thirds of the times misses beyond its noise, which
    grows with the square of the time ahead.
    """

    def say(
        of: MovingSurfaces, window: np.ndarray, later: np.ndarray, both: Halves | None
    ) -> tuple[Places, np.ndarray]:
        return smoothed(of, window, later, replace(options, window=0), both)

    return told_by(say, history, options.times, ahead, options.degree)


def decided(history: History, paths: PathForecast, others: Sequence[Forecaster]) -> Decision:
    """Whether bodies go on as `paths` or as another way says, from simple to complex: which tells the last third of the
    times better from those before. Bodies are the blocks of the score; ways that cannot be asked are left out."""
    before = history.before
    late = history.times[len(before.times) :]
    truth = places_of(history.bodies, late)
    scores, by = dict[str, Score](), "the last third of the run's times"
    for way in (paths, *others):
        try:
            said = way.fit(before).ahead(late)
        except InputError as error:
            by += f"; {way.kind} was not asked: {error}"
            continue
        missed = [
            [(across(one, true, history.bodies.body(k)[1].numpy()) ** 2).mean()]
            for k, (one, true) in enumerate(zip(places_of(said.bodies, late), truth))
        ]
        scores[way.kind] = Score(np.array(missed))
    return select("how bodies go on", list(scores), lambda name, fold: scores[name], by=by)


Say = Callable[[MovingSurfaces, np.ndarray, np.ndarray, "Halves | None"], "tuple[Places, np.ndarray]"]
"""From bodies, the times of a window and later ones [N]: places at these, and what two halves differ by [N, B] [m]."""


def told_by(
    say: Say, history: History, windowed: Callable[[np.ndarray], np.ndarray], ahead: np.ndarray, degree: int
) -> Forecast:
    """The forecast of `say` with the band of `extrapolate`; windowed: which of some times it sees; degree: times of
    which no forecast can be tested."""
    window, bodies = windowed(history.times), history.bodies
    last = window[-1]
    places, spread = say(bodies, window, np.r_[last, ahead], history.halves)
    missed, tested = _backtest(say, history, windowed, degree)
    band = np.sqrt(
        spread[1:] ** 2 + left_of(history, places, spread[0]) + ((ahead - last) / tested)[:, None] ** 4 * missed
    )
    return Forecast(on_paths(bodies, np.r_[last, ahead], places), ahead, band)


def on_paths(
    bodies: MovingSurfaces, times: np.ndarray, places: Places, basis: TimeBasis | None = None
) -> MovingSurfaces:
    """The same bodies on paths through `places` at `times` [N + 1], two at least; near them on a given `basis`."""
    degree = min(SMOOTH, len(times) - 1)
    basis = basis or TimeBasis(float(times[0]), float(times[-1]), degree, len(times) - degree)
    paths = [basis.fitted(times, one) for one in places]
    faces = [bodies.body(k)[1].numpy() for k in range(bodies.count)]
    found = MovingSurfaces.of_bodies(paths, faces, basis, bodies.unit_length, bodies.matter)
    found.lines = bodies.lines
    return found


def places_of(bodies: MovingSurfaces, times: np.ndarray) -> Places:
    """Places of the vertices of each body on their paths."""
    whole = np.array(
        [path_positions(bodies.basis, bodies.coefficients.detach(), float(time)).numpy() for time in times]
    )
    return [bodies.unit_length * whole[:, bodies.body(k)[0].numpy()] for k in range(bodies.count)]


def half_apart(bodies: MovingSurfaces, one: Places, other: Places) -> np.ndarray:
    """[T, B] m: the standard error of each of the `bodies` along its normals, half of what two of its places differ by,
    squared in equal parts that of the body and the mean of all: one difference tells little."""
    faces = (bodies.body(k)[1].numpy() for k in range(bodies.count))
    squares = 0.25 * np.stack([across(a, b, f) for a, b, f in zip(one, other, faces)], axis=1) ** 2
    return np.sqrt(0.5 * (squares + squares.mean(1, keepdims=True)))


def smoothed(
    bodies: MovingSurfaces, times: np.ndarray, ahead: np.ndarray, options: PathForecast, halves: Halves | None
) -> tuple[Places, np.ndarray]:
    """Places of each body at the times `ahead` [N], in the window `times` or later, by the parts of its motion.

    And half the distance [N, B] [m] along normals of what two halves say, 0 without them.
    """
    window = Window(float(times[0]), float(times[-1]), options.degree)
    splits = _splits(bodies, times, window, options)
    both = None
    if halves is not None:
        both = _splits(halves[0], times, window, options), _splits(halves[1], times, window, options)
    found = _at(shrunk(splits, both), bodies, ahead, window, options)
    if both is None:
        return found, np.zeros((len(ahead), bodies.count))
    return found, half_apart(bodies, *(_at(shrunk(one, both), bodies, ahead, window, options) for one in both))


def _splits(bodies: MovingSurfaces, times: np.ndarray, window: Window, options: PathForecast) -> list[Split]:
    meshes = bodies.bodies(float(times[-1]))
    found = [
        Split.of(one, times, window, areas(mesh), len(times) - 1) for one, mesh in zip(places_of(bodies, times), meshes)
    ]
    return [one.stiffened(window) for one in found] if options.rigid else found


def _at(
    splits: Sequence[Split], bodies: MovingSurfaces, ahead: np.ndarray, window: Window, options: PathForecast
) -> Places:
    found = [one.places(ahead, window) for one in splits]
    if not options.keep_volume:
        return found
    inside = np.linspace(window.first, window.last, 2 * window.degree + 1)
    return of_kept_volume(bodies, [split.places(inside, window) for split in splits], found)


def of_volume(vertices: np.ndarray, faces: np.ndarray, volume: float) -> np.ndarray:
    """The body scaled about its middle such that it has the `volume` [m³]; as it is where it is turned inside out."""
    middle, share = vertices.mean(0), volume / TriangleMesh(vertices, faces).volume
    return middle + share ** (1 / 3) * (vertices - middle) if share > 0 else vertices


def of_kept_volume(bodies: MovingSurfaces, usual: Places, places: Places) -> Places:
    """`places` of each body, such that it has the mean volume of its `usual` ones."""
    found = []
    for k, (before, later) in enumerate(zip(usual, places)):
        faces = bodies.body(k)[1].numpy()
        volume = float(np.mean([TriangleMesh(one, faces).volume for one in before]))
        found.append(np.array([of_volume(one, faces, volume) for one in later]))
    return found


def left_of(history: History, said: Places, spread: np.ndarray) -> np.ndarray:
    """[B] m² what the first places that are `said` of the last time, smooth ones of error `spread` [B] m, leave of the
    bodies there, as of `_beyond`."""
    return _beyond(history, said, np.sqrt(np.maximum(error_at_end(history) ** 2 - spread**2, 0)))


def error_at_end(history: History) -> np.ndarray:
    """[B] m, standard error of the bodies at the last time; 0 without halves."""
    if history.halves is None:
        return np.zeros(history.bodies.count)
    return half_apart(history.bodies, *(places_of(half, history.times[-1:]) for half in history.halves))[0]


def _backtest(
    say: Say, history: History, windowed: Callable[[np.ndarray], np.ndarray], degree: int
) -> tuple[np.ndarray, float]:
    """Squared error [B] m² of a forecast of the last time from the first two thirds, as of `_beyond`, and how long
    ahead that is [s]; NaN for fewer times than it needs."""
    before, last = history.before, history.times[-1:]
    early = windowed(before.times)
    if len(early) <= degree or len(before.times) == len(history.times):
        return np.full(history.bodies.count, np.nan), 1.0
    said, spread = say(before.bodies, early, last, before.halves)
    return _beyond(history, said, np.hypot(spread[0], error_at_end(history))), float(last[0] - early[-1])


def _beyond(history: History, said: Places, noise: np.ndarray) -> np.ndarray:
    """[B] m²: the squared distance of the first places that are `said` from the bodies at the last time, in equal parts
    of the body and the median of all; of it the share that the median is beyond that of the `noise` [B] m, squared."""
    pairs = enumerate(zip(said, places_of(history.bodies, history.times[-1:])))
    faces = history.bodies.body
    away = np.array([across(one[:1], true, faces(k)[1].numpy())[0] for k, (one, true) in pairs]) ** 2
    usual = np.median(away)
    share = max(1 - np.median(noise**2) / max(usual, np.finfo(float).tiny), 0.0)
    return 0.5 * share * (away + usual)
