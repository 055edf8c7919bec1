"""Forecasts of bodies beyond the last frames: each part of the motion is extrapolated as far as it is determined."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol

import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.transform import Rotation

from ..checks import InputError, in_range
from ..inference import Decision, Score, select
from ..mesh import TriangleMesh, across, areas
from ..ranges import ranged
from ..representations import MovingSurfaces, TimeBasis
from ..representations.flow import path_positions

PARTS = ("centre", "turn", "stretch", "rest")
MOST_REST = 1
"""Highest power of time of the rest: of the next one, fits of paths hold more noise than motion, and half-sets do not
notice, for both begin at the same fit and keep its fine noise."""
POOLED = 2.0
"""What a coefficient's variance in the other bodies counts against a body's own, which one difference tells."""


@dataclass(frozen=True)
class Window:
    """Times [s] from `first` to `last`, whose Legendre polynomials are used up to `degree`."""

    first: float
    last: float
    degree: int = 2

    def scaled(self, times: np.ndarray) -> np.ndarray:
        """Times [T] such that the window is -1 … 1."""
        return 2 * (np.asarray(times, dtype=np.float64) - self.first) / (self.last - self.first) - 1

    def coefficients(self, times: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Least-squares coefficients [D + 1, …] of polynomials through `values` [T, …] at `times` [T]."""
        flat = np.reshape(values, (len(times), -1))
        found = legendre.legfit(self.scaled(times), flat, min(self.degree, len(times) - 1))
        full = np.zeros((self.degree + 1, flat.shape[1]))
        full[: len(found)] = found
        return full.reshape(self.degree + 1, *np.shape(values)[1:])

    def values(self, times: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """[T, …] at `times` [T], in the window or beyond."""
        weights = legendre.legvander(self.scaled(times), len(coefficients) - 1)
        return np.tensordot(weights, coefficients, axes=1)


@dataclass(frozen=True)
class Split:
    """Coefficients of one body's parts: centre and turn [D + 1, 3] [m, rad], stretch [D + 1, 3, 3], rest [D + 1, P, 3]
    [m]; shape [P, 3] [m], the reference about its middle, to which turn, stretch and rest are relative."""

    shape: np.ndarray
    centre: np.ndarray
    turn: np.ndarray
    stretch: np.ndarray
    rest: np.ndarray

    @classmethod
    def of(cls, places: np.ndarray, times: np.ndarray, window: Window, weights: np.ndarray, reference: int) -> Split:
        """The parts of the places [T, P, 3] [m] of a body's vertices at `times` [T].

        weights: [P] of the vertices, such as the areas around them; reference: number of the time of the shape.
        """
        weights = weights / weights.sum()
        centre = np.einsum("p,tpx->tx", weights, places)
        local = places - centre[:, None]
        shape = local[reference]
        turns = np.array([_turn(shape, one, weights) for one in local])
        own = np.einsum("tji,tpj->tpi", turns, local) - shape
        second = np.einsum("p,pi,pj->ij", weights, shape, shape)
        moments = np.einsum("p,pi,tpj->tij", weights, shape, own)
        stretch = np.linalg.solve(second, moments)
        rest = own - np.einsum("pi,tij->tpj", shape, stretch)
        vectors = Rotation.from_matrix(turns).as_rotvec()
        found = (window.coefficients(times, part) for part in (centre, vectors, stretch, rest))
        return cls(shape, *found)

    def places(self, times: np.ndarray, window: Window) -> np.ndarray:
        """[T, P, 3] [m] at `times` [T], beyond the window too."""
        centre, vectors, stretch, rest = (window.values(times, getattr(self, name)) for name in PARTS)
        own = self.shape + np.einsum("pi,tij->tpj", self.shape, stretch) + rest
        turns = Rotation.from_rotvec(vectors).as_matrix()
        return centre[:, None] + np.einsum("tij,tpj->tpi", turns, own)

    def stiffened(self, window: Window) -> Split:
        """The same motion of a body that keeps the shape of the window's last time."""
        last = [window.values(np.array([window.last]), part)[0] for part in (self.stretch, self.rest)]
        still = [np.concatenate([one[None], np.zeros((window.degree, *one.shape))]) for one in last]
        return Split(self.shape, self.centre, self.turn, *still)


def shrunk(splits: Sequence[Split], halves: tuple[Sequence[Split], Sequence[Split]] | None) -> list[Split]:
    """Each coefficient moved towards what it is without data, as far as two half-sets of the data disagree on it.

    A coefficient q has the variance σ² = (q₁ - q₂)²/4 in a body, of which the median over bodies counts `POOLED` times
    as much as its own; how large it is in truth, τ², is the median of q² less that of σ². It is multiplied by
    τ²/(τ² + σ²) (empirical Bayes; Efron & Morris 1973, J. Am. Stat. Assoc. 68, 117). Without data centres go with
    their median velocity, and all else stays. The rest has one factor a power of time, and none above `MOST_REST`. The
    means over the window (power 0) are kept. Without `halves` all of this is.
    """
    changed = []
    for name in ("centre", "turn", "stretch"):
        values = np.array([getattr(one, name) for one in splits])
        usual = np.zeros_like(values)
        if name == "centre":
            usual[:, 1] = np.median(values[:, 1], axis=0)
        noise = 0 * values if halves is None else _differences(halves, name) ** 2 / 4
        factors = believed(noise, (values - usual) ** 2)
        factors[:, 0] = 1.0
        changed.append(usual + factors * (values - usual))
    rests = [factor[:, None, None] * one.rest for factor, one in zip(_rest_factors(splits, halves), splits)]
    return [Split(one.shape, *parts) for one, *parts in zip(splits, *changed, rests)]


def believed(noise: np.ndarray, square: np.ndarray) -> np.ndarray:
    """τ²/(τ² + σ²) [B, …], from the `noise` squared and the `square` of coefficients [B, …]; 1 without noise."""
    usual = np.median(noise, axis=0)
    own = (POOLED * usual + noise) / (POOLED + 1)
    true = np.maximum(np.median(square, axis=0) - usual, 0)
    return np.where(own > 0, true / np.maximum(true + own, np.finfo(float).tiny), 1.0)


def _differences(halves: tuple[Sequence[Split], Sequence[Split]], name: str) -> np.ndarray:
    return np.array([getattr(a, name) - getattr(b, name) for a, b in zip(*halves)])


def _rest_factors(splits: Sequence[Split], halves: tuple[Sequence[Split], Sequence[Split]] | None) -> np.ndarray:
    """[B, D + 1] of the rest's powers of time."""
    square = np.array([(one.rest**2).mean((1, 2)) for one in splits])
    noise = 0 * square
    if halves is not None:
        noise = np.array([((a.rest - b.rest) ** 2).mean((1, 2)) / 4 for a, b in zip(*halves)])
    factors = believed(noise, square)
    factors[:, 0], factors[:, MOST_REST + 1 :] = 1.0, 0.0
    return factors


def _turn(shape: np.ndarray, other: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The rotation R [3, 3] with which R shape comes nearest to `other`, both [P, 3] about their middles."""
    left, _, right = np.linalg.svd(np.einsum("p,pi,pj->ij", weights, other, shape))
    sign = np.sign(np.linalg.det(left @ right))
    return left @ np.diag([1.0, 1.0, sign]) @ right


Places = list[np.ndarray]
"""Of each body the places [T, P, 3] [m] of its vertices."""
Halves = tuple[MovingSurfaces, MovingSurfaces]
"""The same bodies by two halves of the frames."""
SMOOTH = 3
"""Degree of the paths between the times of a forecast."""


@dataclass(frozen=True)
@ranged
class PathForecast:
    """How fitted paths go on."""

    kind: ClassVar[str] = "paths"

    degree: int = 2
    """Powers of time that are believed, at most: 2 leaves 0.03 µm of the paths of flowing cells over 50 times."""
    window: int = 0
    """Last times of the run that tell the motion (0: all)."""
    rigid: bool = False
    """Whether shapes stay as they are at the last time, and bodies move and turn alone."""
    keep_volume: bool = True
    """Whether bodies have the mean volume of the window; of flowing cells it is kept to 0.6 %."""

    def __post_init__(self) -> None:
        in_range("degree", self.degree, 1, 5)

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
    body's surface along its normals (rms over it), NaN where nothing tells it; told: numbers found on the way.
    """

    bodies: MovingSurfaces
    times: np.ndarray
    band: np.ndarray
    told: dict[str, float] = field(default_factory=dict)

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
        """What is known of the first two thirds of the times: forecasts of the others from it can be tested."""
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
    seen = np.zeros(bodies.count)
    if history.halves is not None:
        (seen,) = half_apart(bodies, *(places_of(half, window[-1:]) for half in history.halves))
    left = _beyond(history, places, np.sqrt(np.maximum(seen**2 - spread[0] ** 2, 0)))
    missed, tested = _backtest(say, history, windowed, degree, seen)
    band = np.sqrt(spread[1:] ** 2 + left + ((ahead - last) / tested)[:, None] ** 4 * missed)
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
    for k, split in enumerate(splits):
        faces = bodies.body(k)[1].numpy()
        usual = np.mean([TriangleMesh(one, faces).volume for one in split.places(inside, window)])
        found[k] = np.array([of_volume(one, faces, float(usual)) for one in found[k]])
    return found


def of_volume(vertices: np.ndarray, faces: np.ndarray, volume: float) -> np.ndarray:
    """The body scaled about its middle such that it has the `volume` [m³]; as it is where it is turned inside out."""
    middle, share = vertices.mean(0), volume / TriangleMesh(vertices, faces).volume
    return middle + share ** (1 / 3) * (vertices - middle) if share > 0 else vertices


def of_kept_volume(bodies: MovingSurfaces, times: np.ndarray, places: Places) -> Places:
    """`places` of each body, such that it has its mean volume at `times`."""
    found = []
    for k, (before, later) in enumerate(zip(places_of(bodies, times), places)):
        faces = bodies.body(k)[1].numpy()
        usual = float(np.mean([TriangleMesh(one, faces).volume for one in before]))
        found.append(np.array([of_volume(one, faces, usual) for one in later]))
    return found


def _backtest(
    say: Say, history: History, windowed: Callable[[np.ndarray], np.ndarray], degree: int, seen: np.ndarray
) -> tuple[np.ndarray, float]:
    """Squared error [B] m² of a forecast of the last time from the first two thirds, as of `_beyond`, and how long
    ahead that is [s]; NaN for fewer times than it needs. seen: [B] m, standard error of the bodies at the last time."""
    before, last = history.before, history.times[-1:]
    early = windowed(before.times)
    if len(early) <= degree or len(before.times) == len(history.times):
        return np.full(history.bodies.count, np.nan), 1.0
    said, spread = say(before.bodies, early, last, before.halves)
    return _beyond(history, said, np.hypot(spread[0], seen)), float(last[0] - early[-1])


def _beyond(history: History, said: Places, noise: np.ndarray) -> np.ndarray:
    """[B] m²: the squared distance of the first places that are `said` from the bodies at the last time, in equal parts
    of the body and the median of all; of it the share that the median is beyond that of the `noise` [B] m, squared."""
    pairs = enumerate(zip(said, places_of(history.bodies, history.times[-1:])))
    faces = history.bodies.body
    away = np.array([across(one[:1], true, faces(k)[1].numpy())[0] for k, (one, true) in pairs]) ** 2
    usual = np.median(away)
    share = max(1 - np.median(noise**2) / max(usual, np.finfo(float).tiny), 0.0)
    return 0.5 * share * (away + usual)
