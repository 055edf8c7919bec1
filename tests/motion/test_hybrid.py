"""The mean of several forecasts by the errors that they state, and what decides between it and paths."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from holosplat.matter import Matter
from holosplat.motion.dynamics import HybridForecast
from holosplat.motion.forecast import Forecast, History, Model, PathForecast, decided, half_apart, on_paths, places_of
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.red_cells import icosphere

SPHERE, FACES = icosphere(2)
TIMES = 1e-5 * np.arange(12)
AHEAD = TIMES[-1] + 1e-5 * np.array([1.0, 3.0, 6.0])


def truth(times: np.ndarray, cube: float = 0.0, turn: float = 0.0) -> list[np.ndarray]:
    """Places [T, P, 3] [m] of two ellipsoids that go straight on, or as the cube of time along z; turned by `turn`."""
    steps = times / 1e-5
    way = np.stack([2e-6 * steps, 1e-6 * steps, cube * steps**3], axis=1)[:, None]
    shape = Rotation.from_rotvec([0, 0, turn]).apply(SPHERE * [3e-6, 2e-6, 1.5e-6])
    return [shape + way + [9e-6 * k, 0, 0] for k in range(2)]


def bodies(away: float = 0.0, cube: float = 0.0) -> MovingSurfaces:
    """All lengths larger by the share `away`."""
    basis = TimeBasis(TIMES[0], TIMES[-1], 3)
    paths = [basis.fitted(TIMES, (1 + away) * one) for one in truth(TIMES, cube)]
    return MovingSurfaces.of_bodies(paths, [FACES, FACES], basis, 0.5e-6, Matter.one(1e-7, 0.0))


@dataclass(frozen=True)
class Off:
    """A way that is off by `metres` along z and turned, and says `band` of it."""

    kind: ClassVar[str] = "off"

    metres: float
    band: float
    cube: float = 0.0
    turn: float = 0.0
    told: dict[str, float] = field(default_factory=dict)

    def fit(self, history: History) -> Model:
        """What it says of all times."""

        def ahead(times: np.ndarray) -> Forecast:
            every = np.r_[history.times[-1], times]
            places = [one + [0, 0, self.metres] for one in truth(every, self.cube, self.turn)]
            band = np.full((len(times), 2), self.band)
            return Forecast(on_paths(history.bodies, every, places), times, band, self.told)

        return Model(ahead)


def off(found: Forecast) -> np.ndarray:
    """[B, N] m, along z."""
    return np.array([(a - b)[..., 2].mean(1) for a, b in zip(places_of(found.bodies, AHEAD), truth(AHEAD))])


def test_the_mean_is_by_inverse_squares():
    """Its error is that of errors which are alike; what nothing tells does not count."""
    ways = (Off(3e-8, 1e-8, told={"peak_m_s": 0.05}), Off(-1e-8, 2e-8))
    found = HybridForecast(ways).fit(History(bodies(), TIMES)).ahead(AHEAD)
    assert off(found) == pytest.approx((4 * 3e-8 - 1e-8) / 5, rel=1e-6, abs=0)
    assert found.band == pytest.approx((4 * 1e-8 + 2e-8) / 5)
    assert found.told == {"peak_m_s": 0.05}
    assert found.times == pytest.approx(AHEAD)
    untold = HybridForecast((*ways[:1], Off(-1e-8, np.nan))).fit(History(bodies(), TIMES)).ahead(AHEAD)
    assert off(untold) == pytest.approx(3e-8, rel=1e-6, abs=0)
    assert untold.band == pytest.approx(1e-8)
    nothing = HybridForecast((Off(3e-8, np.nan), Off(-1e-8, np.nan))).fit(History(bodies(), TIMES)).ahead(AHEAD)
    assert off(nothing) == pytest.approx(1e-8, rel=1e-6, abs=0)
    assert np.isnan(nothing.band).all()


def test_the_error_of_the_state_does_not_average_out():
    """Halves differ by it: both forecasts have it, and only what is beyond it counts."""
    halves = bodies(0.01), bodies(-0.01)
    history = History(bodies(), TIMES, halves)
    state = half_apart(bodies(), *(places_of(one, TIMES[-1:]) for one in halves))[0]
    assert (state > 1e-8).all()
    ways = Off(0.0, 5e-7), Off(1e-7, 1e-6)
    found = HybridForecast(ways).fit(history).ahead(AHEAD)
    own = [way.band**2 - state**2 for way in ways]
    weight = own[0] / (own[0] + own[1])
    wanted = np.sqrt(state**2 + ((1 - weight) * np.sqrt(own[0]) + weight * np.sqrt(own[1])) ** 2)
    assert found.band == pytest.approx(np.tile(wanted, (3, 1)))
    assert off(found) == pytest.approx(np.tile(1e-7 * weight, (3, 1)).T)
    surer = HybridForecast((Off(0.0, 1e-9), Off(1e-7, 1e-6))).fit(history).ahead(AHEAD)
    assert surer.band == pytest.approx(1e-9, rel=0.01)  # no error of the state that is larger than what is said


def test_bodies_keep_their_volumes():
    """Two turned ellipsoids have a thinner mean, which is scaled to theirs."""
    turned = replace(Off(0.0, 1e-8), turn=1.2)
    found = HybridForecast((Off(0.0, 1e-8), turned)).fit(History(bodies(), TIMES)).ahead(AHEAD)
    volumes = [mesh.volume for t in AHEAD for mesh in found.bodies.bodies(t)]
    assert volumes == pytest.approx(len(volumes) * [bodies().bodies(TIMES[-1])[0].volume], rel=1e-6, abs=0)


def test_a_turned_scene_has_the_turned_mean():
    matrix = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    here = bodies()
    there = here.with_parameters({"coefficients": here.coefficients @ torch.tensor(matrix.T).to(here.coefficients)})
    way = HybridForecast((PathForecast(), PathForecast(rigid=True)))
    one, other = (way.fit(History(each, TIMES)).ahead(AHEAD) for each in (here, there))
    assert other.band == pytest.approx(one.band, rel=1e-3)
    for a, b in zip(places_of(one.bodies, AHEAD), places_of(other.bodies, AHEAD)):
        assert b == pytest.approx(a @ matrix.T, abs=1e-11)


def test_paths_and_the_mean_are_decided_by_times_that_none_saw():
    """Bodies that go as the cube of time: paths miss them; the mean of two that are off each way does not."""
    history, best = History(bodies(cube=1e-9), TIMES), HybridForecast((Off(2e-8, 1e-8, 1e-9), Off(-2e-8, 1e-8, 1e-9)))
    decision = decided(history, PathForecast(), [Off(2e-8, 1e-8, 1e-9), best])
    assert decision.choice == "hybrid"
    assert [one.name for one in decision.compared] == ["off", "hybrid"]
    worse = HybridForecast((Off(2e-8, 1e-8, 1e-9), Off(2e-7, 1e-8, 1e-9)))
    assert decided(history, PathForecast(), [Off(2e-8, 1e-8, 1e-9), worse]).choice == "off"
    assert decided(History(bodies(), TIMES), PathForecast(), [worse]).choice == "paths"
