"""Bodies go on by what their own past tells alone: dynamic mode decomposition, and sparse identification.

Both act on a body's nodes about its middle, at even times; the middle goes on by a parabola. DMD (Schmid 2010, J. Fluid
Mech. 656, 5) with delays (Arbabi & Mezić 2017, SIAM J. Appl. Dyn. Syst. 16, 2096) is PyDMD's, SINDy (Brunton, Proctor &
Kutz 2016, PNAS 113, 3932), on principal components of the shapes, is PySINDy's; both come with the extra `dynamics`.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from scipy.interpolate import CubicSpline

from holosplat.checks import MissingError, require
from holosplat.inference import Decision, Score, select
from holosplat.motion.forecast import (
    Forecast,
    Halves,
    History,
    Model,
    Places,
    half_apart,
    of_kept_volume,
    places_of,
    told_by,
)
from holosplat.ranges import ManyOrNone, ranged
from holosplat.representations import MovingSurfaces

ORDERS: dict[str, tuple[tuple[int, int], ...]] = {
    "dmd": ((2, 2), (3, 2), (4, 2), (4, 4), (6, 4)),
    "sindy": ((2, 1), (3, 1), (3, 2)),
}
"""Rank and number of delays, and number of shape modes and degree of their polynomials, from simple to complex."""
MIDDLE = 2
"""Degree of the middle's path."""
LEAST = 9
"""Times that are needed: the first two thirds of them must hold the delays, and tell a parabola."""
SUBSTEPS, FAR = 2, 1e3
"""Steps from one time to the next, and how far from shapes that were seen, in their size, equations have run away."""
SPARSE = 0.05
"""Coefficients of SINDy that are smaller, where shapes and times are of order one, are left out."""


@dataclass(frozen=True)
@ranged
class ModesForecast:
    """How bodies move on by modes of their own past."""

    kind: ClassVar[str]
    """Which method."""

    window: ManyOrNone = 0
    """Last times of the run that it sees (0: all)."""
    keep_volume: bool = True
    """Whether bodies keep the mean volume of the window."""

    def fit(self, history: History) -> Model:
        """What the past tells; `InputError` for fewer than `LEAST` times, `MissingError` without the extra."""
        window = self._windowed(history.times)
        require(
            len(window) >= LEAST,
            f"--by {self.kind} must see {LEAST} times at least, but the run has {len(window)}; take --by paths.",
        )
        one, chosen = WAYS[self.kind], self._orders[self.decided(history).choice]

        def say(
            bodies: MovingSurfaces, times: np.ndarray, ahead: np.ndarray, halves: Halves | None
        ) -> tuple[Places, np.ndarray]:
            def places(of: MovingSurfaces) -> Places:
                found = _places(of, times, ahead, chosen, one)
                return of_kept_volume(of, places_of(of, times), found) if self.keep_volume else found

            if halves is None:
                return places(bodies), np.zeros((len(ahead), bodies.count))
            return places(bodies), half_apart(bodies, *(places(half) for half in halves))

        def ahead(times: np.ndarray) -> Forecast:
            return told_by(say, history, self._windowed, times, MIDDLE)

        return Model(ahead)

    def _windowed(self, times: np.ndarray) -> np.ndarray:
        return times[-self.window :] if self.window else times

    @property
    def _orders(self) -> dict[str, tuple[int, int]]:
        """By their names in a decision."""
        return {str(each): each for each in ORDERS[self.kind]}

    def decided(self, history: History) -> Decision:
        """The order that tells the last third of the times best from what is before, over all bodies."""
        before = history.before
        early, late = self._windowed(before.times), history.times[len(before.times) :]
        truth = places_of(history.bodies, late)

        @cache
        def score(name: str, fold: int) -> Score:
            said = _places(before.bodies, early, late, self._orders[name], WAYS[self.kind])
            return Score(np.array([[((a - b) ** 2).mean()] for a, b in zip(said, truth)]))

        return select("order of the modes", list(self._orders), score, by="the last third of the run's times")


@dataclass(frozen=True)
@ranged
class DmdForecast(ModesForecast):
    """How bodies move on by dynamic modes of their own past."""

    kind: ClassVar[str] = "dmd"


@dataclass(frozen=True)
@ranged
class SindyForecast(ModesForecast):
    """How bodies move on by sparse equations of modes of their own past."""

    kind: ClassVar[str] = "sindy"


Ahead = Callable[[np.ndarray, int, tuple[int, int]], np.ndarray]
"""Of snapshots [T, F] the next ones [N, F], by an order."""


def _places(bodies: MovingSurfaces, times: np.ndarray, ahead: np.ndarray, order: tuple[int, int], one: Ahead) -> Places:
    """Places of each body at the times `ahead` [N] by its past at as many even times as `times` has."""
    even = np.linspace(times[0], times[-1], len(times))
    step = even[1] - even[0]
    more = int(np.ceil((ahead[-1] - times[-1]) / step - 1e-9))
    found = []
    for places in places_of(bodies, even):
        middle = places.mean(1)
        parabola = np.polynomial.Polynomial.fit
        moved = np.stack([parabola(even, x, MIDDLE)(ahead) for x in middle.T], axis=1)
        flat = (places - middle[:, None]).reshape(len(even), -1)
        scores, size, basis = np.linalg.svd(flat, full_matrices=False)  # T numbers say what all the nodes do
        scale = size[0] / np.sqrt(len(flat))
        later = scale * one(scores * size / scale, max(more, 1), order) @ basis
        path = CubicSpline(times[-1] + step * np.arange(-1, max(more, 1) + 1), np.r_[flat[-2:], later])
        found.append(path(ahead).reshape(len(ahead), -1, 3) + moved[:, None])
    return found


def _dmd(past: np.ndarray, count: int, order: tuple[int, int]) -> np.ndarray:
    rank, delays = order
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of condition numbers, which delays raise
        found = _library("pydmd").HankelDMD(svd_rank=rank, d=delays)
        found.fit(past.T)
        found.dmd_time["tend"] = len(past) - 1 + count
        return np.real(found.reconstructed_data).T[-count:]


def _sindy(past: np.ndarray, count: int, order: tuple[int, int]) -> np.ndarray:
    """Where the equations run away, the last shape stays. They are integrated by Runge and Kutta's method."""
    modes, degree = order
    mean = past.mean(0)
    left, size, right = np.linalg.svd(past - mean, full_matrices=False)
    scores, basis = left[:, :modes] * size[:modes], right[:modes]
    scale = np.abs(scores).max()
    sindy = _library("pysindy")
    step = 1 / (len(past) - 1)
    library = sindy.PolynomialLibrary(degree=degree)
    model = sindy.SINDy(optimizer=sindy.STLSQ(threshold=SPARSE), feature_library=library)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of libraries that are left empty
        model.fit(scores / scale, t=step)
        state, said = scores[-1] / scale, list[np.ndarray]()
        for _ in range(count * SUBSTEPS):
            state = _advanced(lambda x: np.asarray(model.predict(x[None]))[0], state, step / SUBSTEPS)
            if not np.abs(state).max() < FAR:
                return np.repeat(past[-1:], count, axis=0)
            said.append(state)
    return past[-1] + (scale * np.array(said[SUBSTEPS - 1 :: SUBSTEPS]) - scores[-1]) @ basis


def _advanced(slope: Callable[[np.ndarray], np.ndarray], state: np.ndarray, step: float) -> np.ndarray:
    first = slope(state)
    second = slope(state + 0.5 * step * first)
    third = slope(state + 0.5 * step * second)
    return state + step / 6 * (first + 2 * second + 2 * third + slope(state + step * third))


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise MissingError(f"this forecast needs {name}: pip install 'holosplat[dynamics]'.") from None


WAYS: dict[str, Ahead] = {"dmd": _dmd, "sindy": _sindy}
